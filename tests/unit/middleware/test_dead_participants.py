"""The message by which a dead participant leaves, and whose participant a prefix may be."""

from __future__ import annotations

import socket
import struct

from lifecycle.middleware.discovery.dead_peers import is_of_process, remove_participants
from lifecycle.middleware.discovery.messages import disposal
from lifecycle.network.connection_url import parse

OURS = "010f7f013c5d59590000" + "0000"
PREFIX = "010f7f015d3c1b4c00000000"


def submessages(message: bytes) -> list[tuple[int, int, bytes]]:
    """Kind, flags and content of each submessage of an RTPS message (DDSI-RTPS 9.4)."""
    found, at = [], 20
    while at < len(message):
        kind, flags, length = struct.unpack_from("<BBH", message, at)
        found.append((kind, flags, message[at + 4 : at + 4 + length]))
        at += 4 + length
    return found


def test_a_participant_leaves_by_its_own_disposal() -> None:
    message = disposal(PREFIX)
    assert message[:8] == b"RTPS\x02\x03\x01\x0f"
    assert message[8:20].hex() == PREFIX
    (timestamp, _, _), (data, flags, content) = submessages(message)
    assert (timestamp, data, flags) == (0x09, 0x15, 0x01 | 0x02 | 0x08)
    guid = bytes.fromhex(PREFIX + "000001c1")
    assert content[4:12].hex() == "000100c7000100c2"
    assert struct.pack("<HH", 0x0070, 16) + guid in content  # key hash
    assert struct.pack("<HH", 0x0071, 4) + b"\x00\x00\x00\x03" in content  # disposed, unregistered
    assert struct.pack("<HH", 0x0050, 16) + guid in content  # the key itself


def test_a_prefix_is_taken_only_for_that_of_the_process_whose_pid_and_host_it_bears() -> None:
    assert is_of_process(PREFIX, 0x3C5D, OURS)
    assert is_of_process(PREFIX, 0x13C5D, OURS)
    assert not is_of_process(PREFIX, 0x3C5E, OURS)
    assert not is_of_process(PREFIX, 0x3C5D, "010f0a04" + OURS[8:])


def test_it_is_sent_to_the_peers_of_an_observer_that_finds_nobody_else() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(10)
        port = peer.getsockname()[1]
        url = parse(f"udpv4://127.0.0.1:7911?multicast=off&peer=127.0.0.1:{port}")
        remove_participants([PREFIX], 0, (url,), {})
        assert peer.recv(65536)[8:20].hex() == PREFIX
