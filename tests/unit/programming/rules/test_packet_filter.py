"""Packet filters: what is refused, and that text and value are one another's inverse."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.programming.rules.packet_filter import (
    Direction,
    PacketFilter,
    PortRange,
    check_address,
    check_protocol,
    check_same_family,
    parse_filter,
    parse_ports,
    parse_protocol,
)

PERMITTED = re.compile(r"permit (in|out) \S+ from \S+( \S+)? to \S+( \S+)?")
PORTS = st.integers(1, 65535)
RANGES = st.tuples(PORTS, PORTS).map(lambda ends: PortRange(low=min(ends), high=max(ends)))


def unicast(version: int) -> st.SearchStrategy[str]:
    return (
        st.ip_addresses(v=version)
        .filter(lambda each: not each.is_multicast and not each.is_unspecified)
        .map(str)
    )


@st.composite
def filters(draw: st.DrawFn) -> PacketFilter:
    addresses = unicast(draw(st.sampled_from((4, 6))))
    return PacketFilter(
        direction=draw(st.sampled_from(Direction)),
        protocol=draw(st.integers(1, 255)),
        source=draw(addresses),
        source_ports=draw(st.none() | RANGES),
        destination=draw(addresses),
        destination_ports=draw(st.none() | RANGES),
    )


def cannot(message: str) -> object:
    return pytest.raises(ValueError, match=f"^{re.escape(message)}$")


def test_a_filter_towards_the_device_reads_as_the_specification_shows_it() -> None:
    text = "permit out 17 from 198.51.100.7 17910 to 10.45.0.3 17900"
    parsed = parse_filter(text)
    assert parsed == PacketFilter(
        direction=Direction.OUT,
        protocol=17,
        source="198.51.100.7",
        source_ports=PortRange(low=17910, high=17910),
        destination="10.45.0.3",
        destination_ports=PortRange(low=17900, high=17900),
    )
    assert parsed.text() == text


@given(filters())
def test_a_filter_survives_its_text_in_either_spelling(filter_: PacketFilter) -> None:
    assert parse_filter(filter_.text()) == filter_
    assert parse_filter(filter_.text(protocol_by_name=True)) == filter_


def test_only_protocols_with_a_name_are_spelled_by_name() -> None:
    sctp = parse_filter("permit in 132 from 10.0.0.1 to 10.0.0.2 7-9")
    assert sctp.text(protocol_by_name=True) == "permit in 132 from 10.0.0.1 to 10.0.0.2 7-9"
    udp = parse_filter("permit in 17 from 10.0.0.1 to 10.0.0.2 7-9")
    assert udp.text(protocol_by_name=True) == "permit in udp from 10.0.0.1 to 10.0.0.2 7-9"


@given(st.text(max_size=60))
def test_any_text_is_a_filter_or_refused_with_a_reason(text: str) -> None:
    if PERMITTED.fullmatch(text):
        parse_filter(text)
    else:
        with pytest.raises(ValueError, match=r"^cannot read filter "):
            parse_filter(text)


@given(st.integers())
def test_a_protocol_is_1_to_255(number: int) -> None:
    if 1 <= number <= 255:
        assert check_protocol(number) == number
    else:
        with cannot(f"cannot use protocol {number}; use 1 to 255, such as 17 for UDP"):
            check_protocol(number)


@given(st.integers(-1, 70000), st.integers(-1, 70000))
def test_ports_are_one_or_low_to_high_within_1_to_65535(low: int, high: int) -> None:
    if 1 <= low <= high <= 65535:
        assert parse_ports(f"{low}-{high}") == PortRange(low=low, high=high)
    else:
        with pytest.raises(ValueError, match=r"^cannot use port"):
            parse_ports(f"{low}-{high}")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0", "cannot use port 0; use 1 to 65535"),
        ("65536", "cannot use port 65536; use 1 to 65535"),
        ("9-7", "cannot use ports 9-7: the lower one comes first; use 7-9"),
        ("7,9", "cannot use ports '7,9'; use one port, or low-high, of 1 to 65535"),
        ("7-", "cannot use ports '7-'; use one port, or low-high, of 1 to 65535"),
        ("", "cannot use ports ''; use one port, or low-high, of 1 to 65535"),
        ("٧", "cannot use ports '٧'; use one port, or low-high, of 1 to 65535"),
    ],
)
def test_other_ports_are_refused(text: str, message: str) -> None:
    with cannot(message):
        parse_ports(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ip", "cannot use protocol 'ip'; use 1 to 255 or one of udp, tcp"),
        ("0", "cannot use protocol 0; use 1 to 255, such as 17 for UDP"),
        ("256", "cannot use protocol 256; use 1 to 255, such as 17 for UDP"),
    ],
)
def test_other_protocols_are_refused(text: str, message: str) -> None:
    with cannot(message):
        parse_protocol(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "robot.local",
            "cannot use address 'robot.local'; use one IPv4 or IPv6 address, such as 10.77.0.1",
        ),
        (
            "10.0.0.0/8",
            "cannot use address '10.0.0.0/8'; use one IPv4 or IPv6 address, such as 10.77.0.1",
        ),
        (
            "fe80::1%eth0",
            (
                "cannot use address 'fe80::1%eth0': its zone means something on its own host only; "
                "use fe80::1"
            ),
        ),
        (
            "0.0.0.0",
            (
                "cannot use address '0.0.0.0': it is every address of its host; "
                "use one unicast address"
            ),
        ),
        (
            "239.255.0.1",
            "cannot use address '239.255.0.1': it is a group; use one unicast address",
        ),
    ],
)
def test_only_one_unicast_address_is_an_address(text: str, message: str) -> None:
    with cannot(message):
        check_address(text)


def test_two_families_make_no_filter() -> None:
    with cannot(
        "cannot filter packets from 10.0.0.1 to fd00::1: one is IPv4, the other IPv6; "
        "use two addresses of one family"
    ):
        check_same_family("10.0.0.1", "fd00::1")


@pytest.mark.parametrize("text", ["deny out 17 from 1.2.3.4 to 1.2.3.5", "permit out 17", ""])
def test_a_filter_of_another_shape_is_refused(text: str) -> None:
    with cannot(
        f"cannot read filter {text!r}; "
        "use 'permit in|out PROTOCOL from ADDRESS [PORTS] to ADDRESS [PORTS]'"
    ):
        parse_filter(text)
