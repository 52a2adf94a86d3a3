"""Notices processes that die, and removes their nodes from the ROS graph before the DDS lease ends.

Owns: `ProcessMonitor`: what runs in it is ended by the first process that ends unasked;
`StaleNodes`: which participants were a process's, and when all others are made to forget them; and
`Sightings`: waiting until discovery shows a node, or no longer does, checked whenever anything
changes and never otherwise. How participants are forgotten is middleware/discovery/'s. Must not
import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from lifecycle.errors import BringUpError
from lifecycle.node.host.control import Operation
from lifecycle.supervisor.control.protocol import ProcessState, Reach
from lifecycle.supervisor.gate.verification_loop import LEASE_S, ChangeCounter
from lifecycle.supervisor.nodes.bring_up import ALSO_S, died
from lifecycle.supervisor.nodes.system import NodeRun, System
from lifecycle.supervisor.processes.control_channel import ControlChannel
from lifecycle.supervisor.processes.process import ManagedProcess
from lifecycle.supervisor.run.events import Event, NodeChanged, ProcessChanged
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


AGAIN_S = (0.1, 0.5, 1.0, 2.0, 4.0)
"""Seconds between repetitions: what the process itself had sent may be read after the first, and a
datagram may be lost. After the first two only while discovery still shows a participant."""

INTRODUCED_AGAIN_S = (0.1, 0.1, 0.1, 0.2, 0.4, 0.8)
"""Seconds between repetitions: a datagram may be lost, and be answered before it is listened."""

REDISCOVERED_S = 3.0
"""Seconds after which one whose name is still not known, or that has not loaded its components, is
made to discover us anew, and again: now and then Fast DDS 2.14 does not repeat what is owed (seen
where the machine's clock was set back by a day and forth while ten nodes were started; measured: in
8 of 33 such starts)."""

_REDISCOVERIES = 10
"""Times at most."""

STARTING_S = 0.2
"""Seconds between looks whether a command that is started again has a participant yet: nothing says
when it has, and until it and we know each other its node is not known to have started."""

_ALWAYS = 3
"""Times that it is sent in any case: at once and after the first two pauses."""

_PREFIX_DIGITS = 24


async def _republish(channel: ControlChannel, node: str) -> None:
    # One that ends meanwhile has nothing to publish any more.
    with contextlib.suppress(BringUpError):
        await channel.request(node, Operation.REPUBLISH_NAMES)


_ANNOUNCED_S = 1.5
"""For so long at least new participants announce themselves often (middleware/fastdds)."""


_TOGETHER_S = 0.02
"""Those that start side by side are there within a moment: we announce ourselves once to them."""


class StaleNodes:
    """Removes what processes of one system leave in the graph when they die.

    Only processes that this supervisor started count, once the kernel says that they ended. Of each
    only those participants count that bear its pid and that its nodes reported, or were seen on,
    or, where there are none of these, that nobody has a name for.

    Args:
        system: whose processes; `on_event` must be given its events.
        participant: ours.
        disown_ports: has all others send no more to ports in shared memory whose process is dead.
    """

    def __init__(
        self, system: System, participant: ObserverParticipant, *, disown_ports: Callable[[], None]
    ) -> None:
        self._system = system
        self._participant = participant
        self._disown_ports = disown_ports
        self._later: set[asyncio.TimerHandle] = set()
        self._publishing: set[asyncio.Future[None]] = set()
        self._closed = False
        self._began_s: float | None = None
        self._announcing: asyncio.TimerHandle | None = None

    def on_event(self, event: Event) -> None:
        """Take an event of the system; of interest are ends of processes, and restarted ones."""
        if isinstance(event, NodeChanged) and event.reach in (Reach.STARTED, Reach.CONNECTED):
            self._came_again(event.node, event.reach)
        if isinstance(event, ProcessChanged) and event.state is ProcessState.STARTING:
            self._starts(self._system.processes.get(event.process))
        if isinstance(event, ProcessChanged) and event.state is ProcessState.EXITED:
            process = self._system.processes.get(event.process)
            if process is not None and process.pid == event.pid:
                asyncio.get_running_loop().call_soon(self._ended, process)

    def _came_again(self, name: str, reach: Reach, repetition: int = 0) -> None:
        """Introduce a process that was started again, or added, to the others, while so far."""
        node = self._system.node_named(name)
        process = None if node is None else node.process
        if node is None or process is None or not process.pid:
            return
        if not (process.is_restarted or process.joins):
            if process.channel is not None and reach is Reach.STARTED:
                self._meet(process)
            return
        if self._closed or node.reach is not reach or process.is_gone:
            return
        known = self._is_known(node)
        rediscover = repetition > len(INTRODUCED_AGAIN_S)
        if rediscover and known:
            return
        self._introduce(process, rediscover=rediscover)
        if repetition and process.channel is not None and not known:
            # Its endpoints may be matched and its name not be known: what it published before the
            # match is only repeated with the next heartbeat, 3 s later.
            publishing = asyncio.ensure_future(_republish(process.channel, name))
            self._publishing.add(publishing)
            publishing.add_done_callback(self._publishing.discard)
        pauses = (*INTRODUCED_AGAIN_S, *[REDISCOVERED_S] * _REDISCOVERIES)
        if repetition < len(pauses):
            self._again(pauses[repetition], self._came_again, name, reach, repetition + 1)

    def _introduce(self, process: ManagedProcess, *, rediscover: bool = False) -> None:
        pids = [each.pid for each in self._system.living if each is not process]
        self._participant.introduce([process.pid], pids, rediscover=rediscover)

    def _again(self, after_s: float, do: Callable[..., None], *arguments: object) -> None:
        def again() -> None:
            self._later.discard(handle)
            do(*arguments)

        handle = asyncio.get_running_loop().call_later(after_s, again)
        self._later.add(handle)

    def _meet(self, process: ManagedProcess) -> None:
        """Have a process that was started with the others, and listens now, know who is there.

        It would know us, and those that announce themselves no more, up to 3 s later.
        """
        now_s = asyncio.get_running_loop().time()
        self._began_s = now_s if self._began_s is None else self._began_s
        if now_s - self._began_s < _ANNOUNCED_S:
            if self._announcing is None:
                self._announcing = asyncio.get_running_loop().call_later(
                    _TOGETHER_S, self._announce
                )
        else:
            self._introduce(process)

    def _announce(self) -> None:
        self._announcing = None
        if not self._closed:
            self._participant.announce_ourselves()

    def _is_known(self, node: NodeRun) -> bool:
        """Whether a node is in the graph, and has loaded what it is to load.

        A container that does not know our clients answers none of their requests.
        """
        if node.name not in (self._system.present or ()):
            return False
        loads = (
            each
            for each in self._system.nodes.values()
            if each.planned.run.container == node.planned.key
        )
        return not any(each.reach is Reach.WAITING for each in loads)

    def _starts(self, process: ManagedProcess | None, looks: int = 1) -> None:
        """Introduce a command that was started again, or added, until its node has started.

        One that we host says itself that it is there; a command is there once discovery shows it.
        """
        if process is None or not (process.is_restarted or process.joins):
            return
        nodes = [self._system.nodes.get(key) for key in process.planned.nodes]
        if self._closed or process.is_gone or process.channel is not None:
            return
        if not any(
            node is not None and node.process is process and node.reach is Reach.WAITING
            for node in nodes
        ):
            return
        if process.pid:
            rediscover = looks % round(REDISCOVERED_S / STARTING_S) == 0
            self._introduce(process, rediscover=rediscover)
        self._again(STARTING_S, self._starts, process, looks + 1)

    def close(self) -> None:
        """Repeat nothing any more."""
        self._closed = True
        for each in self._later:
            each.cancel()
        self._later.clear()
        for task in self._publishing:
            task.cancel()

    def _ended(self, process: ManagedProcess) -> None:
        nodes = self._system.nodes
        # Another manifest may have been taken meanwhile.
        self.forget(process.pid, [nodes[key] for key in process.planned.nodes if key in nodes])

    def forget(self, pid: int, nodes: Sequence[NodeRun]) -> None:
        """Remove what a process left that is known to have ended.

        Args:
            pid: of the process.
            nodes: that it ran.
        """
        if self._closed:
            return
        self._disown_ports()
        names = [node.name for node in nodes]
        reported = frozenset(prefix for node in nodes for prefix in _reported(node))
        prefixes = self._participant.discovery.participants_of(pid, nodes=names, reported=reported)
        # What has no name yet may be discovered only now: it was just being made.
        self._remove(pid, prefixes, prefixes, 0)

    def _remove(
        self, pid: int, every: frozenset[str], shown: frozenset[str], repetition: int
    ) -> None:
        if every and (repetition < _ALWAYS or shown):
            pids = [each.pid for each in self._system.living]
            self._participant.discovery.remove_participants(every, pids)
        if repetition < len(AGAIN_S):
            self._again(AGAIN_S[repetition], self._remove_again, pid, every, repetition + 1)

    def _remove_again(self, pid: int, every: frozenset[str], repetition: int) -> None:
        left = self._participant.discovery.participants_of(pid, nodes=(), reported=every)
        self._remove(pid, every or left, left & (every or left), repetition)


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
        deadline = loop.time() + LEASE_S
        while (left_s := deadline - loop.time()) > 0:
            count = self._changes.count
            if not await self._is_there(name):
                return
            await self._changes.beyond(count, left_s)

    async def _is_there(self, name: str) -> bool:
        observation = await self._observer.observe(self._system.plan)
        return any(each.full_name == name for each in observation.nodes)
