"""Notices processes that die, and what they leave in the graph until their DDS lease ends.

Owns: `ProcessMonitor`: what runs in it is ended by the first process that ends unasked;
`EndedProcesses`: what they left counts no more; and `Sightings`: waiting until discovery shows a
node, or no longer does, checked whenever anything changes and never otherwise. Must not import
rclpy.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from lifecycle.supervisor.control.protocol import ProcessState
from lifecycle.supervisor.gate.verification_loop import FORGOTTEN_S, ChangeCounter
from lifecycle.supervisor.nodes.bring_up import ALSO_S, died
from lifecycle.supervisor.nodes.system import NodeRun, System
from lifecycle.supervisor.processes.process import ManagedProcess
from lifecycle.supervisor.run.events import Event, ProcessChanged
from lifecycle.supervisor.run.failure import StepFailedError, ended

if TYPE_CHECKING:
    from lifecycle.graph.graph import Graph
    from lifecycle.supervisor.nodes.observer_participant import ObserverParticipant

_SPEAK_S = 0.7 + ALSO_S
"""A step notices its node's death itself within this, and knows what the node was doing."""


async def first_death(system: System, known: set[str]) -> ManagedProcess:
    """Wait until a process ends that was not asked to.

    Args:
        system: whose processes.
        known: names of processes whose death was reported already; the new one is added.
    """
    servers: tuple[ManagedProcess, ...] = () if system.server is None else (system.server,)
    while True:
        living: dict[asyncio.Future[Any], ManagedProcess] = {
            process.ended: process
            for process in (*system.processes.values(), *servers)
            if process.name not in known
        }
        if not living:
            await asyncio.get_running_loop().create_future()  # for ever: until cancelled
        done, _ = await asyncio.wait(living, return_when=asyncio.FIRST_COMPLETED)
        for exited in done:
            process = living[exited]
            known.add(process.name)
            if process.state is ProcessState.EXITED and not process.is_over:
                return process


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

        A step in progress on a node of that process knows more, so it may fail first; one on
        another may be over in a moment.

        Raises:
            StepFailedError: a process ended.
        """
        running = asyncio.ensure_future(phase)
        death = asyncio.ensure_future(first_death(self._system, self.dead))
        try:
            waits: set[asyncio.Future[Any]] = {running, death}
            await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
            if not running.done() and any(each.doing for each in self._system.nodes.values()):
                await asyncio.wait({running}, timeout=_SPEAK_S)
            if running.done():
                running.result()
            if death.done():
                raise self._failure(death.result())
        except StepFailedError as failure:
            failure.joined(self.deaths())
            raise
        finally:
            await ended(running, death)

    def deaths(self) -> tuple[StepFailedError, ...]:
        """Return the failure of every process that has ended although it was to run."""
        server = self._system.server
        servers = () if server is None else (server,)
        every = (*self._system.processes.values(), *servers)
        return tuple(self._failure(each) for each in every if each.died)

    async def next_death(self) -> StepFailedError:
        """Wait for the next process that ends unasked; return the failure that this is."""
        return self._failure(await first_death(self._system, self.dead))

    def _failure(self, process: ManagedProcess) -> StepFailedError:
        keys = process.planned.nodes
        node = self._system.nodes[keys[0]] if len(keys) == 1 else None
        return died(process, node)


_PREFIX_DIGITS = 24


class EndedProcesses:
    """Has what processes of one system leave in the graph when they die count no more.

    Only processes that this supervisor started count, once the kernel says that they ended. Others
    show what is left until its lease is over (middleware/fastdds/profiles.py).

    Args:
        system: whose processes; `on_event` must be given its events.
        participant: ours.
    """

    def __init__(self, system: System, participant: ObserverParticipant) -> None:
        self._system = system
        self._participant = participant

    def on_event(self, event: Event) -> None:
        """Take an event of the system; of interest are ends of processes."""
        if isinstance(event, ProcessChanged) and event.state is ProcessState.EXITED:
            process = self._system.processes.get(event.process)
            if process is not None and process.pid == event.pid:
                nodes = self._system.nodes
                # Another manifest may have been taken meanwhile.
                self.forget(
                    process.pid, [nodes[key] for key in process.planned.nodes if key in nodes]
                )

    def forget(self, pid: int, nodes: Sequence[NodeRun]) -> None:
        """Count no more what a process left that is known to have ended.

        Args:
            pid: of the process.
            nodes: that it ran.
        """
        self._participant.discovery.ended(
            pid,
            nodes=[node.name for node in nodes],
            reported=[prefix for node in nodes for prefix in _reported(node)],
        )


def _reported(node: NodeRun) -> Iterable[str]:
    """Yield the GUID prefixes that a node said are its own."""
    configuration = node.configuration
    if configuration is None:
        return
    yield configuration.identity.node_id.rpartition("@")[2]
    for each in configuration.endpoints:
        yield each.gid[:_PREFIX_DIGITS]


class Sightings:
    """Who is in the graph of one system, as an event to wait for."""

    def __init__(self, system: System, observer: Graph, changes: ChangeCounter) -> None:
        self._system = system
        self._observer = observer
        self._changes = changes

    async def appears(self, name: str) -> None:
        """Wait until discovery shows a node of this name; the caller sets the limit."""
        while True:
            count = self._changes.count
            if await self._is_there(name):
                return
            await self._changes.beyond(count, None)

    async def vanishes(self, name: str) -> None:
        """Wait until discovery shows no node of this name, or its lease must have run out."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + FORGOTTEN_S
        while (left_s := deadline - loop.time()) > 0:
            count = self._changes.count
            if not await self._is_there(name):
                return
            await self._changes.beyond(count, left_s)

    async def _is_there(self, name: str) -> bool:
        observation = await self._observer.observe(self._system.plan)
        return any(each.full_name == name for each in observation.nodes)
