"""Whether a DSCP survives the way between two hosts, by marked datagrams between their supervisors.

Owns: `Marks`: a UDP socket for each IP version, which sends to the addresses that flows go to what
is marked as they are, and reads with what mark such datagrams of others arrive (IP_RECVTOS of
ip(7), IPV6_RECVTCLASS of ipv6(7)). A router may map a DSCP or clear it (RFC 2474 §2), and no socket
of DDS shows that. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
import sys
from collections.abc import Collection, Iterable, Mapping

import msgspec

from lifecycle.codec import DscpValue, from_json, to_json
from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.sockets import DSCP_OPTION, mark
from lifecycle.network.medium import UDP_UNICAST
from lifecycle.network.nfe import is_multicast
from lifecycle.plan.model import Plan
from lifecycle.verify.observation import ArrivedMark
from lifecycle.verify.verdict import FlowReport

OVERDUE_S = 6.0
"""One arrives each second, once a flow is verified on both hosts."""

Ports = tuple[int, int]
"""Where a supervisor receives marks, over IPv4 and IPv6; 0 where it does not."""

_LONGEST = 256
_READ_AT_ONCE = 64
_RECEIVES = {socket.AF_INET: socket.IP_RECVTOS, socket.AF_INET6: socket.IPV6_RECVTCLASS}


class _Mark(msgspec.Struct, frozen=True, kw_only=True):
    """What a datagram says of itself.

    Attributes:
        run: of the supervisor that sent it, as in its notice of its plan.
        dscp: with which it was sent.
        to: the address that it was sent to.
    """

    run: str
    dscp: DscpValue
    to: str


class _Way(msgspec.Struct, frozen=True):
    """To or from another machine: to this address, with this DSCP."""

    machine: str
    dscp: int
    address: str


def carries_marks(plan: Plan) -> bool:
    """Return whether flows with a DSCP pass between machines of a plan."""
    machines = {node.key: node.machine for node in plan.nodes}
    marked = {
        (node.key, each.resolved)
        for node in plan.nodes
        for each in node.endpoints
        if each.dscp is not None
    }
    return any(
        machines[flow.publisher] != machines[flow.subscription]
        and (flow.publisher, flow.topic) in marked
        for flow in plan.flows
    )


class Marks:
    """Marked datagrams to and from the supervisors of other machines; use it in a loop.

    Args:
        run: ours, as others know it.

    Attributes:
        machines: of the supervisors that are known, by their run; what others send is passed over.
        ports: where the supervisors of other machines receive.
    """

    def __init__(self, run: str) -> None:
        self.machines: Mapping[str, Collection[str]] = {}
        self.ports: dict[str, Ports] = {}
        self._run = run
        self._loop = asyncio.get_running_loop()
        self._sockets: dict[int, socket.socket] = {}
        self._to: set[_Way] = set()
        # With what DSCP the last one arrived, and when: none, since they are due.
        self._from: dict[_Way, tuple[int | None, float]] = {}

    @property
    def own_ports(self) -> Ports:
        """Where we receive."""
        four, six = (self._sockets.get(each) for each in _RECEIVES)
        return (four.getsockname()[1] if four else 0, six.getsockname()[1] if six else 0)

    def open(self) -> None:
        """Receive from now on; again is harmless. A host may lack an IP version."""
        for family, receives in _RECEIVES.items():
            if family in self._sockets:
                continue
            with contextlib.suppress(OSError):
                made = socket.socket(family, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
                self._sockets[family] = made
                level, _ = DSCP_OPTION[family]
                if family == socket.AF_INET6:
                    made.setsockopt(level, socket.IPV6_V6ONLY, 1)
                made.setsockopt(level, receives, 1)
                made.bind(("", 0))
                self._loop.add_reader(made, self._read, made)

    def close(self) -> None:
        """Send and receive no more."""
        for each in self._sockets.values():
            self._loop.remove_reader(each)
            each.close()
        self._sockets.clear()

    def follow(
        self, flows: Iterable[FlowReport], machines: Mapping[str, str], own: Collection[str]
    ) -> None:
        """Take the flows of the system as they were verified just now.

        Args:
            flows: all of them.
            machines: of each node, by its full name.
            own: machines that are ours.
        """
        to: set[_Way] = set()
        due: set[_Way] = set()
        for flow in flows:
            publishes, subscribes = (machines.get(each, "") for each in flow.pair[1:])
            if (publishes in own) is (subscribes in own):
                continue
            found, other = (to, subscribes) if publishes in own else (due, publishes)
            found.update(
                _Way(other, each.dscp, each.destination_address)
                for each in (flow.tuples if flow.effective_transport in UDP_UNICAST else ())
                if each.dscp and not is_multicast(each.destination_address)
            )
        self._to = to
        self._from = {each: self._from.get(each, (None, self._loop.time())) for each in due}

    def send(self) -> None:
        """Send one datagram each way; what cannot be sent does not arrive, which the other sees."""
        for way in self._to:
            family = socket.AF_INET6 if ":" in way.address else socket.AF_INET
            port = self.ports.get(way.machine, (0, 0))[family == socket.AF_INET6]
            made = self._sockets.get(family)
            if made is not None and port:
                said = _Mark(run=self._run, dscp=way.dscp, to=way.address)
                with contextlib.suppress(OSError, MiddlewareError):
                    mark(made, way.dscp)
                    made.sendto(to_json(said), (way.address, port))

    def arrived(self) -> tuple[ArrivedMark, ...]:
        """Return with what mark those arrive that must: what does not keep it, if several do."""
        found: dict[tuple[str, int], int | None] = {}
        for way, (dscp, last_s) in self._from.items():
            key = (way.machine, way.dscp)
            if self._loop.time() > last_s + OVERDUE_S:
                found.setdefault(key, None)
            elif dscp is not None and found.get(key) in (None, way.dscp):
                found[key] = dscp
        return tuple(
            ArrivedMark(machine=machine, dscp=dscp, arrives_as=arrives_as)
            for (machine, dscp), arrives_as in sorted(found.items())
        )

    def _read(self, made: socket.socket) -> None:
        for _ in range(_READ_AT_ONCE):
            try:
                data, controls, *_ = made.recvmsg(_LONGEST, socket.CMSG_SPACE(4))
            except OSError as error:
                if error.errno not in (errno.EAGAIN, errno.EWOULDBLOCK):
                    continue  # what one of ours met on its way
                return
            with contextlib.suppress(ValueError):  # anybody may send here
                self._take(from_json(data, _Mark, longest=_LONGEST), controls)

    def _take(self, said: _Mark, controls: Iterable[tuple[int, int, bytes]]) -> None:
        for level, kind, data in controls:
            if (level, kind) not in DSCP_OPTION.values():
                continue
            dscp = int.from_bytes(data, sys.byteorder) >> 2  # IPv4: one byte, IPv6: an int
            for machine in self.machines.get(said.run, ()):
                way = _Way(machine, said.dscp, said.to)
                if way in self._from:
                    self._from[way] = (dscp, self._loop.time())
