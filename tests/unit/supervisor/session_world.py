"""A whole session of the supervisor in the world of fakes, told as a story line by line.

Owns: the participant and the fork server that a `Session` gets there, `SessionWorld`, and what
holds in every run whatever happens in it: no activate request reaches a node before a gate that
opened for it on a verdict that is not violated, no process is left, and the end is reported.
"""

from __future__ import annotations

import asyncio
import contextlib
import signal
from collections.abc import (
    AsyncIterator,
    Awaitable,
    Callable,
    Collection,
    Iterable,
    Iterator,
    Mapping,
)
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from msgspec.structs import replace

from lifecycle.codec import from_json, to_json
from lifecycle.errors import BringUpError, MiddlewareError
from lifecycle.manifest.model import Condition, RunKind
from lifecycle.middleware.services.supervisor_topics import AliveNotice
from lifecycle.node.host.control import Operation
from lifecycle.plan.model import ParticipantConnections, Plan
from lifecycle.run_directory import RunDirectory, short_path
from lifecycle.supervisor.connections.networks import Networks
from lifecycle.supervisor.control.protocol import (
    Answer,
    ControlRequest,
    Question,
    SystemStatus,
)
from lifecycle.supervisor.control.ros_interface import Entry
from lifecycle.supervisor.nodes.driver import where_it_runs
from lifecycle.supervisor.processes.process import ProcessExit
from lifecycle.supervisor.run.events import (
    Event,
    Failure,
    GateOpened,
    ManifestApplied,
    NodeChanged,
    NodeJoined,
    NodeLeft,
    Notice,
    ProcessChanged,
    RequestSent,
    Restarted,
    RestartScheduled,
    Stopped,
    Stopping,
    SystemReached,
    VerdictChanged,
)
from lifecycle.supervisor.run.journal import Journal, journal_files, read_run
from lifecycle.supervisor.run.options import UpResult
from lifecycle.supervisor.run.signals import Ending
from lifecycle.supervisor.shell.supervisor import Means, Supervisor
from lifecycle.verify.observation import NodeConfiguration, Observation, ObservedNode
from lifecycle.verify.verdict import Verdict
from tests.builders import plan_of, planned_node
from tests.unit.supervisor.fakes import FakeForkServer, World, interface_of

SHUTDOWN_S = 30.0
"""However a node or a process resists, a system of the size of these is down within so long."""


class FakeAir:
    """Carries nothing to other supervisors, and remembers what was announced and watched."""

    def __init__(self) -> None:
        self.watched: dict[str, SimpleNamespace] = {}
        self.announced: dict[str, list[Mapping[str, str]]] = {}
        self.received: list[dict[str, tuple[int, int, int]]] = []
        self.asks = 0
        self.newcomers: list[Callable[[], None]] = []
        self.plans: list[str] = []
        self.arrives: Callable[[str], None] | None = None
        self.done: list[str] = []

    def announce_alive(self, topic: str, on_listener: Callable[[], None]) -> SimpleNamespace:
        said = self.announced.setdefault(topic, [])
        self.newcomers.append(on_listener)

        def notify(notice: AliveNotice) -> None:
            said.append(dict(notice.silent))
            self.received.append(dict(notice.received))
            self.asks = notice.asks

        return SimpleNamespace(notify=notify, destroy=lambda: None)

    def watch_alive(self, topic: str, **callbacks: Callable[..., None]) -> SimpleNamespace:
        on_notice = callbacks["on_notice"]
        self.watched[topic] = SimpleNamespace(
            alive=callbacks["on_liveliness"],
            left=callbacks["on_left"],
            silent=lambda silent: on_notice(AliveNotice(silent=silent), 0, 0),
            times=lambda sent_ns, received_ns, theirs, asks=0: on_notice(
                AliveNotice(silent={}, received=theirs, asks=asks), sent_ns, received_ns
            ),
            destroy=lambda: self.watched.pop(topic),
        )
        return self.watched[topic]

    def plan_notices(self, on_notice: Callable[[str], None]) -> FakeAir:
        self.arrives = on_notice
        return self

    def announce(self, text: str) -> None:
        self.plans.append(text)

    def destroy(self) -> None:
        self.arrives = None

    def send_again_soon(self) -> None:
        self.done.append("send_again_soon")

    def republish_names(self) -> None:
        self.done.append("republish_names")


class FakeRosInterface:
    """What ROS programs see of a supervisor.

    Attributes:
        statuses: published so far; `diagnostics`: likewise, each a list of entries.
    """

    def __init__(
        self,
        prefix: str,
        services: tuple[str, ...],
        on_call: Callable[[str, Callable[[bool, str], None]], None],
    ) -> None:
        self.prefix, self.services = prefix, services
        self.statuses: list[str] = []
        self.diagnostics: list[tuple[Entry, ...]] = []
        self.destroyed = False
        self._on_call = on_call

    async def call(self, name: str) -> tuple[bool, str]:
        assert name in self.services
        answered: asyncio.Future[tuple[bool, str]] = asyncio.get_running_loop().create_future()
        self._on_call(name, lambda success, message: answered.set_result((success, message)))
        return await answered

    def publish_status(self, text: str) -> None:
        assert not self.destroyed
        self.statuses.append(text)

    def publish_diagnostics(self, entries: Iterable[Entry]) -> None:
        assert not self.destroyed
        self.diagnostics.append(tuple(entries))

    def destroy(self) -> None:
        self.destroyed = True


class FakeParticipant(FakeAir):
    """Sees the nodes of the fake hosts, and those that others run; reaches the latter.

    Attributes:
        others: nodes that no host of ours runs, and their states, "" for a plain one.
        unseen: nodes that discovery does not show.
        mute: nodes whose state cannot be learnt from the graph.
        pids: of the processes that `others` run in, where they are known.
        services: of the nodes in `others`.
        changes: so far; `looks`: how often it was looked.
        forgotten: processes that were.
        while_looking: done once, when the next look has seen everything and is not over yet.
        ros: what ROS programs see of the supervisor; None before it is made.
        no_ros: why it cannot be made; empty if it can.
    """

    def __init__(self, hosts: FakeForkServer) -> None:
        super().__init__()
        self.others: dict[str, str] = {}
        self.pids: dict[str, int] = {}
        self.unseen: set[str] = set()
        self.mute: set[str] = set()
        self.services = FakeServices(self, hosts)
        self.changes = self.looks = 0
        self.forgotten: list[int] = []
        self.while_looking: Callable[[], None] | None = None
        self.ros: FakeRosInterface | None = None
        self.no_ros = ""
        self.graph = self.discovery = self.settling = self.state = self
        self.clients = self.services
        self._hosts = hosts
        self._reports: dict[str, NodeConfiguration] = {}
        self._changed = asyncio.Event()
        hosts.changed = self.note

    def note(self) -> None:
        """The graph looks otherwise than before."""
        self.changes += 1
        self._changed.set()

    async def wait_change(self) -> None:
        await self._changed.wait()
        self._changed.clear()

    def reread_parameters(self) -> bool:
        return False

    def expect_newcomers(self, *, everybody: bool = False) -> bool:
        del everybody
        return False

    async def observe(
        self,
        plan: Plan,
        *,
        only: Collection[str] | None = None,
        machines: Collection[str] | None = None,
    ) -> Observation:
        del machines
        self.looks += 1
        self.asked = [each.key for each in plan.nodes if only is None or each.full_name in only]
        hosted = [
            name
            for process, names in self._hosts.nodes.items()
            if self._hosts.processes[process].pid not in self.forgotten
            for name in names
        ]
        there = {name: "" for name in hosted if name not in self.unseen} | self.others
        seen = Observation(
            nodes=tuple(
                ObservedNode(
                    full_name=name,
                    state=None if name in self.mute else state or None,
                )
                for name, state in there.items()
            ),
            configurations=tuple(report for name, report in self._reports.items() if name in there),
        )
        if (happens := self.while_looking) is not None:
            self.while_looking = None
            happens()
        return seen

    def processes(self) -> dict[str, dict[int, str]]:
        return {name: {pid: "by hand"} for name, pid in self.pids.items()}

    def put_configuration(self, configuration: NodeConfiguration) -> None:
        self._reports[configuration.name] = configuration

    def measure_anew(self) -> None:
        """Nothing is measured here."""

    def drop_configuration(self, node: str) -> None:
        self._reports.pop(node, None)

    def ended(self, pid: int, *, nodes: Iterable[str], reported: Iterable[str]) -> None:
        self.forgotten.append(pid)

    def ros_interface(
        self,
        prefix: str,
        services: Iterable[str],
        on_call: Callable[[str, Callable[[bool, str], None]], None],
        *,
        diagnoses: bool,
    ) -> FakeRosInterface:
        assert self.ros is None
        if self.no_ros:
            raise MiddlewareError(self.no_ros)
        del diagnoses
        self.ros = FakeRosInterface(prefix, tuple(services), on_call)
        return self.ros

    def prepare_to_leave(self) -> None:
        """Everybody answers."""


_REACHED = {
    "configure": "inactive",
    "activate": "active",
    "deactivate": "inactive",
    "cleanup": "unconfigured",
    "shutdown": "finalized",
}


class FakeServices:
    """The lifecycle services of the nodes that others run, and the parameters of all.

    What is asked is in the log of the hosts, `/base activate`, `/base set {'rate': 1.0}`, and takes
    as long, and fails, as is said of such a line there: for a transition before it leaves.

    Attributes:
        moved_to: states that somebody moves a node to right after each of the first requests.
    """

    def __init__(self, graph: FakeParticipant, hosts: FakeForkServer) -> None:
        self.moved_to: list[str] = []
        self._graph = graph
        self._hosts = hosts

    async def answers(
        self, node: str, *, managed: bool, timeout_s: float, repeat: bool = False
    ) -> bool | None:
        return True

    def serves_parameters(self, node: str) -> bool | None:
        return True

    async def set_parameters(
        self, node: str, values: Mapping[str, Any], types: Mapping[str, str]
    ) -> None:
        assert values.keys() == types.keys()
        self._hosts.log.append(f"{node} set {values}")

    async def get_state(self, node: str, *, timeout_s: float) -> str:
        return self._graph.others[node]

    async def get_available_transitions(self, node: str, *, timeout_s: float) -> tuple[str, ...]:
        return tuple(_REACHED)

    async def change_state(
        self,
        node: str,
        transition: str,
        *,
        timeout_s: float,
        before: Callable[[], Awaitable[None]] | None = None,
    ) -> bool:
        await asyncio.sleep(self._hosts.takes_s.get(f"{node} {transition}", 0.0))
        if before is not None:
            await before()
        self._hosts.log.append(f"{node} {transition}")
        moved = self.moved_to.pop(0) if self.moved_to else _REACHED[transition]
        self._graph.others[node] = moved
        self._graph.note()
        return True

    async def get_configuration(self, node: str, *, timeout_s: float) -> NodeConfiguration | None:
        return None


class FakeNetworks(Networks):
    """Networks that take as long as hosts do for `networks programmed`, and fail as is said there.

    Args:
        hosts: have the log.
    """

    def __init__(self, hosts: FakeForkServer) -> None:
        self._hosts = hosts

    def replan(self, plan: Plan) -> None:
        """What it programs is of no account."""

    async def begin(self, verdict: Verdict, timeout_s: float | None = None) -> None:
        what = "networks programmed"
        self._hosts.log.append(f"{what} ({verdict.verdict.value})")
        await asyncio.sleep(self._hosts.takes_s.get(what, 0.0))
        if what in self._hosts.ways:
            raise BringUpError(self._hosts.ways[what])

    async def close(self, hurry: asyncio.Event) -> None:
        self._hosts.log.append("networks restored")


class _Story(list[str]):
    """Lines in the order in which they happen, which can be waited for.

    Attributes:
        in_the_moment: done once, before anything else, when a line that begins so is told.
    """

    def __init__(self) -> None:
        super().__init__()
        self.in_the_moment: dict[str, Callable[[], None]] = {}
        self._more = asyncio.Event()

    def append(self, line: str) -> None:
        if line.endswith(Operation.REPUBLISH_NAMES.value):
            return  # as often as it takes until discovery shows a node that was started again
        super().append(line)
        for start in tuple(self.in_the_moment):
            if line.startswith(start):
                self.in_the_moment.pop(start)()
        self._more.set()
        self._more = asyncio.Event()

    async def until(self, start: str, times: int = 1) -> None:
        """Wait for the line that begins so, for the second or third with `times`."""
        while sum(line.startswith(start) for line in self) < times:
            await self._more.wait()


_DETAIL = ("[process]", "[node]", "[request]", "[joined]", "[left]", "[log]")


def _applied(event: ManifestApplied) -> str:
    what = {"added": event.added, "parameters of": event.parameters}
    said = "".join(f", {word} {' '.join(names)}" for word, names in what.items() if names)
    return f"{event.stage} revision {event.revision}{said}"


def _judged(event: VerdictChanged) -> str:
    found = ", ".join(f"{each.rule} {each.subject}" for each in event.verdict.findings)
    return f"{event.stage.value} {event.verdict.verdict.value} {found}"


_SAID: dict[type, Callable[[Any], str]] = {
    ProcessChanged: lambda of: f"{of.process} {of.state.value} ({of.detail})",
    NodeChanged: lambda of: f"{of.node} {of.reach.value} ({of.state})",
    RequestSent: lambda of: f"{of.node} {of.operation.value}",
    VerdictChanged: _judged,
    GateOpened: lambda of: f"{of.outcome}: {', '.join(of.nodes)}",
    SystemReached: lambda of: f"{of.reached} at {of.elapsed_s:.1f} s",
    Failure: lambda of: f"{of.rule} {of.subject}{'' if of.ends_run else ', and the run goes on'}",
    Notice: lambda of: of.message,
    Stopped: lambda of: f"{of.exit_code}",
    NodeJoined: lambda of: of.node,
    NodeLeft: lambda of: of.node,
    RestartScheduled: lambda of: f"{of.process} in {of.in_s:.1f} s",
    Restarted: lambda of: f"{of.process} ({of.restarts})",
    ManifestApplied: _applied,
}


def _line(event: Event, now_s: float) -> str:
    if isinstance(event, Stopping):
        return f"[stopping] at {now_s:.1f} s: {event.reason}"
    said = _SAID.get(type(event), lambda _: "")(event)
    return f"[{event.kind}] {said}".removesuffix(" ()").rstrip()


class SessionWorld(World):
    """One session with all that it acts on; make it, prepare it, `run` it once.

    Attributes:
        story: what reached the hosts (`camera start`, `/camera configure`, `camera SIGTERM`) and
            all events in brackets, in the order in which they happened.
        hosts: start, and obey or not, as they are told.
        graph: what discovery shows beside the nodes of the hosts.
        result: of the run; None before its end.
        status: gives what `lifecycle status` shows; during the run.
        supervisor: likewise.
        prepare: called once that is made, before it runs.
    """

    def __init__(self, plan: Plan, tmp_path: Path, **options: Any) -> None:
        (tmp_path / "logs").mkdir()
        super().__init__(plan, tmp_path / "logs", **options)
        self.story = self.hosts.log = _Story()
        self.graph = FakeParticipant(self.hosts)
        self.ending = Ending()
        self.result: UpResult | None = None
        self.status: Callable[[], SystemStatus]
        self.supervisor: Supervisor
        self.prepare: Callable[[], None] = lambda: None
        self._stopping_at_s: float | None = None
        self._tmp_path = tmp_path
        self.emit.listen(self._take)
        self.journal = Journal(tmp_path / "logs", "robot", "0", say=self.story.append)
        self.emit.listen(self.journal.on_event)
        for node in plan.nodes:
            if node.run.kind is RunKind.ATTACH:
                self.graph.others[node.full_name] = "unconfigured"
            elif node.managed:
                self.hosts.interfaces[node.full_name] = interface_of(node.full_name)
        self._directory: RunDirectory | None = None

    @property
    def outline(self) -> list[str]:
        """The story without the states of single processes and nodes."""
        return [line for line in self.story if not line.startswith(_DETAIL)]

    def since(self, start: str, times: int = 1) -> list[str]:
        """The outline from the line on that begins so, for the second or third with `times`."""
        outline = self.outline
        found = [index for index, line in enumerate(outline) if line.startswith(start)]
        return outline[found[times - 1] :]

    @property
    def report(self) -> str:
        """How the run says that it ended."""
        assert self.result is not None
        assert self.result.verdict.run is not None
        return self.result.verdict.run.describe()

    @property
    def messages(self) -> list[str]:
        """What the last verdict says."""
        assert self.result is not None
        return [each.message for each in self.result.verdict.findings]

    async def run(self) -> None:
        """Run the session to its end."""
        with self.ending, self._run_directory() as directory:
            means = Means(
                directory=directory,
                fork_server=self.hosts,
                participant=self.graph,
                networks=FakeNetworks(self.hosts),
                ending=self.ending,
            )
            if self.system.run.options.adopt:
                processes = self.graph.processes()
                found = {name: processes.get(name, {}) for name in self.graph.others}
                self.system.adopt({name: where_it_runs(each) for name, each in found.items()})
            session = self.supervisor = Supervisor(self.system, means)
            self.prepare()
            self.status = session.status
            self.result = await session.run()
            await session.leave()
        self._check()

    @contextlib.asynccontextmanager
    async def running(self, since: str = "", times: int = 1) -> AsyncIterator[None]:
        """Run the session to its end; the body acts on it from the line on that begins so."""
        run = asyncio.ensure_future(self.run())
        body = asyncio.current_task()
        assert body is not None

        def interrupt(run: asyncio.Future[None]) -> None:
            if run.exception() is not None:
                body.cancel()

        run.add_done_callback(interrupt)
        try:
            await self.story.until(since, times if since else 0)
            yield
        except BaseException:
            if run.done():
                run.result()  # what went wrong first
            run.cancel()
            await asyncio.wait({run})
            raise
        run.remove_done_callback(interrupt)
        await run

    @contextlib.contextmanager
    def _run_directory(self) -> Iterator[RunDirectory]:
        self._directory = RunDirectory.acquire(self._tmp_path / "runs", "robot", "0")
        try:
            yield self._directory
        finally:
            self._directory.release()

    async def order(self, ask: ControlRequest, node: str = "", *, mode: str = "") -> str:
        """Order something through the control socket; return the answer, `0` or `4 cannot …`."""
        question = Question(ask=ask, node=node, mode=mode)
        answer = await self._asked(question)
        return f"{answer.exit_code} {answer.error}".rstrip()

    async def apply(self, plan: Plan, *, dry_run: bool = False, timeout_s: float = 0.0) -> Answer:
        """Have the system run by another manifest, which declares these nodes."""
        for node in plan.nodes:
            if node.managed and node.run.kind is not RunKind.ATTACH:
                report = interface_of(node.full_name)
                self.hosts.interfaces.setdefault(node.full_name, report)
        return await self._asked(
            Question(ask=ControlRequest.APPLY, plan=plan, dry_run=dry_run, timeout_s=timeout_s)
        )

    async def _asked(self, question: Question) -> Answer:
        assert self._directory is not None
        with short_path(self._directory.socket_path) as path:
            reader, writer = await asyncio.open_unix_connection(path)
        writer.write(to_json(question) + b"\n")
        answer = from_json(await reader.readline(), Answer)
        writer.close()
        await writer.wait_closed()
        return answer

    def intrude(self) -> None:
        """Let a node appear that nobody declared."""
        self.graph.others["/intruder"] = ""
        self.graph.note()

    def hide(self, *nodes: str) -> None:
        """Hide nodes from the graph, as behind a link that is cut; none: show all again."""
        self.graph.unseen = set(nodes)
        self.graph.note()

    def retreat(self) -> None:
        """Let the intruder leave."""
        del self.graph.others["/intruder"]
        self.graph.note()

    def kill(self, process: str) -> None:
        """Let a process end as by a crash."""
        self.hosts.processes[process].end(ProcessExit(signal=signal.SIGSEGV))

    def _take(self, event: Event) -> None:
        if isinstance(event, Stopping):
            self._stopping_at_s = self.emit.elapsed_s
        self.story.append(_line(event, self.emit.elapsed_s))

    def _check(self) -> None:
        """What holds in every run."""
        assert self.result is not None
        assert self.result.verdict.run is not None
        exit_code = int(self.result.exit_code)
        assert self.story[-1] == f"[stopped] {exit_code}"
        assert self.result.verdict.run.exit_code == exit_code
        assert self.story.count("networks restored") == 1
        assert all(each.has_ended for each in self.hosts.processes.values())
        assert self._stopping_at_s is not None
        assert self.emit.elapsed_s - self._stopping_at_s < SHUTDOWN_S
        self._check_gate()
        self._check_journal()

    def _check_journal(self) -> None:
        """Check that the journal tells the same story."""
        unreadable: list[str] = []
        recorded = read_run(journal_files(self._tmp_path / "logs"), unreadable.append)
        assert unreadable == []
        told = [_line(each.event, 0.0) for each in recorded if each.event is not None]
        story = [line for line in self.story if line.startswith("[") and line != "[log]"]
        assert [line.partition(" at ")[0] for line in told] == [
            line.partition(" at ")[0] for line in story
        ]

    def _check_gate(self) -> None:
        opened: set[str] = set()
        verdict = "none"
        for line in self.story:
            kind, _, rest = line.partition(" ")
            if kind == "[verdict]":
                verdict = rest.split()[1]
            elif kind == "[gate]":
                opened = set(rest.partition(": ")[2].split(", "))
            elif kind == "[stopping]" or rest == Operation.DEACTIVATE.value:
                opened.clear()
            elif rest == Operation.ACTIVATE.value and not kind.startswith("["):
                assert kind in opened, f"{kind} was activated while its gate was closed"
                assert verdict in ("ok", "unverifiable"), f"{kind} was activated on {verdict}"


CHAIN = plan_of(planned_node("camera"), planned_node("viewer", after={"camera": Condition.ACTIVE}))

_URLS = ("tcpv4://127.0.0.1:7911", "tcpv4://127.0.0.1:7912?peer=127.0.0.1:7911")
DIALLING = plan_of(
    *(
        replace(node, connections=ParticipantConnections(urls=(url,)))
        for node, url in zip(CHAIN.nodes, _URLS, strict=True)
    )
)
"""The same by TCP alone: `viewer` gets another port when it is started again."""

CONNECTED = [
    "camera start",
    "viewer start",
    "/camera configure",
    "/viewer configure",
    "/camera connect",
    "/viewer connect",
    "[system] connected at 0.0 s",
]
VERIFIED = ["[verdict] connected ok", "[system] verified at 0.0 s", "networks programmed (ok)"]
OPENED = "[gate] ok: /camera, /viewer"
ACTIVATED = [OPENED, "/camera activate", "/viewer activate", "[system] active at 0.0 s"]

CAMERA_DOWN = ["/camera disconnect", "/camera cleanup", "/camera shutdown"]
VIEWER_DOWN = ["/viewer disconnect", "/viewer cleanup", "/viewer shutdown"]
DOWN = ["/viewer deactivate", *VIEWER_DOWN, "/camera deactivate", *CAMERA_DOWN]
"""In reverse order of what was done, and of who waited for whom."""

KILLED = ["camera SIGTERM", "[notice] process 'camera' had to be ended with SIGTERM"]
"""It is in the middle of a step, and not asked for anything more."""

BACK = [*VIEWER_DOWN, *CAMERA_DOWN]
"""Of a system that was connected and not activated."""

ATTACHED = plan_of(
    planned_node("camera"),
    planned_node("base", kind=RunKind.ATTACH, after={"camera": Condition.ACTIVE}),
)
"""Another program runs `base`; the supervisor configures and activates it."""

CHANGED = "the system changed before every node was activated"

REFUSED = """cannot activate: the verdict is violated
  graph.undeclared-node: the manifest does not declare node /intruder"""

INTRUDED = "graph.undeclared-node /intruder"


def over(exit_code: int) -> list[str]:
    """The end of every outline."""
    return ["networks restored", f"[stopped] {exit_code}"]
