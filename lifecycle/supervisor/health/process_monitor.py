"""Runs a phase for as long as every process of the system lives.

Owns: `ProcessMonitor`: what runs in it is ended by the first process that ends unasked.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any

from lifecycle.supervisor.gate.watch import first_death
from lifecycle.supervisor.nodes.bring_up import ALSO_S, died
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.processes.process import ManagedProcess
from lifecycle.supervisor.run.failure import StepFailedError, ended

_SPEAK_S = 0.7 + ALSO_S
"""A step notices its node's death itself within this, and knows what the node was doing."""


class ProcessMonitor:
    """Watch over the processes of one system.

    Attributes:
        dead: names of processes whose end is known, or wanted.
    """

    def __init__(self, system: System) -> None:
        self._system = system
        self.dead: set[str] = set()

    async def during(self, phase: Coroutine[Any, Any, object]) -> None:
        """Run a phase; the end of any process of the system ends it.

        A step in progress on a node of that process knows more, so it may fail first.

        Raises:
            StepFailedError: a process ended.
        """
        running = asyncio.ensure_future(phase)
        death = asyncio.ensure_future(self.next_death())
        try:
            waits: set[asyncio.Future[Any]] = {running, death}
            await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
            if not running.done():
                await asyncio.wait({running}, timeout=_SPEAK_S)
            if running.done():
                running.result()
            if death.done():
                raise death.result()
        except StepFailedError as failure:
            failure.joined(self.deaths())
            raise
        finally:
            await ended(running, death)

    def deaths(self) -> tuple[StepFailedError, ...]:
        """Return the failure of every process that has ended although it was to run."""
        server = self._system.server
        every = (*self._system.processes.values(), *(() if server is None else (server,)))
        return tuple(self._failure(each) for each in every if each.died)

    async def next_death(self) -> StepFailedError:
        """Wait for the next process that ends unasked; return the failure that this is."""
        return self._failure(await first_death(self._system, self.dead))

    def _failure(self, process: ManagedProcess) -> StepFailedError:
        keys = process.planned.nodes
        node = self._system.nodes[keys[0]] if len(keys) == 1 else None
        return died(process, node)
