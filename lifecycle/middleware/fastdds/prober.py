"""The prober: a DDS participant that makes every other one that can be reached answer at once.

Owns: what it sends and receives, and for how long discovery may still miss another one. It has a
GUID prefix and a vendor id of its own (DDSI-RTPS 2.3 §8.5.3, §9.6.2), no endpoints but those by
which participants find each other, and it leaves by a message once it has asked. Must not import
rclpy.

Why: Fast DDS 2.14 sends a new participant's first announcement before it listens, so an answer on
the same host is often lost, and who answered is quiet for its next 3 s. The prober joins once our
participant does listen, and is answered at its own socket, which counts, and at our participant's.
"""

from __future__ import annotations

import atexit
import contextlib
import ipaddress
import os
import re
import socket
import struct
import threading
import time
import weakref
from collections.abc import Iterable, Sequence

from lifecycle.middleware.fastdds.discovery import SETTLE_S, Reach, Target
from lifecycle.middleware.fastdds.profiles import PARTICIPANT_LEASE_S
from lifecycle.middleware.fastdds.sockets import OpenSocket, udp_sockets_of_others
from lifecycle.middleware.process.process_table import PROCESS_DIGITS, is_of_host

ANSWER_S = 0.15
"""A participant that is asked, on this host or the next one, answers within so long."""

_JOINED_S = 2.0
"""The prober leaves after so long: who has no processor answers late, and not one that is gone."""

_OFTEN_S = 2.0
"""For so long a participant of ours announces itself often (middleware/fastdds/profiles.py)."""

_VENDOR = b"LC"
"""Vendor ids of others begin with 1 (DDSI-RTPS 2.3 §9.3.1.2)."""

_PREFIX = slice(8, 20)
_HEADER = b"RTPS\x02\x03" + _VENDOR
_PARTICIPANT = b"\x00\x00\x01\xc1"
_SPDP_READER, _SPDP_WRITER = b"\x00\x01\x00\xc7", b"\x00\x01\x00\xc2"
_PL_CDR_LE = b"\x00\x03\x00\x00"
_INLINE_QOS, _DATA, _KEY = 0x02, 0x04, 0x08  # flags of DATA; 0x01 is little endian
_UDPV4, _UDPV6 = 1, 2  # LOCATOR_KIND_UDPv4 and LOCATOR_KIND_UDPv6

_LOCATOR = re.compile(rb"\x32\x00\x18\x00[\x01\x02]\x00\x00\x00(.{4})", re.DOTALL)
"""PID_METATRAFFIC_UNICAST_LOCATOR over UDP, and its port; this host is little-endian."""


def _parameters(*parameters: tuple[int, bytes]) -> bytes:
    return b"".join(struct.pack("<HH", pid, len(value)) + value for pid, value in parameters)


_SENTINEL = _parameters((0x0001, b""))
_LEFT = _parameters((0x0071, b"\x00\x00\x00\x03"))  # PID_STATUS_INFO: disposed and unregistered


def joins(prefix: bytes, sequence: int, locators: Iterable[tuple[str, int]]) -> bytes:
    """Return the message by which a participant with a prefix of 12 bytes announces itself.

    Args:
        prefix: of its GUID.
        sequence: ≥ 1, above that of its last message.
        locators: IP addresses and UDP ports at which it is answered.
    """
    located = []
    for address, port in locators:
        packed = ipaddress.ip_address(address).packed
        kind = _UDPV6 if len(packed) == 16 else _UDPV4
        locator = struct.pack("<iI", kind, port) + packed.rjust(16, b"\0")
        # PID_METATRAFFIC_UNICAST_LOCATOR, PID_DEFAULT_UNICAST_LOCATOR
        located += [(0x0032, locator), (0x0031, locator)]
    content = _parameters(
        (0x0015, b"\x02\x03\x00\x00"),  # PID_PROTOCOL_VERSION
        (0x0016, _VENDOR + b"\x00\x00"),  # PID_VENDORID
        (0x0050, prefix + _PARTICIPANT),  # PID_PARTICIPANT_GUID
        (0x0002, struct.pack("<iI", PARTICIPANT_LEASE_S, 0)),  # PID_PARTICIPANT_LEASE_DURATION
        (0x0058, struct.pack("<I", 0x3)),  # PID_BUILTIN_ENDPOINT_SET: announcer and detector
        *located,
    )
    return _message(prefix, sequence, _DATA, _PL_CDR_LE + content + _SENTINEL)


def leaves(prefix: bytes, sequence: int) -> bytes:
    """Return the message by which a participant leaves, see `joins`."""
    guid = prefix + _PARTICIPANT
    inline_qos = _parameters((0x0070, guid)) + _LEFT + _SENTINEL  # PID_KEY_HASH
    key = _PL_CDR_LE + _parameters((0x0050, guid)) + _SENTINEL
    return _message(prefix, sequence, _INLINE_QOS | _KEY, inline_qos + key)


def _message(prefix: bytes, sequence: int, flags: int, content: bytes) -> bytes:
    """Return one DATA of a participant's announcer, with its time."""
    info_timestamp = struct.pack("<BBHII", 0x09, 0x01, 8, int(time.time()), 0)
    body = struct.pack("<HH", 0, 16) + _SPDP_READER + _SPDP_WRITER
    body += struct.pack("<iI", 0, sequence) + content
    data = struct.pack("<BBH", 0x15, 0x01 | flags, len(body)) + body
    return _HEADER + prefix + info_timestamp + data


class Prober:
    """One participant that joins and leaves as often as all others are to answer; `close` it.

    Args:
        reached: whom it asks, and where.

    Attributes:
        leaves_host: it asks participants of other hosts, too.
        ports: at which those that answered receive discovery, as they say.
    """

    def __init__(self, reached: Sequence[Reach]) -> None:
        self._reached = reached
        self.leaves_host = any(to.address not in e.addresses for e in reached for to in e.targets)
        self._prefix = _VENDOR + os.urandom(10)
        self._sequence = 0
        self._joined = False
        self._timer: threading.Timer | None = None
        self._lock = threading.Lock()
        self._answers: dict[str, str] = {}
        self._sockets: list[socket.socket] = []
        self.ports: set[int] = set()
        for each in reached:
            made = socket.socket(each.kind.socket_family, socket.SOCK_DGRAM)
            made.bind(("", 0))  # answers arrive at every address we name
            self._sockets.append(made)
        _probers.add(self)

    def ask(self, *, counted: bool = True) -> None:
        """Join anew, so that all answer.

        Args:
            counted: at its own socket, too. Not every RMW answers at each address that a
                participant has: Cyclone DDS chooses one.
        """
        if not self._reached:
            return
        with self._lock:
            self._leave()
            self._joined = True
            self._sequence += 1
            for each, own in zip(self._reached, self._sockets, strict=True):
                port = own.getsockname()[1]
                ports = (*([port] if counted else []), *each.receivers)
                # Fast DDS keeps the first four of them.
                locators = [(address, port) for address in each.addresses for port in ports]
                _send(own, joins(self._prefix, self._sequence, locators), each.targets)
            timer = self._timer = threading.Timer(_JOINED_S, self.leave)
            timer.daemon = True
            with contextlib.suppress(RuntimeError):  # no thread is left: it leaves in the end
                timer.start()

    def leave(self) -> None:
        """Say that it is there no more; harmless if it is not."""
        with self._lock:
            self._leave()

    def _leave(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        if self._joined:
            self._joined = False
            self._sequence += 1
            for each, own in zip(self._reached, self._sockets, strict=True):
                _send(own, leaves(self._prefix, self._sequence), each.targets)

    def answers(self) -> dict[str, str]:
        """Return the IP address from which each participant answered so far, by GUID prefix."""
        with self._lock:
            for own in self._sockets:
                with contextlib.suppress(BlockingIOError):
                    while True:
                        self._take(*own.recvfrom(65536, socket.MSG_DONTWAIT))
            return dict(self._answers)

    def _take(self, data: bytes, source: tuple[str, int]) -> None:
        prefix = data[_PREFIX]
        if len(prefix) < 12 or not data.startswith(b"RTPS") or _LEFT in data:
            return
        self._answers[prefix.hex()] = source[0]
        self.ports.update(int.from_bytes(each[1], "little") for each in _LOCATOR.finditer(data))

    def listeners(self) -> frozenset[OpenSocket]:
        """Return the UDP sockets of other processes on this host that are asked."""
        asked: dict[int, set[str]] = {}
        for each in self._reached:
            for target in each.targets:
                if target.address in each.addresses:
                    asked.setdefault(target.port, set()).add(target.address)
        if not asked:
            return frozenset()
        return frozenset(
            each
            for each in udp_sockets_of_others()
            if (at := asked.get(each.port))
            and (each.address in at or ipaddress.ip_address(each.address).is_unspecified)
        )

    def close(self) -> None:
        """Leave for good."""
        with self._lock:
            self._leave()
            for each in self._sockets:
                each.close()
            self._reached, self._sockets = (), []


_probers: weakref.WeakSet[Prober] = weakref.WeakSet()


@atexit.register
def leave_all() -> None:
    """Have each prober of this process leave."""
    for each in tuple(_probers):
        each.leave()


def _send(sender: socket.socket, message: bytes, targets: Iterable[Target]) -> None:
    """Send a datagram to each destination; a full buffer or a missing route costs one of them."""
    for target in targets:
        with contextlib.suppress(OSError):
            if target.interface:
                index = socket.if_nametoindex(target.interface)
                if sender.family is socket.AF_INET6:
                    sender.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF, index)
                else:  # struct ip_mreqn of ip(7)
                    by = struct.pack("=4s4si", bytes(4), bytes(4), index)
                    sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, by)
            sender.sendto(message, socket.MSG_DONTWAIT, target[:2])


class Settling:
    """For how long what discovery shows may still miss a participant.

    A participant that answered the prober and whose node is not known is on its way into the graph,
    and so is one of this host that has a port for discovery and did not answer. Where nobody can be
    asked, it is a time.

    Args:
        reached: whom our participant, which listens already, can ask.
        settle_s: seconds in which everybody is known.

    Attributes:
        prober: which asks; without anybody to ask it does nothing.
    """

    def __init__(self, reached: Sequence[Reach], settle_s: float = SETTLE_S) -> None:
        self._settle_s = settle_s
        self._began_s = time.monotonic()
        self._again_s = ANSWER_S
        self._asks = bool(reached)
        self.prober = Prober(reached)
        self._familiar: frozenset[OpenSocket] = frozenset()
        self._named: frozenset[str] = frozenset()
        self._own = ""
        self._known: frozenset[str] = frozenset()
        self._known_before: frozenset[str] = frozenset()
        self._silent = self.prober.listeners()
        self.prober.ask()

    def within(self, settle_s: float) -> None:
        """Take so many seconds for those in which everybody is known, where nobody can be asked."""
        if not self._asks:
            self._settle_s = settle_s

    @property
    def unasked_s(self) -> float:
        """Seconds that are waited for because nobody can be asked; 0 where all can be."""
        return 0.0 if self._asks else self._settle_s

    def saw(self, named: frozenset[str], own: str) -> None:
        """Take what a look has shown; what follows is about that look.

        Args:
            named: GUID prefixes (24 hex digits) of participants of which some node is known now.
            own: that of our participant; empty while it is not known.
        """
        self._named, self._own = named, own
        self._known |= named  # who was known and left is not on the way into the graph

    def left_s(self) -> float:
        """Return for how many seconds a look may still miss a participant; 0 once it cannot."""
        age_s = time.monotonic() - self._began_s
        left_s = max(0.0, self._settle_s - age_s)
        if not (self._asks and left_s):
            return left_s
        if age_s < ANSWER_S:
            return ANSWER_S - age_s
        unknown = self.prober.answers().keys() - self._known
        self._silent = frozenset(
            each for each in self._silent if each.port not in self.prober.ports
        )
        if self._silent:  # only those that are still there
            self._silent &= self.prober.listeners()
        if not unknown and not self._silent:
            return 0.0
        if age_s >= self._again_s:
            self._again_s = 2 * age_s
            self.prober.ask(counted=bool(self._silent))
        return min(left_s, ANSWER_S)

    def expect_newcomers(self, *, everybody: bool = False) -> bool:
        """Have `left_s` wait for who came since; return whether there may be anybody.

        Where this host has more new sockets than the graph shows new participants, one is not seen
        yet. On other hosts they have to be asked.

        Args:
            everybody: wait also for what those have to say that are known: this process did not
                run for a while.
        """
        if not self._asks:
            if everybody:
                self._began_s = time.monotonic()
            return everybody
        if self.left_s() > 0 and not everybody:
            return True
        everybody |= self.prober.leaves_host and time.monotonic() - self._began_s > _OFTEN_S
        listeners = self.prober.listeners()
        came = listeners - self._familiar
        new = {
            each
            for each in self._named - self._known_before
            if is_of_host(each, self._own) and each[:PROCESS_DIGITS] != self._own[:PROCESS_DIGITS]
        }
        self._familiar, self._known_before = listeners, self._known
        if not everybody and len({each.port for each in came}) <= len(new):
            return False
        # Who answered and did not come into the graph in all of the time is waited for no more.
        self._known |= self.prober.answers().keys()
        self._known_before = self._known
        self.prober.ports.clear()
        self._silent = came
        self._began_s, self._again_s = time.monotonic(), ANSWER_S
        self.prober.ask()
        return True

    def close(self) -> None:
        """Ask nobody any more."""
        self.prober.close()
