"""Connection URLs: read, spelled, and refused in whole sentences."""

from __future__ import annotations

import contextlib
import string

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.network.connection_url import (
    ConnectionUrl,
    ConnectionUrlError,
    Peer,
    check_together,
    parse,
)
from lifecycle.network.medium import Medium

T = Medium
_HOW = "write TRANSPORT://[ADDRESS][:PORT][?OPTION=VALUE&…], udpv4://10.77.0.1:7911"
_OPTIONS = "metatraffic_port, output_port, peer, multicast, server, ttl, interface"


@pytest.mark.parametrize(
    ("text", "url"),
    [
        (
            "udpv4://10.77.0.1:7911?metatraffic_port=7910&output_port=7999&peer=10.77.0.2:7910&multicast=off",
            ConnectionUrl(
                transport=T.UDPV4,
                address="10.77.0.1",
                port=7911,
                metatraffic_port=7910,
                output_port=7999,
                peers=(Peer(address="10.77.0.2", port=7910),),
                multicast=False,
            ),
        ),
        (
            "udpv6://[fd77::1]:7911?peer=[fd77::2]:7910&peer=[fd77::3]",
            ConnectionUrl(
                transport=T.UDPV6,
                address="fd77::1",
                port=7911,
                peers=(Peer(address="fd77::2", port=7910), Peer(address="fd77::3")),
            ),
        ),
        (
            "udpm://239.255.1.9:7901?ttl=0&interface=127.0.0.1",
            ConnectionUrl(
                transport=T.UDPM,
                address="239.255.1.9",
                port=7901,
                ttl=0,
                interfaces=("127.0.0.1",),
            ),
        ),
        (
            "udpv4://:5101?server=10.77.0.3:42100&ttl=4",
            ConnectionUrl(
                transport=T.UDPV4,
                port=5101,
                server=(Peer(address="10.77.0.3", port=42100),),
                ttl=4,
            ),
        ),
        ("shm://", ConnectionUrl(transport=T.SHM)),
    ],
)
def test_a_url_says_transport_address_and_options(text: str, url: ConnectionUrl):
    assert parse(text) == url
    assert str(url) == text


def test_an_ipv6_peer_without_a_port_needs_no_brackets():
    assert parse("udpv6://?peer=fd77::3").peers == (Peer(address="fd77::3"),)


@pytest.mark.parametrize(
    ("text", "problem", "hint"),
    [
        (
            "udp4://10.77.0.1",
            "unknown transport 'udp4'; allowed: shm, udpv4, udpv6, udpm, tcpv4",
            "did you mean 'udpv4'?",
        ),
        (
            "http://10.77.0.1",
            "unknown transport 'http'; allowed: shm, udpv4, udpv6, udpm, tcpv4",
            _HOW,
        ),
        ("", "unknown transport ''; allowed: shm, udpv4, udpv6, udpm, tcpv4", _HOW),
        ("udpv4://10.77.0.1:65536", "its port is no number of 1–65535", _HOW),
        ("udpv4://10.77.0.1:x", "its port is no number of 1–65535", _HOW),
        ("udpv4://10.77.0.1:0", "port 0 is none: leave it out to let the middleware choose", ""),
        ("udpv6://[fd77::1", "Invalid IPv6 URL", _HOW),
        ("udpv4://10.77.0.1/topic", "only address, port and options are allowed", _HOW),
        ("udpv4://me@10.77.0.1", "only address, port and options are allowed", _HOW),
        ("udpv4://10.77.0.1#x", "only address, port and options are allowed", _HOW),
        (
            "udpv4://?metatrafic_port=7910",
            f"unknown option 'metatrafic_port'; udpv4 has: {_OPTIONS}",
            "did you mean 'metatraffic_port'?",
        ),
        (
            "tcpv4://?volume=9",
            "unknown option 'volume'; tcpv4 has: peer, server",
            "",
        ),
        ("shm://?volume=9", "unknown option 'volume'; shm has: none", ""),
        ("tcpv4://?ttl=0", "tcpv4 has no option 'ttl'", ""),
        ("udpv4://?ttl=1&ttl=1", "option 'ttl' stands twice", ""),
        ("udpv4://?ttl=256", "ttl='256' is not a number of 0–255", ""),
        *(
            (f"udpv4://?ttl={each}", f"ttl={each!r} is not a number of 0–255", "")
            for each in ("²", "٧", "1e3", "", "-1")
        ),
        ("udpv4://?output_port=0", "output_port='0' is not a number of 1–65535", ""),
        ("udpv4://?multicast=no", "multicast='no' is neither 'on' nor 'off'", ""),
        ("udpv4://?multicast=", "multicast='' is neither 'on' nor 'off'", ""),
        (
            "udpv4://?peer=robot:7910",
            "peer='robot:7910' is no ADDRESS or ADDRESS:PORT",
            "an IPv6 address with a port stands in brackets, [fd77::2]:7910",
        ),
        (
            "udpv4://?peer=:7910",
            "peer=':7910' is no ADDRESS or ADDRESS:PORT",
            "an IPv6 address with a port stands in brackets, [fd77::2]:7910",
        ),
        ("shm://127.0.0.1", "shm has no address and no port", ""),
        ("udpv4://robot:7911", "'robot' is no IP address", ""),
        ("udpv4://[fd77::1]:7911", "'fd77::1' is no IPv4 address", ""),
        ("udpv6://10.77.0.1", "'10.77.0.1' is no IPv6 address", ""),
        ("udpm://10.77.0.1:7901", "'10.77.0.1' is no multicast group", ""),
        ("udpv4://239.255.1.9", "'239.255.1.9' is a multicast group: use udpm://", ""),
        ("udpm://:7901", "udpm needs a group, udpm://239.255.1.9:7901", ""),
        ("udpm://239.255.1.9", "udpm needs a port, udpm://239.255.1.9:7901", ""),
    ],
)
def test_what_cannot_be_read_is_said_whole(text: str, problem: str, hint: str):
    with pytest.raises(ConnectionUrlError) as error:
        parse(text)
    assert error.value.message == f"cannot read connection URL {text!r}: {problem}"
    assert error.value.hint == hint


@pytest.mark.parametrize(
    ("urls", "problem", "hint"),
    [
        (
            ("udpv4://", "udpv4://10.0.0.1:1"),
            "use {} on all interfaces and {} on some: one participant has one transport for both",
            "give both an address or interface=",
        ),
        *(
            (each, f"use {{}} and {{}} together: one participant has one {what}", "")
            for each, what in (
                (("udpm://239.1.1.1:1?ttl=0", "udpv4://?ttl=1"), "ttl"),
                (("udpv4://?output_port=1", "udpv4://?output_port=2"), "output_port"),
                (
                    ("udpv4://?metatraffic_port=1", "udpv4://?metatraffic_port=2"),
                    "metatraffic_port",
                ),
                (("tcpv4://:5100", "tcpv4://:5101"), "TCP port"),
            )
        ),
        (
            ("shm://", "udpv4://:7911"),
            "use {} beside {}: with fixed ports shared memory would not listen",
            "leave shm:// or the port out",
        ),
        (
            ("udpv4://?peer=10.0.0.2", "tcpv4://?server=10.0.0.1:1"),
            "look for peers {} as a client of {}: a client of a discovery server finds nobody else",
            "leave peer= or server= out",
        ),
        (("shm://", "udpv4://"), "", ""),
        (("shm://", "tcpv4://:5100"), "", ""),
        (("udpm://239.1.1.1:1", "udpv4://10.0.0.1:1", "udpv4://10.0.0.1:2"), "", ""),
        (("udpm://[ff02::1]:1?ttl=0", "udpv4://?ttl=1", "udpv4://"), "", ""),
        (("udpv4://?peer=10.0.0.1", "tcpv4://10.0.0.1:5100?peer=10.0.0.2"), "", ""),
    ],
)
def test_what_one_participant_cannot_have_together_is_said_whole(
    urls: tuple[str, ...], problem: str, hint: str
) -> None:
    if not problem:
        check_together([parse(each) for each in urls])
        return
    with pytest.raises(ConnectionUrlError) as error:
        check_together([parse(each) for each in urls])
    assert error.value.message == f"cannot {problem.format(*map(repr, urls))}"
    assert error.value.hint == (hint or "give them to different connections")


_PORTS = st.integers(1, 65535)
_V4 = st.ip_addresses(v=4).filter(lambda each: not each.is_multicast).map(str)
_V6 = st.ip_addresses(v=6).filter(lambda each: not each.is_multicast).map(str)
_PEERS = st.lists(st.builds(Peer, address=_V4 | _V6, port=st.none() | _PORTS), max_size=3).map(
    tuple
)
_IP = {"peers": _PEERS, "server": _PEERS}
_UDP = {
    **_IP,
    "metatraffic_port": _PORTS,
    "output_port": _PORTS,
    "multicast": st.booleans(),
    "ttl": st.integers(0, 255),
    "interfaces": st.lists(
        _V4 | _V6 | st.text(string.printable, min_size=1, max_size=8), max_size=2
    ).map(tuple),
}


def _urls(transport: T, required: dict, optional: dict) -> st.SearchStrategy[ConnectionUrl]:
    return st.fixed_dictionaries(required, optional=optional).map(
        lambda fields: ConnectionUrl(transport=transport, **fields)
    )


_GROUPS = st.integers(0xE0000000, 0xEFFFFFFF).map(
    lambda number: ".".join(str(number >> shift & 255) for shift in (24, 16, 8, 0))
)
_ANY_URL = st.one_of(
    _urls(T.UDPV4, {}, {**_UDP, "address": _V4, "port": _PORTS}),
    _urls(T.UDPV6, {}, {**_UDP, "address": _V6, "port": _PORTS}),
    _urls(T.UDPM, {"address": _GROUPS, "port": _PORTS}, _UDP),
    _urls(T.TCPV4, {}, {**_IP, "address": _V4, "port": _PORTS}),
    _urls(T.SHM, {}, {}),
)


@given(_ANY_URL)
def test_what_is_spelled_reads_back_the_same(url: ConnectionUrl):
    assert parse(str(url)) == url


@given(st.text(max_size=30) | st.text(alphabet="udpvtcm46sh:/[]?&=.@#%0123 ", max_size=40))
def test_any_text_is_a_url_or_a_sentence(text: str):
    with contextlib.suppress(ConnectionUrlError):
        url = parse(text)
        assert parse(str(url)) == url


def test_a_scheme_that_rfc_3986_does_not_know_is_named_all_the_same() -> None:
    for text, scheme in (("zmq_pgm://a://b", "zmq_pgm"), ("10.0.0.1", ""), ("tcp://x", "tcp")):
        with pytest.raises(ConnectionUrlError) as caught:
            parse(text)
        assert f"unknown transport {scheme!r}; " in str(caught.value)


def test_a_slash_after_the_port_is_no_path() -> None:
    assert parse("udpv4://10.77.0.1:7911/") == parse("udpv4://10.77.0.1:7911")
    with pytest.raises(ConnectionUrlError, match="only address, port and options"):
        parse("udpv4://10.77.0.1:7911/x")
