"""Which participants of this host receive nothing any more, the supervisor's own included.

Owns: `watch_reception`, which turns what the kernel says of unread sockets
(middleware/process/reception.py) into silent nodes. No event tells of it, so it looks each
`EACH_S`. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Iterable

from lifecycle.middleware import Reception
from lifecycle.supervisor.health.liveliness import Cause
from lifecycle.supervisor.nodes.system import System

EACH_S = 2.0
"""With two looks and what `Reception` waits, a deadlocked participant is known 22 to 27 s after
something came that it does not read; participants announce themselves each 3 s."""


async def watch_reception(
    system: System, deadlocked: Callable[[Iterable[int]], dict[int, str]] | None = None
) -> None:
    """Follow who leaves unread what it receives, until cancelled.

    Args:
        system: whose nodes fall silent and come back.
        deadlocked: see `Reception.deadlocked`; by default that of a new one.
    """
    deadlocked = Reception().deadlocked if deadlocked is None else deadlocked
    monitor = system.liveliness
    silent: dict[int, tuple[str, ...]] = {}
    while True:
        await asyncio.sleep(EACH_S)
        names = _names(system)
        found = deadlocked([os.getpid(), *names])
        monitor.observer_is_deadlocked(found.pop(os.getpid(), ""))
        for pid in silent.keys() - found.keys():
            monitor.came_back(silent.pop(pid), Cause.DEADLOCKED)
        for pid, how in found.items():
            silent[pid] = names[pid]
            monitor.fell_silent(names[pid], Cause.DEADLOCKED, f"its participant (pid {pid}) {how}")


def _names(system: System) -> dict[int, tuple[str, ...]]:
    """Return the names of the nodes of each process of this host, by pid."""
    return {
        each.pid: tuple(system.nodes[key].name for key in each.planned.nodes if key in system.nodes)
        for each in system.processes.values()
        if each.pid and not each.is_gone
    }
