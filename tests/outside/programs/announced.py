"""Says which DDS participants of a domain came and left on loopback: one JSON object a message.

Read from packets (packet(7)), so that the domain itself is undisturbed; only root may. It prints
`ready`, and ends with its standard input.
"""

from __future__ import annotations

import json
import os
import select
import socket
import struct
import sys

SPDP_WRITER = bytes.fromhex("000100c2")  # DDSI-RTPS Table 9.1
STATUS_INFO, LEASE, SENTINEL = 0x0071, 0x0002, 0x0001


def parameters(data: bytes, little: bool):
    """Yield the parameters of a list (DDSI-RTPS 9.4.2.11), and last the bytes that it took."""
    at, order = 0, "<" if little else ">"
    while at + 4 <= len(data):
        pid, size = struct.unpack_from(f"{order}HH", data, at)
        if pid == SENTINEL:
            yield None, data[at + 4 :]
            return
        yield pid, data[at + 4 : at + 4 + size]
        at += 4 + size


def announcements(message: bytes):
    """Yield GUID prefix, lease in seconds or None: of those that are said to come or to leave."""
    prefix, at = message[8:20].hex(), 20
    while at + 4 <= len(message):
        kind, flags, size = message[at], message[at + 1], 0
        order = "<" if flags & 1 else ">"
        (size,) = struct.unpack_from(f"{order}H", message, at + 2)
        body = message[at + 4 : at + 4 + size] if size else message[at + 4 :]
        if kind == 0x15 and body[8:12] == SPDP_WRITER:
            (skip,) = struct.unpack_from(f"{order}H", body, 2)
            rest, left = body[4 + skip :], False
            if flags & 2:
                for pid, value in parameters(rest, bool(flags & 1)):
                    if pid == STATUS_INFO:
                        left = bool(value[3] & 3)
                    elif pid is None:
                        rest = value
            lease = None
            if flags & 4:
                little = rest[1] & 1 == 1
                for pid, value in parameters(rest[4:], little):
                    if pid == LEASE:
                        whole, part = struct.unpack("<iI" if little else ">iI", value)
                        lease = whole + part / 2**32
            if left or lease is not None:
                yield prefix, None if left else lease
        at += 4 + size if size else len(message)


def main() -> None:
    first = 7400 + 250 * int(os.environ["ROS_DOMAIN_ID"])
    packets = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(0x0800))
    packets.setsockopt(socket.SOL_SOCKET, 33, 1 << 24)  # SO_RCVBUFFORCE
    packets.bind(("lo", 0x0800))
    print("ready", flush=True)
    while True:
        readable, _, _ = select.select([packets, sys.stdin], [], [])
        if packets not in readable:
            return
        data, address = packets.recvfrom(65536)
        header = (data[0] & 15) * 4
        if address[2] == socket.PACKET_OUTGOING or data[9] != socket.IPPROTO_UDP:
            continue
        to, payload = int.from_bytes(data[header + 2 : header + 4], "big"), data[header + 8 :]
        if not first <= to < first + 250 or payload[:4] != b"RTPS":
            continue
        for prefix, lease in announcements(payload):
            print(json.dumps({"prefix": prefix, "lease_s": lease}), flush=True)


if __name__ == "__main__":
    main()
