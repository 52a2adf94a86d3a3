"""Participants that receive nothing any more: threads that leave unread what arrives.

Owns: `Reception`. Fast DDS 2.14 deadlocks for good when a writer leaves to which it is just
answering, and a lease is looked at next: the thread that receives waits for the thread of timers to
be done (ResourceEvent::unregister_timer), and that one for a lock of the former
(PDP::check_remote_participant_liveliness; eProsima/Fast-DDS, issue 6502). The process runs on, its
participant receives nothing, and nothing in it says so. What waits at a UDP socket, and how often a
thread ran, the kernel says (/proc/net/udp, /proc/TID/schedstat; proc(5)). Must not import rclpy.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

from lifecycle import dataclasses

STUCK_S = 20.0
"""A thread that did not run once for so long, with something to read, will not. With 3 s two nodes
in 45 rounds of the soak were taken for deadlocked that may only have been blocked for a while."""

_SOCKET = "socket:["


@dataclasses.dataclass(frozen=True, slots=True)
class _Asleep:
    """Threads that sleep beside something to read: how often each ran, and since when."""

    slices: tuple[str, ...]
    since_s: float


class Reception:
    """Looks, each time it is asked, for processes that leave unread what they receive."""

    def __init__(self) -> None:
        self._unread: frozenset[int] = frozenset()
        self._asleep: dict[tuple[int, int], _Asleep] = {}

    def deadlocked(self, pids: Iterable[int]) -> dict[int, str]:
        """Return who receives nothing any more, and how that shows, as half a sentence.

        One look tells nothing: ask each second or two. A process that was stopped, or whose threads
        wait for a processor, is not deadlocked. Threads of Fast DDS that receive over UDP are
        known; over TCP and shared memory alone nobody is found to be deadlocked.

        Args:
            pids: of processes of this host, in our network namespace.
        """
        ports = dict(_unread())
        again = self._unread & ports.keys()
        self._unread = frozenset(ports)
        asleep: dict[tuple[int, int], _Asleep] = {}
        found: dict[int, str] = {}
        now_s = time.monotonic()
        for pid in pids if again else ():
            for inode in _sockets(pid) & again:
                slices = _slices(pid, f"dds.udp.{ports[inode]}")
                if not slices:
                    continue
                known = self._asleep.get((pid, inode))
                if known is None or known.slices != slices:
                    known = _Asleep(slices, now_s)
                asleep[pid, inode] = known
                if now_s - known.since_s >= STUCK_S:
                    for_s = now_s - known.since_s
                    found[pid] = (
                        f"has left unread for {for_s:.0f} s what arrives at UDP port "
                        f"{ports[inode]}: Fast DDS is deadlocked in it"
                    )
        self._asleep = asleep
        return found


def _unread() -> Iterator[tuple[int, int]]:
    """Yield the sockets at which something waits to be read: inode and port."""
    for name in ("udp", "udp6"):
        with contextlib.suppress(OSError):  # a host may have no IPv6
            for line in Path(f"/proc/self/net/{name}").read_text().splitlines()[1:]:
                words = line.split()
                if int(words[4].partition(":")[2], 16):
                    yield int(words[9]), int(words[1].rpartition(":")[2], 16)


def _sockets(pid: int) -> frozenset[int]:
    """Return the inodes of a process's sockets; none if it is gone, or another user's."""
    found = set()
    with contextlib.suppress(OSError):
        for each in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(OSError):
                target = str(each.readlink())
                if target.startswith(_SOCKET):
                    found.add(int(target[len(_SOCKET) : -1]))
    return frozenset(found)


def _slices(pid: int, name: str) -> tuple[str, ...]:
    """Return how often each thread of this name ran; nothing unless all of them sleep.

    One that is stopped, traced, or ready to run is in another state than S. Sockets of a group and
    of an address may have one port, and threads of one name.
    """
    found = []
    with contextlib.suppress(OSError):
        for each in sorted(Path(f"/proc/{pid}/task").iterdir()):
            if (each / "comm").read_text().rstrip("\n") != name:
                continue
            if (each / "stat").read_text().rpartition(")")[2].split()[0] != "S":
                return ()
            found.append((each / "schedstat").read_text())
    return tuple(found)
