"""A DDS participant without rcl: `bare_dds.py --write|--read TOPIC:TYPE … [--node SPACE NAME …]`.

Spoken by hand: it announces itself and its endpoints as DDSI-RTPS 2.3 says (§8.5, §9.6.2.2) on the
loopback, under the vendor id of Cyclone DDS, to every participant of ROS_DOMAIN_ID, and answers
whoever asks who is there. TOPIC and TYPE are DDS's own: `rt/chatter:std_msgs::msg::dds_::String_`.
With `--node` it says on `ros_discovery_info` that it has such nodes, as rmw_dds_common would, which
have the endpoints in turn; with `--ghost PREFIX SPACE NAME` it says so in the name of another
participant, as one that has left may be heard last. Names are taken byte by byte as they are given,
legal or not.
It sends no data besides: what is judged is that it could. Prints `ready` at its first announcement,
and lives until SIGTERM or the end of its parent.
"""

from __future__ import annotations

import argparse
import os
import re
import socket
import struct
import time

ANNOUNCE_S = 0.1
VENDOR = b"\x01\x10"
HEADER = b"RTPS\x02\x03" + VENDOR
PARTICIPANTS = 40
WRITER, READER = 0x03, 0x04
"""The last byte of entity ids of a user's writer and reader without a key (§9.3.1.2)."""

NODES_TOPIC = b"ros_discovery_info"
NODES_TYPE = b"rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"
NODES_WRITER = b"\x00\x00\x01\x03"
NODES_PORTS = range(7000, 7100)
"""rmw_fastrtps reads that topic at the first free port of these, whatever the domain."""

ENCLAVE = b"enclave=/;"
"""By it rmw_dds_common knows a participant of ROS."""

PARTICIPANT_WRITER, PARTICIPANT_READER = b"\x00\x01\x00\xc2", b"\x00\x01\x00\xc7"
BUILTIN = {
    WRITER: (b"\x00\x00\x03\xc2", b"\x00\x00\x03\xc7"),
    READER: (b"\x00\x00\x04\xc2", b"\x00\x00\x04\xc7"),
}
"""Who announces publications and subscriptions, and to whom."""


def parameter(number: int, value: bytes) -> bytes:
    value += bytes(-len(value) % 4)
    return struct.pack("<HH", number, len(value)) + value


def text(value: bytes) -> bytes:
    return struct.pack("<I", len(value) + 1) + value + b"\0"


def aligned(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)


def locator(port: int) -> bytes:
    return struct.pack("<iI", 1, port) + socket.inet_aton("127.0.0.1").rjust(16, b"\0")


def message(
    prefix: bytes, writer: bytes, reader: bytes, parameters: list[bytes], number: int = 1
) -> bytes:
    payload = b"\x00\x03\x00\x00" + b"".join(parameters) + struct.pack("<HH", 1, 0)
    return sample(prefix, writer, reader, payload, number)


def sample(prefix: bytes, writer: bytes, reader: bytes, payload: bytes, number: int) -> bytes:
    body = struct.pack("<HH", 0, 16) + reader + writer + struct.pack("<iI", 0, number) + payload
    return HEADER + prefix + struct.pack("<BBH", 0x15, 0x05, len(body)) + body


def participant(prefix: bytes, port: int) -> bytes:
    return message(
        prefix,
        PARTICIPANT_WRITER,
        PARTICIPANT_READER,
        [
            parameter(0x0015, b"\x02\x03"),
            parameter(0x0016, VENDOR),
            parameter(0x0050, prefix + b"\x00\x00\x01\xc1"),
            parameter(0x0002, struct.pack("<iI", 10, 0)),
            parameter(0x0058, struct.pack("<I", 0x3F)),
            parameter(0x0032, locator(port)),
            parameter(0x0031, locator(port)),
            parameter(0x002C, struct.pack("<I", len(ENCLAVE)) + ENCLAVE),
        ],
    )


def endpoint(
    prefix: bytes, port: int, entity: bytes, topic: bytes, type_: bytes, number: int
) -> bytes:
    announcer, listener = BUILTIN[entity[-1]]
    durability = 1 if topic == NODES_TOPIC else 0  # TRANSIENT_LOCAL, VOLATILE
    return message(
        prefix,
        announcer,
        listener,
        [
            parameter(0x0050, prefix + b"\x00\x00\x01\xc1"),
            parameter(0x005A, prefix + entity),
            parameter(0x0070, prefix + entity),
            parameter(0x0005, text(topic)),
            parameter(0x0007, text(type_)),
            parameter(0x001A, struct.pack("<IiI", 2, 0, 0)),  # RELIABLE
            parameter(0x001D, struct.pack("<I", durability)),
            parameter(0x002F, locator(port)),
        ],
        number,
    )


def nodes(prefix: bytes, claimed: list[list[str]], entities: list[bytes]) -> bytes:
    """Return rmw_dds_common/msg/ParticipantEntitiesInfo in CDR."""
    data = prefix + b"\x00\x00\x01\xc1" + struct.pack("<I", len(claimed))
    for index, names in enumerate(claimed):
        for name in names:
            data = aligned(data) + text(os.fsencode(name))
        data = aligned(data)
        for kind in (READER, WRITER):
            theirs = entities[index :: len(claimed)]
            own = [each for each in theirs if each[-1] == kind]
            data += struct.pack("<I", len(own)) + b"".join(prefix + each for each in own)
    return b"\x00\x01\x00\x00" + data


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--write", action="append", default=[])
    parser.add_argument("--read", action="append", default=[])
    parser.add_argument("--node", nargs=2, action="append", default=[])
    parser.add_argument("--ghost", nargs=3, action="append", default=[])
    options = parser.parse_args()
    prefix = VENDOR + os.urandom(10)
    domain = int(os.environ.get("ROS_DOMAIN_ID", "0"))
    doors = [7400 + 250 * domain + 10 + 2 * n for n in range(PARTICIPANTS)]  # §9.6.2.3
    speaker = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    speaker.bind(("127.0.0.1", 0))
    port = speaker.getsockname()[1]
    # Where others ask who is there: the first discovery port that nobody has.
    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for door in reversed(doors):
        try:
            listener.bind(("127.0.0.1", door))
            break
        except OSError:
            continue
    listener.settimeout(ANNOUNCE_S)
    said = [participant(prefix, port)]
    entities = []
    for kind, asked_for in ((WRITER, options.write), (READER, options.read)):
        for index, spelled in enumerate(asked_for):
            # The last single colon: names may have any, and types have double ones.
            topic, type_ = re.findall(rb"(?s)(.*)(?<!:):(?!:)(.*)", os.fsencode(spelled))[0]
            entities.append(struct.pack(">HBB", 0, 2 + index, kind))
            said.append(endpoint(prefix, port, entities[-1], topic, type_, index + 1))
    claims = []
    if options.node:
        number = len(options.write) + 1
        said.append(endpoint(prefix, port, NODES_WRITER, NODES_TOPIC, NODES_TYPE, number))
        claimed = nodes(prefix, options.node, entities)
        told = [claimed, *(nodes(bytes.fromhex(of), [names], []) for of, *names in options.ghost)]
        for number, each in enumerate(told, 1):
            claims.append(sample(prefix, NODES_WRITER, b"\0\0\0\0", each, number))
    parent = os.getppid()
    asked: set[int] = set()
    first = True
    while os.getppid() == parent:
        for door in (*doors, *asked):
            for each in said:
                speaker.sendto(each, ("127.0.0.1", door))
        for claim in claims:
            for each in NODES_PORTS:
                speaker.sendto(claim, ("127.0.0.1", each))
        if first:
            print("ready", flush=True)
            first = False
        end = time.monotonic() + ANNOUNCE_S
        while time.monotonic() < end:
            try:
                data, source = listener.recvfrom(65536)
            except TimeoutError:
                break
            if data.startswith(b"RTPS") and data[8:20] != prefix:
                asked.add(source[1])


if __name__ == "__main__":
    main()
