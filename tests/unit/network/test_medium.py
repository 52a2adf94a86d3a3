"""What carries data: one enum, whose members are words wherever text is wanted; datagram sizes."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest

import lifecycle
from lifecycle.codec import from_json, to_json
from lifecycle.network.medium import (
    CONNECTABLE,
    NETWORK_MEDIA,
    RTPS_OVERHEAD_BYTES,
    SAFE_DATAGRAM_BYTES,
    SCHEMES,
    FlowTransport,
    Medium,
    datagram_bytes,
    is_fragmented,
    max_unfragmented,
)


def test_a_medium_is_its_word_in_text_in_json_and_as_a_key() -> None:
    assert f"{Medium.SHM} {Medium.UDPV4!r}" == "shm 'udpv4'"
    assert ", ".join(sorted((Medium.UDPV6, Medium.SHM))) == "shm, udpv6"
    assert {"udpm": 1}[Medium.UDPM] == 1
    assert to_json({Medium.TCPV4: [Medium.SHM]}) == b'{"tcpv4":["shm"]}'
    assert json.dumps([Medium.SHM]) == '["shm"]'
    assert from_json(b'["shm","udpm"]', tuple[Medium, ...]) == (Medium.SHM, Medium.UDPM)


def test_connections_are_made_of_the_same_media_however_they_are_listed() -> None:
    assert {*CONNECTABLE} == {*SCHEMES}
    assert {*Medium} - {*SCHEMES} == {Medium.TCPV6, Medium.INTRAPROCESS}
    assert {*Medium} - NETWORK_MEDIA == {Medium.SHM, Medium.INTRAPROCESS}


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


def test_no_module_spells_a_medium_itself() -> None:
    root = Path(lifecycle.__file__).parent
    words = {each.value for each in Medium}
    found = [
        f"{path.relative_to(root)}:{each.lineno}"
        for path in root.rglob("*.py")
        if path != root / "network/medium.py"
        for each in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(each, ast.Constant) and each.value in words
    ]
    assert found == []


@pytest.mark.parametrize(
    ("ipv6", "mtu", "payload"),
    [(False, 1500, 1472), (True, 1500, 1452), (True, 1280, 1232), (False, 9000, 8972)],
)
def test_what_ip_and_udp_leave_of_an_mtu(ipv6: bool, mtu: int, payload: int) -> None:
    assert max_unfragmented(ipv6=ipv6, mtu=mtu) == payload


def test_the_safe_size_fits_ethernet() -> None:
    assert max_unfragmented(ipv6=True) >= SAFE_DATAGRAM_BYTES


@pytest.mark.parametrize(("message", "datagram"), [(4, 108), (5, 112), (1368, 1472)])
def test_a_message_is_padded_and_wrapped_by_rtps(message: int, datagram: int) -> None:
    assert datagram_bytes(message) == datagram
    assert RTPS_OVERHEAD_BYTES == 104


def test_the_largest_message_that_ip_leaves_whole_on_ethernet_has_1368_bytes() -> None:
    assert not is_fragmented(1368, max_unfragmented())
    assert is_fragmented(1369, max_unfragmented())
