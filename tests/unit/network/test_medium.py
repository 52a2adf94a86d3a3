"""What carries data: one enum, whose members are words wherever text is wanted; datagram sizes."""

from __future__ import annotations

import ipaddress
import json
import socket

import pytest

from lifecycle.codec import from_json, to_json
from lifecycle.network.medium import (
    CONNECTABLE,
    DEFAULT_TCP,
    NETWORK_MEDIA,
    RMW_DISCOVERY,
    UDP_UNICAST,
    FlowTransport,
    Medium,
    is_fragmented,
    medium_of,
    udp_to,
)


def test_a_medium_is_its_word_in_text_in_json_and_as_a_key() -> None:
    assert f"{Medium.SHM} {Medium.UDPV4!r}" == "shm 'udpv4'"
    assert ", ".join(sorted((Medium.UDPV6, Medium.SHM))) == "shm, udpv6"
    assert {"udpm": 1}[Medium.UDPM] == 1
    assert to_json({Medium.TCPV4: [Medium.SHM]}) == b'{"tcpv4":["shm"]}'
    assert json.dumps([Medium.SHM]) == '["shm"]'
    assert from_json(b'["shm","udpm"]', tuple[Medium, ...]) == (Medium.SHM, Medium.UDPM)


def test_connections_are_made_of_the_same_media_however_they_are_listed() -> None:
    assert {*Medium} - {*CONNECTABLE} == {Medium.TCPV6, Medium.INTRAPROCESS}
    assert {*Medium} - NETWORK_MEDIA == {Medium.SHM, Medium.INTRAPROCESS}


@pytest.mark.parametrize(
    ("medium", "meaning", "on_host", "ports", "address"),
    [
        (Medium.SHM, "shared memory", True, 0, ""),
        (Medium.UDPM, "UDP multicast", True, 3, "127.0.0.1"),
        (Medium.UDPV4, "udpv4", False, 3, "127.0.0.1"),
        (Medium.UDPV6, "udpv6", False, 3, "::1"),
        (Medium.TCPV4, "tcpv4", False, 1, "127.0.0.1"),
        (Medium.TCPV6, "tcpv6", False, 1, "::1"),
        (Medium.INTRAPROCESS, "handed over inside their process", True, 0, ""),
    ],
)
def test_a_medium_says_what_others_need_to_know_of_it(
    medium: Medium, meaning: str, on_host: bool, ports: int, address: str
) -> None:
    assert medium.meaning == meaning
    assert (medium.stays_on_host, medium.ports) == (on_host, ports)
    assert medium.is_network is bool(address)
    if address:
        with socket.socket(medium.socket_family) as any_:
            any_.bind((medium.loopback, 0))
            assert any_.getsockname()[0] == address
        any_of_its_version = type(ipaddress.ip_address(address))(0)
        assert medium.any_address == str(any_of_its_version)


def test_the_medium_to_an_address_is_udp_over_its_version_of_ip() -> None:
    assert [udp_to(each) for each in ("10.0.0.1", "", "fd77::2")] == ["udpv4", "udpv4", "udpv6"]
    assert medium_of("udpm@239.255.1.9:7901") is Medium.UDPM
    assert medium_of("shm").unicast is Medium.SHM
    assert Medium.UDPM.unicast is Medium.UDPV4


def test_media_are_listed_in_the_orders_that_messages_have() -> None:
    assert ", ".join(CONNECTABLE) == "shm, udpv4, udpv6, udpm, tcpv4"
    assert ", ".join(UDP_UNICAST) == "udpv4, udpv6"
    assert (RMW_DISCOVERY, DEFAULT_TCP) == ("udpv4", "tcpv4")


def test_a_transport_asks_for_memory_or_for_what_is_found_by_udp() -> None:
    assert [each for each in FlowTransport if each.in_memory] == [FlowTransport.SHM]
    assert {each for each in FlowTransport if each.by_udp} == {
        FlowTransport.ANY,
        FlowTransport.UDPV4,
        FlowTransport.UDPV6,
    }


@pytest.mark.parametrize(
    ("asked", "accepted", "builtin"),
    [
        (FlowTransport.ANY, {*Medium}, None),
        (
            FlowTransport.NETWORK,
            {Medium.UDPM, Medium.UDPV4, Medium.UDPV6, Medium.TCPV4},
            "UDPv4",
        ),
        (FlowTransport.SHM, {Medium.SHM, Medium.INTRAPROCESS}, "SHM"),
        (FlowTransport.UDPV4, {Medium.UDPV4}, "UDPv4"),
        (FlowTransport.UDPV6, {Medium.UDPV6}, "UDPv6"),
        (FlowTransport.MULTICAST, {Medium.UDPM, Medium.TCPV4, Medium.INTRAPROCESS}, None),
        (FlowTransport.TCPV4, {Medium.TCPV4}, None),
    ],
)
def test_what_a_manifest_asks_for_is_met_by_some_media(
    asked: FlowTransport, accepted: set[Medium], builtin: str | None
) -> None:
    assert {each for each in Medium if asked.accepts(each)} == accepted
    assert asked.builtin == builtin


@pytest.mark.parametrize(
    ("address", "limit", "whole"),
    [("", None, 1368), ("10.0.0.1", None, 1368), ("fd77::1", None, 1348), ("", 1400, 1296)],
)
def test_a_message_is_padded_and_wrapped_by_rtps_in_a_datagram_that_ip_leaves_whole(
    address: str, limit: int | None, whole: int
) -> None:
    assert not is_fragmented(whole, address, limit)
    assert is_fragmented(whole + 1, address, limit)
