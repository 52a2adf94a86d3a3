"""Dead TCP connections of Fast DDS, and removing the DDS participants of a killed process at once.

Owns: which TCP connections of this process count as dead (not answered any more) and which as
unused, read from the kernel (TCP_INFO of tcp(7)); and where the message is sent by which a
participant leaves, for one whose process was killed and cannot say it. Must not import rclpy.

Fast DDS 2.14 never returns from the destruction of a participant whose connection is cut, until its
socket is shut down; and it never uses a connection whose first answer arrived before the connecting
thread had noted what to request next: only another participant, on another port, helps then.

Every participant that had discovered the dead one drops it and all of its endpoints as if it had
left properly. Without the message, they show a killed process until its lease has run out, 20 s by
default. A receiver cannot check who wrote the message, so callers must know that the process is
dead, and that the participant was that process's.
"""

from __future__ import annotations

import contextlib
import ipaddress
import socket
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from lifecycle.middleware.discovery.messages import disposal
from lifecycle.middleware.discovery.probe import ProbeTarget, probe_targets, send
from lifecycle.middleware.fastdds.sockets import own_udp_socket, sockets_here, udp_sockets_of
from lifecycle.network.connection_url import ConnectionUrl
from lifecycle.network.medium import UDP_UNICAST, Medium

_UNANSWERED = 2
"""Retransmissions in a row after which a connection is dead for a leaving process: the kernel
sends again after 0.2 s and 0.6 s at the earliest, and participants send something each 0.5 s."""

_SYN_SENT = 2  # tcp_states.h
_ESTABLISHED = 1
_STATE, _RETRANSMITS, _PROBES = 0, 2, 3  # offsets in struct tcp_info
_LAST_RECEIVED_MS, _BYTES_ACKED, _BYTES_RECEIVED = 52, 120, 128

_FIRST_REQUEST = 100
"""Bytes; the request by which Fast DDS begins has 68, and the next one 38 more."""

_IDLE_MS = 500
"""A connection in use says what it wants next within a millisecond of the first answer, and on a
machine with both processors busy within 0.1 s."""


def give_up_dead_connections() -> int:
    """Shut down every TCP connection of this process that is not answered; return how many.

    For a process that is about to end: an accepted connection that is shut down is not made again.
    """
    count = 0
    for each in sockets_here():
        with contextlib.suppress(OSError):  # closed since
            if each.type == socket.SOCK_STREAM and _is_dead(each):
                each.shutdown(socket.SHUT_RDWR)
                count += 1
    return count


def is_used(address: str, port: int) -> bool | None:
    """Return whether the connection that this process dialled is used by Fast DDS.

    Args:
        address: IPv4, of the other end.
        port: likewise.

    Returns:
        None while that is open: there is no connection yet, or it has only just begun.
    """
    for each in sockets_here():
        if (each.family, each.type) != (socket.AF_INET, socket.SOCK_STREAM):
            continue
        with contextlib.suppress(OSError):  # not connected yet
            if each.getpeername() == (address, port):
                return _is_used(each.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256))
    return None


def _is_used(info: bytes) -> bool | None:
    if len(info) < _BYTES_RECEIVED + 8:
        return True  # before Linux 4.2 it cannot be known
    (idle_ms,) = struct.unpack_from("=I", info, _LAST_RECEIVED_MS)
    acked, received = struct.unpack_from("=QQ", info, _BYTES_ACKED)
    if acked >= _FIRST_REQUEST:
        return True
    return False if received and idle_ms >= _IDLE_MS else None


def _is_dead(each: socket.socket) -> bool:
    if each.family not in (socket.AF_INET, socket.AF_INET6):
        return False
    info = each.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 8)
    if info[_STATE] == _SYN_SENT:
        return True
    return info[_STATE] == _ESTABLISHED and max(info[_RETRANSMITS], info[_PROBES]) >= _UNANSWERED


_HOST_DIGITS = slice(4, 8)
_PID_DIGITS = slice(8, 12)
PROCESS_DIGITS = 16
"""Of a GUID prefix in hex: Fast DDS 2.14 writes vendor, host and process into it, and a number of
its own behind them (GuidPrefix_t::create); all participants of a process share so many digits."""


def is_of_process(prefix: str, pid: int, like: str) -> bool:
    """Return whether a participant may be one of a process of this host, by its GUID prefix.

    Fast DDS keeps the lower 16 bits of a pid: False is certain, True is not.

    Args:
        prefix: 24 hex digits.
        pid: of the process.
        like: the prefix of a participant on this host.
    """
    written = (pid & 0xFFFF).to_bytes(2, "little").hex()
    return is_of_host(prefix, like) and prefix[_PID_DIGITS] == written


def is_of_host(prefix: str, like: str) -> bool:
    """Return whether a participant is one of this host, by its GUID prefix.

    Args:
        prefix: 24 hex digits.
        like: the prefix of a participant on this host.
    """
    return prefix[: _HOST_DIGITS.stop] == like[: _HOST_DIGITS.stop]


def is_alone(pid: int) -> bool:
    """Return whether no other process of this host bears the same in its GUID prefixes."""
    most = int(Path("/proc/sys/kernel/pid_max").read_text(encoding="ascii"))
    others = (each for each in range(pid & 0xFFFF, most + 1, 0x10000) if each != pid)
    return not any(Path(f"/proc/{each}").exists() for each in others)


def remove_participants(
    prefixes: Iterable[str],
    domain_id: int,
    urls: Sequence[ConnectionUrl],
    environment: Mapping[str, str],
    pids: Iterable[int] = (),
) -> None:
    """Make all peers drop participants whose process is dead.

    It is sent to all that an observer with these URLs could find by UDP, and to the UDP sockets of
    some processes, whose participants may be connected by ports that only they know. Nothing is
    sent to those reached over shared memory or TCP alone: for them the lease has to run out. Our
    own observer does not count what is dead (`StaleNodeFilter.ignore`).

    Args:
        prefixes: GUID prefixes, 24 hex digits each.
        domain_id: 0–232.
        urls: of this process's observer.
        environment: see `probe.probes_for`.
        pids: of processes on this host that must forget them too.
    """
    messages = [disposal(each) for each in prefixes]
    targets = {
        kind: [*_asked(domain_id, urls, environment, kind), *found]
        for kind, found in listening(pids).items()
    }
    output = next((url.output_port for url in urls if url.output_port), None)
    for kind in UDP_UNICAST:
        if not targets[kind]:
            continue
        family = kind.socket_family
        own = None if output is None else own_udp_socket(family, output)
        with contextlib.suppress(OSError), own or socket.socket(family, socket.SOCK_DGRAM) as by:
            for message in messages:
                send(by, message, dict.fromkeys(targets[kind]))


def _asked(
    domain_id: int, urls: Sequence[ConnectionUrl], environment: Mapping[str, str], kind: Medium
) -> Iterator[ProbeTarget]:
    for found, targets in probe_targets(domain_id, urls, environment):
        if found == kind:
            yield from targets


def listening(pids: Iterable[int]) -> dict[Medium, dict[ProbeTarget, int]]:
    """Return where processes of this host receive UDP, by medium; the values are their pids."""
    found: dict[Medium, dict[ProbeTarget, int]] = {kind: {} for kind in UDP_UNICAST}
    for pid, sockets in udp_sockets_of(pids).items():
        for each in sockets:
            if each.kind not in found or ipaddress.ip_address(each.address).is_multicast:
                continue
            any_ = ipaddress.ip_address(each.address).is_unspecified
            address = each.kind.loopback if any_ else each.address
            found[each.kind][ProbeTarget(address=address, port=each.port)] = pid
    return found
