"""A supervisor's world without processes, ROS or waiting.

Owns: a spawner whose "processes" are coroutines that speak the control protocol, an
observer that sees what it is told, and a loop whose clock jumps over every wait.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import selectors
import signal
import socket
from collections.abc import Callable, Collection, Coroutine, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from msgspec.structs import replace

from lifecycle.codec import from_json, to_json
from lifecycle.manifest.model import DiscoveryRange, EndpointKind
from lifecycle.node.host.control import Command, Event, HostSpec, Operation
from lifecycle.plan.model import Plan, PlannedNode, PlannedProcess
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.processes.process import ManagedProcess, ProcessExit
from lifecycle.supervisor.run.events import Emitter, RunStarted
from lifecycle.supervisor.run.events import Event as SupervisorEvent
from lifecycle.supervisor.run.options import UpOptions
from lifecycle.verify.observation import NodeConfiguration
from lifecycle.verify.outcome import ConnectionReport, Outcome
from lifecycle.verify.verdict import Finding, Verdict
from tests.builders import configuration, reported

T = TypeVar("T")


_STUCK = 2000
"""So often nothing happens at one moment only where it can never pass."""


class _JumpingSelector(selectors.DefaultSelector):
    """Never waits: when nothing is ready, time passes instead."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self._still = 0

    def select(self, timeout: float | None = None) -> list[Any]:
        ready = super().select(0)
        if not ready:
            assert timeout is not None, "everything waits and nothing will ever happen"
            before, self.now = self.now, round(self.now + max(timeout, 0.0), 9)
            # What is left of a wait may be less than a float can tell; a clock moves by itself.
            self._still = self._still + 1 if self.now == before else 0
            if self._still > _STUCK:
                self.now += 1e-9
        return ready


class JumpingLoop(asyncio.SelectorEventLoop):
    """An event loop whose waits take no time; all actors must live in it."""

    def __init__(self) -> None:
        self._jumping = _JumpingSelector()
        super().__init__(self._jumping)

    def time(self) -> float:
        return self._jumping.now


def run(main: Coroutine[Any, Any, T]) -> T:
    """Run a test's coroutine in a loop whose clock jumps; end what it has left, as asyncio.run."""
    loop = JumpingLoop()

    async def end(left: set[asyncio.Task[Any]]) -> None:
        for each in left:
            each.cancel()
        await asyncio.gather(*left, return_exceptions=True)

    try:
        return loop.run_until_complete(main)
    finally:
        loop.run_until_complete(end(asyncio.all_tasks(loop)))
        loop.close()


_STATES = {
    Operation.CONFIGURE: ("inactive", False),
    Operation.CONNECT: ("inactive", True),
    Operation.ACTIVATE: ("active", True),
    Operation.DEACTIVATE: ("inactive", True),
    Operation.DISCONNECT: ("inactive", False),
    Operation.CLEANUP: ("unconfigured", False),
    Operation.SHUTDOWN: ("finalized", False),
}


def interface_of(node: str, *endpoints: str) -> NodeConfiguration:
    """What a configured node reports: endpoints as `publishers/video`, mapped nowhere."""
    kinds_and_names = (each.partition("/") for each in endpoints)
    return configuration(
        node,
        *(reported(EndpointKind(kind), name) for kind, _, name in kinds_and_names),
        connected=False,
        transports=("udpv4", "shm"),
        checksum="0",
    )


def rewired(
    interface: NodeConfiguration,
    operation: Operation,
    *,
    connection: str,
    urls: tuple[str, ...] = (),
    endpoint: str = "",
) -> NodeConfiguration:
    """What the node reports once it made a connection or mapping, or unmade one."""
    connections = [each for each in interface.connections if each.name != connection]
    endpoints = interface.endpoints
    if operation is Operation.CONNECT_TO:
        connections.append(ConnectionReport(name=connection, urls=urls))
    elif operation is Operation.MAP_TO:
        connections = list(interface.connections)
        endpoints = tuple(
            replace(each, mapped=True, connection=connection)
            if f"{each.kind.value}/{each.name}" == endpoint
            else each
            for each in endpoints
        )
    elif operation is Operation.DISCONNECT_FROM:
        endpoints = tuple(
            replace(each, mapped=False, connection="")
            if each.mapped and each.connection == connection
            else each
            for each in endpoints
        )
    else:
        return interface
    return replace(
        interface,
        connections=tuple(connections),
        endpoints=endpoints,
        checksum=str(int(interface.checksum) + 1),
    )


def _what(command: Command) -> str:
    return " ".join(filter(None, (command.endpoint, command.connection)))


_FIRST_PID = 5_000_000
"""Beyond the kernel's largest, 4194304."""


class FakeProcess:
    """A host that lives in the loop; see FakeForkServer for what it can be told to do."""

    def __init__(
        self, spawner: FakeForkServer, process: ManagedProcess, stdout: int, control: int | None
    ) -> None:
        self.pid = spawner.next_pid()
        self.signals: list[int] = []
        self.has_ended = False
        self._spawner = spawner
        self._process = process
        self._name = process.name
        self._stdout = os.dup(stdout)
        self._task: asyncio.Task[None] | None = None
        self._host: socket.socket | None = None
        if control is not None:
            self._host = socket.socket(fileno=os.dup(control))
            self._task = asyncio.ensure_future(self._serve(self._host))
        else:
            self._task = asyncio.ensure_future(self._appear())

    def signal(self, number: int) -> None:
        self.signals.append(number)
        self._spawner.log.append(f"{self._name} {signal.Signals(number).name}")
        if number >= self._spawner.ends_at.get(self._name, 0) or number == signal.SIGKILL:
            self.end(ProcessExit(signal=number))

    def run_delay_s(self) -> float:
        share = self._spawner.starves.get(self._name, 0.0)
        return share * asyncio.get_running_loop().time()

    def end(self, how: ProcessExit) -> None:
        if not self.has_ended:
            self.has_ended = True
            if self._task is not None:
                self._task.cancel()
            if self._host is not None:
                self._host.close()  # it ended before it served
            os.close(self._stdout)
            self._process.settle(how)
            self._spawner.gone(self._name)

    def say(self, line: str) -> None:
        os.write(self._stdout, line.encode() + b"\n")

    async def _appear(self) -> None:
        """A plain command says nothing of itself, but its node comes into the graph."""
        await asyncio.sleep(self._spawner.takes_s.get(f"{self._name} start", 0.0))
        self._spawner.came(self._name, f"/{self._name}")

    async def _serve(self, control: socket.socket) -> None:
        self._host = None
        control.setblocking(False)
        reader, writer = await asyncio.open_connection(sock=control)
        with contextlib.closing(writer):
            spec = from_json(await reader.readline(), HostSpec)
            nodes = [node.full_name for node in spec.nodes]
            self._spawner.begin(nodes)
            if not await self._act(f"{self._name} start", writer, Event(kind="ready"), *nodes):
                return
            while line := await reader.readline():
                command = from_json(line, Command)
                if command.operation is Operation.END:
                    continue
                state, connected = _STATES.get(command.operation, ("active", True))
                before = self._spawner.interfaces.get(command.node)
                if command.operation not in _STATES and before is not None:
                    state, connected = before.state, before.connected
                what = " ".join(
                    filter(None, (command.node, command.operation.value, _what(command)))
                )
                reply = Event(
                    kind="reply", node=command.node, id=command.id, state=state, connected=connected
                )
                await self._act(what, writer, reply, command=command)
        if self._name not in self._spawner.ends_at:
            self.end(ProcessExit(status=0))

    async def _act(
        self,
        what: str,
        writer: asyncio.StreamWriter,
        answer: Event,
        *nodes: str,
        command: Command | None = None,
    ) -> bool:
        """Do one thing in the way that the spawner says; whether the process goes on."""
        self._spawner.log.append(what)
        way = self._spawner.ways.get(what, "")
        await asyncio.sleep(self._spawner.takes_s.get(what, 0.0))
        if way == "hang":
            return True
        if way == "die":
            self.say("segmentation fault")
            self.end(ProcessExit(signal=signal.SIGSEGV))
            return False
        if way:
            kind = "failed" if answer.kind == "ready" else answer.kind
            state = "unconfigured" if what.endswith("configure") else "inactive"
            before = self._spawner.interfaces.get(answer.node)
            answer = Event(
                kind=kind,
                node=answer.node,
                id=answer.id,
                ok=False,
                error=way,
                state=state if before is None else before.state,
                connected=before is not None and before.connected,
            )
        else:
            self._spawner.came(self._name, *nodes)
        if command is not None:
            answer = replace(answer, configuration=self._carry_out(command, answer))
        if answer.configuration is not None:
            told = replace(answer, kind="configuration", id=0, ok=True, error="")
            writer.write(to_json(told) + b"\n")
        writer.write(to_json(answer) + b"\n")
        return True

    def _carry_out(self, command: Command, answer: Event) -> NodeConfiguration | None:
        return self._spawner.carry_out(command, answer.state, connected=answer.connected)


class FakeForkServer:
    """Starts fake hosts.

    Attributes:
        log: everything that happened, in order: `talker start`, `/talker configure`, signals.
        ways: what goes wrong: such a line → "hang", "die", or the error to answer with.
        takes_s: how long such a line takes.
        starves: by process, for how much of the time its threads wait for a processor, added up.
        ends_at: processes that do not end by themselves, and the signal that ends them.
        lingers_s: seconds for which discovery shows the nodes of a process that has ended.
        processes: by name.
        interfaces: what a node reports, by full name; steps of wiring change it.
        nodes: full names of the nodes that are in the graph, by process.
        changed: called whenever the graph looks otherwise.
    """

    def __init__(self) -> None:
        self.log: list[str] = []
        self.ways: dict[str, str] = {}
        self.takes_s: dict[str, float] = {}
        self.starves: dict[str, float] = {}
        self.ends_at: dict[str, int] = {}
        self.lingers_s = 0.0
        self.processes: dict[str, FakeProcess] = {}
        self._by_pid: dict[int, FakeProcess] = {}
        self.interfaces: dict[str, NodeConfiguration] = {}
        self.nodes: dict[str, tuple[str, ...]] = {}
        self.changed: Callable[[], None] = lambda: None
        self.died: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self.waited_for: tuple[int, ...] = ()
        self.pid = _FIRST_PID

    def next_pid(self) -> int:
        """One that no process can have."""
        self.pid += 1
        return self.pid

    def begin(self, nodes: list[str]) -> None:
        """Construct nodes anew."""
        for name in nodes:
            if (report := self.interfaces.get(name)) is not None:
                fresh = replace(report, state="unconfigured", connected=False)
                self.interfaces[name] = fresh

    def came(self, process: str, *nodes: str) -> None:
        """Show the nodes of a process in the graph."""
        if nodes:
            self.nodes[process] = nodes
            self.changed()

    def gone(self, process: str) -> None:
        """Show the nodes of a process in the graph no more, a moment later."""

        def gone() -> None:
            if self.nodes.pop(process, ()):
                self.changed()

        asyncio.get_running_loop().call_later(self.lingers_s, gone)

    def carry_out(
        self, command: Command, state: str, *, connected: bool
    ) -> NodeConfiguration | None:
        """What a node reports after a command; None for a node that reports nothing."""
        interface = self.interfaces.get(command.node)
        if interface is None:
            return None
        if command.operation in _STATES:
            interface = replace(interface, state=state, connected=connected)
        elif f"{command.node} {command.operation.value} {_what(command)}" not in self.ways:
            interface = rewired(
                interface,
                command.operation,
                connection=command.connection,
                urls=command.connections.urls,
                endpoint=command.endpoint,
            )
        self.interfaces[command.node] = interface
        return interface

    async def spawn(
        self, process: ManagedProcess, streams: Sequence[int], control: int | None
    ) -> int:
        made = self.processes[process.name] = FakeProcess(self, process, streams[0], control)
        self._by_pid[made.pid] = made
        return made.pid

    def signal(self, pid: int, number: int) -> None:
        self._by_pid[pid].signal(number)

    def run_delay_s(self, pid: int) -> float:
        return self._by_pid[pid].run_delay_s()

    def family(self) -> frozenset[int]:
        """They have started nothing."""
        return frozenset()

    def belonging(self, processes: Mapping[int, str]) -> frozenset[int]:
        del processes
        return frozenset()

    async def end_left(
        self, ended: Mapping[int, str], known: Collection[int] = ()
    ) -> tuple[int, ...]:
        del ended, known
        return ()

    async def end_strays(self) -> tuple[int, ...]:
        return ()


def run_started(*nodes: str, **changes: Any) -> RunStarted:
    """How the run of these nodes, a process each, begins."""
    values = {"system": "robot", "domain_id": 30, "rmw": "rmw_fastrtps_cpp", **changes}
    return RunStarted(
        discovery_range="localhost",
        nodes=nodes,
        processes=tuple(each.removeprefix("/") for each in nodes),
        log_directory="/log",
        **values,
    )


def host_spec(*nodes: PlannedNode, **changes: Any) -> HostSpec:
    """What a host of these nodes is told at its start."""
    where = DiscoveryRange.LOCALHOST
    values = {"system": "robot", "process": nodes[0].process, **changes}
    return HostSpec(domain_id=0, discovery_range=where, nodes=nodes, **values)


def verdict(*found: tuple[str, ...], outcome: Outcome | None = None) -> Verdict:
    """A verdict of findings, violated by default and ok by none.

    Args:
        found: of each the rule, the subject (`/a`, or `/topic: /a → /b` for two ends), and the
            node, where that is not the subject.
        outcome: of all of them.
    """
    outcome = outcome or (Outcome.VIOLATED if found else Outcome.OK)
    findings = []
    for rule, subject, *node in found:
        ends = tuple(subject.rpartition(": ")[2].split(" → ")) if "→" in subject else ()
        findings.append(
            Finding(
                rule=rule,
                outcome=outcome,
                subject=subject,
                expected="",
                observed="",
                message=f"{rule} {subject}",
                node="" if ends else (node or [subject])[0],
                ends=ends,
            )
        )
    violated = outcome is Outcome.VIOLATED
    return Verdict(verdict=outcome, blocking=violated, findings=tuple(findings), flows=())


def verdict_of(outcome: Outcome, *rules: str) -> Verdict:
    """A verdict with one finding of `/camera` for each rule."""
    return verdict(*((rule, "/camera") for rule in rules), outcome=outcome)


class World:
    """A system of fakes with everything recorded.

    Attributes:
        hosts: start, and obey or not, as they are told.
        events: so far.
        system: what this supervisor runs of a plan.
    """

    def __init__(
        self,
        plan: Plan,
        directory: Path,
        processes: Iterable[PlannedProcess] | None = None,
        **options: Any,
    ) -> None:
        self.hosts = FakeForkServer()
        self.events: list[SupervisorEvent] = []
        self.emit = Emitter(asyncio.get_running_loop().time)
        self.emit.listen(self.events.append)
        own = plan.processes if processes is None else processes
        self.system = System(
            plan, emit=self.emit, logs=directory, processes=own, options=UpOptions(**options)
        )

    def heard(self, kind: type[T]) -> list[T]:
        """Events of one kind."""
        return [event for event in self.events if isinstance(event, kind)]
