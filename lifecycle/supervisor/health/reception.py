"""Which participants of this host hear nothing any more, the supervisor's own included.

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
"""Two looks and what `Reception` waits make a deaf participant known after 4 to 9 s, once something
has come that it does not read; participants announce themselves each 3 s."""


async def watch_reception(
    system: System, deaf: Callable[[Iterable[int]], dict[int, str]] | None = None
) -> None:
    """Follow who leaves unread what it receives, until cancelled.

    Args:
        system: whose nodes fall silent and come back.
        deaf: see `Reception.deaf`; by default that of a new one.
    """
    deaf = Reception().deaf if deaf is None else deaf
    monitor = system.liveliness
    silent: dict[int, tuple[str, ...]] = {}
    while True:
        await asyncio.sleep(EACH_S)
        names = _names(system)
        found = deaf([os.getpid(), *names])
        monitor.observer_is_deaf(found.pop(os.getpid(), ""))
        for pid in silent.keys() - found.keys():
            monitor.came_back(silent.pop(pid), Cause.DEAF)
        for pid, how in found.items():
            silent[pid] = names[pid]
            monitor.fell_silent(names[pid], Cause.DEAF, f"its participant (pid {pid}) {how}")


def _names(system: System) -> dict[int, tuple[str, ...]]:
    """Return the names of the nodes of each process of this host, by pid."""
    names = {
        each.pid: tuple(system.nodes[key].name for key in each.planned.nodes if key in system.nodes)
        for each in system.processes.values()
        if each.pid and not each.is_gone
    }
    for adopted in system.adopted:
        if adopted.pid and not adopted.ended.done():
            names[adopted.pid] = tuple(each.full_name for each in adopted.nodes)
    return names
