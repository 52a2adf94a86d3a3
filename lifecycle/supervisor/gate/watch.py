"""Watches a system that is up: verified again at every change, dead processes noticed at once.

Owns: the hold phase. What follows from what it sees is hold.py's. Must not import rclpy.
"""

from __future__ import annotations

import asyncio

from lifecycle.supervisor.gate.verification_loop import SETTLED_S, ChangeCounter, VerificationLoop
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.processes.process import ManagedProcess
from lifecycle.supervisor.processes.spawn import ProcessState
from lifecycle.verify import Outcome, Stage, not_ok


async def first_death(system: System, known: set[str]) -> ManagedProcess:
    """Wait until a process ends that was not asked to.

    Args:
        system: whose processes.
        known: names of processes whose death was reported already; the new one is added.
    """
    servers: tuple[ManagedProcess, ...] = () if system.server is None else (system.server,)
    while True:
        living = {
            process.ended: process
            for process in (*system.processes.values(), *servers)
            if process.name not in known
        }
        if not living:
            await asyncio.get_running_loop().create_future()  # for ever: until cancelled
        done, _ = await asyncio.wait(living, return_when=asyncio.FIRST_COMPLETED)
        for ended in done:
            process = living[ended]
            known.add(process.name)
            if process.state is ProcessState.EXITED:
                return process


class Watch:
    """Judges a system again and again while it is held.

    Attributes:
        violated: what was seen violated for longer than a passing moment; empty if nothing was.
    """

    def __init__(self, judge: VerificationLoop, changes: ChangeCounter, stage: Stage) -> None:
        self._judge = judge
        self._changes = changes
        self._stage = stage
        self.violated = ""

    async def run(self) -> None:
        """Judge at every change, until cancelled."""
        while True:
            count = self._changes.count
            verdict, again_s = await self._judge.settled(self._stage)
            bad = verdict.verdict is Outcome.VIOLATED and not self.violated
            wait_s = SETTLED_S if again_s is None and bad else again_s
            if await self._changes.beyond(count, wait_s):
                await self._judge.quiet()
            elif again_s is None:
                self.violated = not_ok(verdict) or verdict.verdict.value  # no change: it lasts
