"""What really went over a host's interface: packets, decoded down to whose DDS data they carry.

Owns: `Capture`, an AF_PACKET socket (packet(7)) of a host read by a thread, and the decoding of
IPv4 (RFC 791), IPv6 (RFC 8200), UDP, TCP (RFC 9293) and RTPS (DDSI-RTPS 2.5 §9.4). A writer's
topic is learnt from its announcement on the wire (§9.6.3: PID_TOPIC_NAME, PID_ENDPOINT_GUID), from
nobody's word.
"""

from __future__ import annotations

import contextlib
import dataclasses
import ipaddress
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator

from tests.net.fragments import IPV6_FRAGMENT, Fragments
from tests.net.hosts import Host

BOUND_S = 30.0
"""Seconds that anything may take to be on the wire, on a busy machine; a wait ends with it."""

_ETH_P_ALL = 0x0003
_ETH_P_IP = 0x0800
_ETH_P_IPV6 = 0x86DD
_OUTGOING = 4  # linux/if_packet.h, PACKET_OUTGOING
_TCP, _UDP = 6, 17
_PROTOCOLS = {_TCP: "tcp", _UDP: "udp"}
_UDP_HEADER = 8
_BUFFER_BYTES = 1 << 24
_RCVBUFFORCE = 33  # asm-generic/socket.h, SO_RCVBUFFORCE: beyond net.core.rmem_max, for root
_SOL_PACKET, _STATISTICS = 263, 6  # linux/socket.h, linux/if_packet.h
_END_S = 5.0

_DATA, _DATA_FRAG, _INFO_DST, _PAD, _INFO_TS = 0x15, 0x16, 0x0E, 0x01, 0x09
_ACKNACK = 0x06
_SUBSCRIPTIONS_WRITER = bytes.fromhex("000004c2")
_PUBLICATIONS_WRITER = bytes.fromhex("000003c2")  # DDSI-RTPS Table 9.1
_PARTICIPANT_WRITER = bytes.fromhex("000100c2")
_BUILTIN = 0xC0  # the two highest bits of an entity kind, DDSI-RTPS §9.3.1.2
_TOPIC_NAME, _ENDPOINT_GUID, _SENTINEL = 0x0005, 0x005A, 0x0001
_FRAMED = b"RTCP"
_MINE = b"rt/"
"""Topics of ROS users begin so on DDS (ROS 2 design, "Topic and Service name mapping")."""


@dataclasses.dataclass(frozen=True)
class Packet:
    """One IP packet with a UDP datagram, or the first fragment of one, or with a TCP segment.

    Attributes:
        at_s: time.monotonic() when it was read.
        interface: which it passed.
        protocol: "udp" or "tcp".
        outgoing: this host sent it.
        flow_label: 0 for IPv4.
        fragmented: it is a piece of a datagram; only the first piece has ports (others: 0).
        participant: GUID prefix of the RTPS message; empty if it is none.
        discovers: it announces the participant itself (SPDP).
        writers: GUIDs whose DATA it carries, discovery's among them.
        acknowledges: GUIDs of readers whose ACKNACK it carries, discovery's among them.
        payload: what UDP or TCP carries; empty for later fragments.
    """

    at_s: float
    outgoing: bool
    interface: str
    protocol: str
    source: str
    source_port: int
    destination: str
    destination_port: int
    dscp: int
    ecn: int
    flow_label: int
    ttl: int
    size: int
    fragmented: bool
    participant: bytes = b""
    discovers: bool = False
    writers: tuple[bytes, ...] = ()
    acknowledges: tuple[bytes, ...] = ()
    payload: bytes = dataclasses.field(default=b"", repr=False)

    @property
    def flow(self) -> tuple[str, int, str, int]:
        """The 5-tuple without the protocol."""
        return self.source, self.source_port, self.destination, self.destination_port

    @property
    def ipv6(self) -> bool:
        """Its family."""
        return ":" in self.source

    @property
    def multicast(self) -> bool:
        """It goes to a group."""
        return ipaddress.ip_address(self.destination).is_multicast


class Capture:
    """Reads an interface of a host until it is closed; use it in a `with`.

    Args:
        interface: its name; empty for all of the host.
    """

    def __init__(self, host: Host, interface: str = "e0") -> None:
        # Without the link layer's header, and with all of the packet: announcements are long.
        self._socket = host.socket(socket.AF_PACKET, socket.SOCK_DGRAM)
        # Whatever the kernel has no room for was on the wire all the same: a missed announcement
        # leaves all the data of its writer without a topic.
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, _RCVBUFFORCE, _BUFFER_BYTES)
        except PermissionError:  # root of a user namespace alone
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        self._lost = 0
        self._socket.bind((interface, _ETH_P_ALL))
        self._over, self._close = socket.socketpair()
        self._packets: list[Packet] = []
        self._topics: dict[bytes, str] = {}
        self._read_topics: dict[bytes, str] = {}  # by GUID of the reader
        self._fragments = Fragments()
        self._more = threading.Condition()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def packets(self) -> list[Packet]:
        """Return what was read so far."""
        with self._more:
            return list(self._packets)

    def topic(self, writer: bytes) -> str:
        """Return the ROS topic of a writer's GUID; empty while it was not announced."""
        return self._topics.get(writer, "")

    def writers(self, topic: str) -> set[bytes]:
        """Return the GUIDs of a ROS topic's writers that were announced on the wire."""
        with self._more:
            return {writer for writer, each in self._topics.items() if each == topic}

    def data(self, topic: str, *, outgoing: bool | None = True) -> list[Packet]:
        """Return the packets that carry messages of a ROS topic, `/video`.

        Args:
            topic: fully qualified.
            outgoing: only those this host sent, or received; None for all.
        """
        return [
            packet
            for packet in self.packets()
            if outgoing in (None, packet.outgoing)
            and any(self.topic(writer) == topic for writer in packet.writers)
        ]

    def acknowledgements(self, topic: str, *, outgoing: bool) -> list[Packet]:
        """Return the packets in which a reader of a ROS topic acknowledges."""
        return [
            packet
            for packet in self.packets()
            if packet.outgoing is outgoing
            and any(self._read_topics.get(each) == topic for each in packet.acknowledges)
        ]

    def wait(self, holds: Callable[[], object], *, timeout_s: float = BOUND_S) -> None:
        """Wait, woken by each packet, until something holds.

        Raises:
            TimeoutError: it does not.
        """
        deadline = time.monotonic() + timeout_s
        with self._more:
            while not holds():
                if not self._more.wait(deadline - time.monotonic()) and not holds():
                    raise TimeoutError(f"not on the wire within {timeout_s:g} s; {self.summary()}")

    def wait_data(self, topic: str, count: int = 5, *, timeout_s: float = BOUND_S) -> list[Packet]:
        """Wait until this host has sent so many packets with messages of a topic; return them."""
        self.wait(lambda: len(self.data(topic)) >= count, timeout_s=timeout_s)
        return self.data(topic)

    def summary(self) -> str:
        """Say which user topics were sent by which flows, for messages."""
        flows: dict[tuple[object, ...], int] = {}
        for packet in self.packets():
            for writer in packet.writers:
                if topic := self.topic(writer):
                    key = (topic, *packet.flow, packet.dscp)
                    flows[key] = flows.get(key, 0) + 1
        return f"{len(self.packets())} packets, {self._missed()} missed; {flows}"

    def close(self) -> None:
        """Stop reading, with what has passed until now.

        Raises:
            OSError: packets passed that were not read; what was not seen proves nothing then.
        """
        self._close.close()
        self._thread.join()
        missed = self._missed()
        self._socket.close()
        self._over.close()
        if missed:
            raise OSError(f"cannot say what was on the wire: {missed} packets were not read")

    def _missed(self) -> int:
        """Return how many packets the kernel had no room for."""
        if self._socket.fileno() >= 0:
            counted = self._socket.getsockopt(_SOL_PACKET, _STATISTICS, 8)  # which sets them to 0
            self._lost += struct.unpack("=II", counted)[1]
        return self._lost

    def __enter__(self) -> Capture:  # noqa: PYI034 - Self is Python 3.11's
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _read(self) -> None:
        poll = select.poll()
        poll.register(self._socket, select.POLLIN)
        poll.register(self._over, select.POLLIN)
        end = float("inf")
        while time.monotonic() < end:
            ready = {number for number, _ in poll.poll()}
            if self._over.fileno() in ready:
                if self._socket.fileno() not in ready:
                    return
                end = min(end, time.monotonic() + _END_S)
            if self._socket.fileno() not in ready:
                continue
            with contextlib.suppress(OSError):  # an interface that goes down is no reason to end
                octets, (interface, protocol, kind, *_) = self._socket.recvfrom(0x10000)
                self._take(octets, protocol, interface=interface, outgoing=kind == _OUTGOING)

    def _take(self, octets: bytes, protocol: int, *, interface: str, outgoing: bool) -> None:
        if protocol == _ETH_P_IP:
            packet = _ipv4(octets, outgoing=outgoing)
        elif protocol == _ETH_P_IPV6:
            packet = _ipv6(octets, outgoing=outgoing)
        else:
            return
        if packet is None:
            return
        packet = dataclasses.replace(packet, interface=interface)
        message = self._fragments.add(octets)[_UDP_HEADER:]
        if message[:4] == b"RTPS":
            self._learn_all(message)
        writers: list[bytes] = []
        readers: list[bytes] = []
        for message in _messages(packet):
            prefix = message[8:20]
            writers += [prefix + writer for writer, _ in _data(message)]
            readers += [prefix + reader for reader in _acknowledging(message)]
            self._learn_all(message)
            packet = dataclasses.replace(
                packet,
                participant=prefix,
                discovers=any(each[12:] == _PARTICIPANT_WRITER for each in writers),
                writers=tuple(writers),
                acknowledges=tuple(readers),
            )
        with self._more:
            self._packets.append(packet)
            self._more.notify_all()

    def _learn_all(self, message: bytes) -> None:
        for writer, data in _data(message):
            if writer == _PUBLICATIONS_WRITER:
                self._learn(data, self._topics)
            elif writer == _SUBSCRIPTIONS_WRITER:
                self._learn(data, self._read_topics)

    def _learn(self, data: bytes, topics: dict[bytes, str]) -> None:
        guid, topic = _announced(data)
        if guid and topic.startswith(_MINE):
            topics[guid] = "/" + topic[len(_MINE) :].decode()


def _messages(packet: Packet) -> Iterator[bytes]:
    """Yield the RTPS messages that a packet carries.

    Over TCP each follows a header of Fast DDS's own, `RTCP`, length, checksum and logical port: 14
    bytes, then the message. A message that is spread over segments is seen as far as the first.
    """
    if packet.protocol == "udp":
        if packet.payload[:4] == b"RTPS":
            yield packet.payload
        return
    at = packet.payload.find(_FRAMED)
    while at >= 0:
        following = packet.payload.find(_FRAMED, at + 4)
        message = packet.payload[at + 14 : following if following >= 0 else None]
        if message[:4] == b"RTPS":
            yield message
        at = following


def _ipv4(octets: bytes, *, outgoing: bool) -> Packet | None:
    header = (octets[0] & 15) * 4
    (fragment,) = struct.unpack_from(">H", octets, 6)
    if octets[9] not in _PROTOCOLS:
        return None
    (total,) = struct.unpack_from(">H", octets, 2)
    return _packet(
        octets[header : total or None],  # less than the interface's least size is filled up
        protocol=octets[9],
        outgoing=outgoing,
        source=octets[12:16],
        destination=octets[16:20],
        traffic_class=octets[1],
        flow_label=0,
        ttl=octets[8],
        size=len(octets),
        fragmented=bool(fragment & 0x3FFF),
        first=not fragment & 0x1FFF,
    )


def _ipv6(octets: bytes, *, outgoing: bool) -> Packet | None:
    (first_word,) = struct.unpack_from(">I", octets)
    following, rest, fragmented, first = octets[6], octets[40:], False, True
    if following == IPV6_FRAGMENT:
        (offset,) = struct.unpack_from(">H", rest, 2)
        following, rest, fragmented, first = rest[0], rest[8:], True, not offset & 0xFFF8
    if following not in _PROTOCOLS:
        return None
    return _packet(
        rest,
        protocol=following,
        outgoing=outgoing,
        source=octets[8:24],
        destination=octets[24:40],
        traffic_class=first_word >> 20 & 0xFF,
        flow_label=first_word & 0xFFFFF,
        ttl=octets[7],
        size=len(octets),
        fragmented=fragmented,
        first=first,
    )


def _packet(
    carried: bytes,
    *,
    protocol: int,
    outgoing: bool,
    source: bytes,
    destination: bytes,
    traffic_class: int,
    flow_label: int,
    ttl: int,
    size: int,
    fragmented: bool,
    first: bool,
) -> Packet:
    ports = struct.unpack_from(">HH", carried) if first else (0, 0)
    header = _UDP_HEADER if protocol == _UDP or not first else (carried[12] >> 4) * 4
    return Packet(
        at_s=time.monotonic(),
        outgoing=outgoing,
        interface="",
        protocol=_PROTOCOLS[protocol],
        source=str(ipaddress.ip_address(source)),
        source_port=ports[0],
        destination=str(ipaddress.ip_address(destination)),
        destination_port=ports[1],
        dscp=traffic_class >> 2,
        ecn=traffic_class & 3,
        flow_label=flow_label,
        ttl=ttl,
        size=size,
        fragmented=fragmented,
        payload=carried[header:] if first else b"",
    )


def _data(message: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield (writer entity id, serialized payload) of each DATA and DATA_FRAG."""
    for kind, submessage, order in _submessages(message):
        if kind in (_DATA, _DATA_FRAG) and len(submessage) >= 16:
            yield submessage[12:16], _payload(submessage, order)


def _acknowledging(message: bytes) -> Iterator[bytes]:
    """Yield the reader entity id of each ACKNACK."""
    for kind, submessage, _ in _submessages(message):
        if kind == _ACKNACK and len(submessage) >= 8:
            yield submessage[4:8]


def _submessages(message: bytes) -> Iterator[tuple[int, bytes, str]]:
    """Yield (kind, octets with their header, byte order) of each submessage."""
    at = 20
    while at + 4 <= len(message):
        kind, flags = message[at], message[at + 1]
        order = "<" if flags & 1 else ">"
        (length,) = struct.unpack_from(f"{order}H", message, at + 2)
        end = at + 4 + length
        if length == 0 and kind not in (_PAD, _INFO_TS):
            end = len(message)  # the last submessage may leave its length out
        yield kind, message[at:end], order
        at = end


def _payload(submessage: bytes, order: str) -> bytes:
    """Return the payload of a DATA with its encapsulation; empty after inline QoS, or if none."""
    flags = submessage[1]
    if submessage[0] != _DATA or flags & 0x02 or not flags & 0x04:
        return b""
    (to_inline_qos,) = struct.unpack_from(f"{order}H", submessage, 6)
    return submessage[8 + to_inline_qos :]


def _announced(data: bytes) -> tuple[bytes, bytes]:
    """Return (GUID, topic name) of an announced writer; empty what is not there."""
    guid = topic = b""
    if len(data) < 4:
        return guid, topic
    order = "<" if data[1] & 1 else ">"  # PL_CDR_LE is 0x0003, PL_CDR_BE 0x0002
    at = 4
    while at + 4 <= len(data):
        name, length = struct.unpack_from(f"{order}HH", data, at)
        value = data[at + 4 : at + 4 + length]
        if name == _SENTINEL or len(value) < length:
            break  # the end, or a TCP segment ends here and the rest is in another
        if name == _ENDPOINT_GUID:
            guid = value[:16]
        if name == _TOPIC_NAME:
            (size,) = struct.unpack_from(f"{order}I", value)
            topic = value[4 : 4 + size - 1]
        at += 4 + length
    return guid, topic
