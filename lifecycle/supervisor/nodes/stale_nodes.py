"""Removes dead processes from the ROS graph before their DDS lease ends; waits for nodes to appear.

Owns: `StaleNodes`: which participants were a process's, and when all others are made to forget
them; and `Sightings`: waiting until discovery shows a node, or no longer does, checked whenever
anything changes and never otherwise. How participants are forgotten is
lifecycle.middleware.discovery.dead_peers'. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from typing import Protocol

from lifecycle.supervisor.gate.verification_loop import ChangeCounter
from lifecycle.supervisor.nodes.system import NodeRun, ObservedGraph, System
from lifecycle.supervisor.processes.process import ManagedProcess
from lifecycle.supervisor.processes.spawn import ProcessState
from lifecycle.supervisor.run.events import Event, ProcessChanged

AGAIN_S = (0.1, 0.5, 1.0, 2.0, 4.0)
"""Seconds between repetitions: what the process itself had sent may be read after the first, and a
datagram may be lost. After the first two only while discovery still shows a participant."""

_ALWAYS = 3
"""Times that it is sent in any case: at once and after the first two pauses."""

_PREFIX_DIGITS = 24


class ParticipantRegistry(Protocol):
    """Where participants are seen and removed, see ObserverParticipant."""

    def participants_of(
        self, pid: int, *, nodes: Iterable[str], reported: Iterable[str]
    ) -> frozenset[str]:
        """Return the GUID prefixes of the participants that discovery shows of a process."""

    def remove_participants(self, prefixes: Iterable[str], pids: Iterable[int]) -> None:
        """Have all others forget participants whose process is dead."""


class StaleNodes:
    """Removes what processes of one system leave in the graph when they die.

    Only processes that this supervisor started count, once the kernel says that they ended. Of each
    only those participants count that bear its pid and that its nodes reported, or were seen on.

    Args:
        system: whose processes; `on_event` must be given its events.
        graph: see above.
    """

    def __init__(self, system: System, graph: ParticipantRegistry) -> None:
        self._system = system
        self._graph = graph
        self._later: set[asyncio.TimerHandle] = set()
        self._closed = False

    def on_event(self, event: Event) -> None:
        """Take an event of the system; only the end of a process is of interest."""
        if isinstance(event, ProcessChanged) and event.state is ProcessState.EXITED:
            process = self._system.processes.get(event.process)
            if process is not None and process.pid == event.pid:
                asyncio.get_running_loop().call_soon(self._ended, process)

    def close(self) -> None:
        """Repeat nothing any more."""
        self._closed = True
        for each in self._later:
            each.cancel()
        self._later.clear()

    def _ended(self, process: ManagedProcess) -> None:
        if self._closed:
            return
        nodes = [self._system.nodes[key] for key in process.planned.nodes]
        names = [node.name for node in nodes]
        reported = frozenset(prefix for node in nodes for prefix in _reported(node))
        prefixes = self._graph.participants_of(process.pid, nodes=names, reported=reported)
        if prefixes:
            self._remove(process.pid, prefixes, prefixes, 0)

    def _remove(
        self, pid: int, every: frozenset[str], shown: frozenset[str], repetition: int
    ) -> None:
        if repetition < _ALWAYS or shown:
            pids = [each.pid for each in self._system.living]
            self._graph.remove_participants(every, pids)
        if repetition == len(AGAIN_S) or self._closed:
            return

        def again() -> None:
            self._later.discard(handle)
            left = self._graph.participants_of(pid, nodes=(), reported=every)
            self._remove(pid, every, left & every, repetition + 1)

        loop = asyncio.get_running_loop()
        handle = loop.call_later(AGAIN_S[repetition], again)
        self._later.add(handle)


def _reported(node: NodeRun) -> Iterable[str]:
    """Yield the GUID prefixes that a node said are its own."""
    configuration = node.configuration
    if configuration is None:
        return
    yield configuration.identity.node_id.rpartition("@")[2]
    for each in configuration.endpoints:
        yield each.gid[:_PREFIX_DIGITS]


_LEASE_S = 21.0
"""Fast DDS forgets a participant that left without notice after 20 s, by default."""


class Sightings:
    """Who is in the graph of one system, as an event to wait for."""

    def __init__(self, system: System, observer: ObservedGraph, changes: ChangeCounter) -> None:
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
        deadline = loop.time() + _LEASE_S
        while (left_s := deadline - loop.time()) > 0:
            count = self._changes.count
            if not await self._is_there(name):
                return
            await self._changes.beyond(count, left_s)

    async def _is_there(self, name: str) -> bool:
        observation = await self._observer.observe(self._system.plan)
        return any(each.full_name == name for each in observation.nodes)
