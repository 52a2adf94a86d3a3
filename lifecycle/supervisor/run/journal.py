"""Journal of a run: what happened and what was seen, kept on disk for afterwards.

Owns: the lines of `journal.jsonl` (schema: schemas/journal.v1.schema.json), beside the logs of the
run's processes, and `Journal`, which writes them at once, so that a supervisor that is killed
leaves all of it. An observation is written as what changed since the one before. A file that is
full becomes `journal.jsonl.1`; each begins with the plan and a whole observation, so that it can be
read alone. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Protocol, TypeVar

from lifecycle import codec, dataclasses
from lifecycle.codec import Count, says
from lifecycle.plan import Plan, without_secrets
from lifecycle.supervisor.processes.logs import JOURNAL_NAME
from lifecycle.supervisor.processes.usage import ResourceUse, resource_use
from lifecycle.supervisor.run.events import (
    Event,
    Failure,
    LogLine,
    ProcessChanged,
    Stopped,
    VerdictChanged,
)
from lifecycle.verify import (
    Finding,
    NodeConfiguration,
    NodeParameters,
    Observation,
    ObservedEndpoint,
    ObservedNode,
    Outcome,
    Stage,
    Verdict,
)

T = TypeVar("T")

LARGEST_JOURNAL = 16 * 2**20
"""Bytes of a file; there is one, and one older."""

USE_S = 60.0
"""How often what the processes use is noted."""

_MARKED = (Failure, ProcessChanged, Stopped, VerdictChanged)
"""Events at which it is noted how long logs are: what a process wrote explains them."""

_TRIED_AGAIN_S = 1.0
"""How often a journal is tried that could not be written."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class NodesChange:
    """How the observed nodes differ from those before.

    Attributes:
        gone: indices, in the list before, of what is not there any more or not as it was.
        new: what is there instead, each with its index in the list now; ascending.
    """

    gone: tuple[Count, ...] = ()
    new: tuple[tuple[Count, ObservedNode], ...] = ()


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class EndpointsChange:
    """How the observed endpoints differ from those before; as NodesChange."""

    gone: tuple[Count, ...] = ()
    new: tuple[tuple[Count, ObservedEndpoint], ...] = ()


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ConfigurationsChange:
    """How the nodes' reports differ from those before; as NodesChange."""

    gone: tuple[Count, ...] = ()
    new: tuple[tuple[Count, NodeConfiguration], ...] = ()


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ParametersChange:
    """How what parameter services answered differs from before; as NodesChange."""

    gone: tuple[Count, ...] = ()
    new: tuple[tuple[Count, NodeParameters], ...] = ()


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class JudgedFinding:
    """What `verify` found, as far as it takes to compare: rule, subject, node and outcome."""

    rule: str
    subject: str
    outcome: Outcome
    node: str = ""


def judged_finding(finding: Finding) -> JudgedFinding:
    """Return of a finding what a journal keeps."""
    return JudgedFinding(
        rule=finding.rule, subject=finding.subject, outcome=finding.outcome, node=finding.node
    )


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """One look at the running system: what `verify` was given, and what it found.

    Attributes:
        whole: the observation is not told from the one before, but from nothing.
        machines: as `verify` was given them; None: all machines are ours.
        ahead: likewise.
        over: likewise.
        outcome: of `verify`; the supervisor's own findings are in the verdict events.
        findings: of `verify`.
    """

    stage: Stage
    outcome: Outcome
    findings: tuple[JudgedFinding, ...]
    whole: bool = False
    machines: tuple[str, ...] | None = None
    ahead: tuple[str, ...] = ()
    over: dict[str, str] = dataclasses.field(default_factory=dict)
    nodes: NodesChange | None = None
    endpoints: EndpointsChange | None = None
    configurations: ConfigurationsChange | None = None
    parameters: ParametersChange | None = None


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class JournaledRun:
    """Which run a journal is of; the first line of each file.

    Attributes:
        journal_version: of the lines, 1.
        run_id: value of LIFECYCLE_RUN in each process of the run.
        supervisor: pid.
    """

    journal_version: Annotated[int, says(const=1)]
    system: str
    run_id: str
    supervisor: Count


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class JournalLine:
    """One line of a journal; of what follows the times it has one, and may have `output`.

    Attributes:
        at: when, in seconds since the epoch, by the clock of the host, which may be set.
        elapsed_s: seconds since the supervisor began, by a clock that only goes forward.
        run: which run it is.
        plan: what the system is judged against from here on; values of environment variables that
            look like secrets are not in it.
        event: as `up --format json` prints it; lines of processes are in their logs, and verdicts
            are without their flows, which follow from the look before.
        look: what was seen and found.
        use: what each process used, by its name.
        output: bytes in each process's log file at that moment, where that changed; with what
            processes use, and with events that a process's output may explain.
    """

    at: float
    elapsed_s: float
    run: JournaledRun | None = None
    plan: Plan | None = None
    event: dict[str, Any] | None = None
    look: Look | None = None
    use: dict[str, ResourceUse] | None = None
    output: dict[str, Count] | None = None


class RunningProcess(Protocol):
    """A process of which is noted what it uses, see processes/process.py."""

    @property
    def name(self) -> str:
        """Of the planned process."""

    @property
    def pid(self) -> int:
        """Process id."""

    @property
    def cgroup(self) -> Path | None:
        """Directory of its own cgroup; None if it has none."""


class Journal:
    """Writes the journal of one run.

    What comes before `writing` is kept until then. A journal that cannot be written ends nothing:
    that is said once, and tried again; what is missing is told by a whole look.

    Args:
        system: its name.
        run_id: see JournaledRun.
        say: takes what a person should know.
        wall: seconds since the epoch.
        clock: seconds, on a clock that only goes forward.
    """

    def __init__(
        self,
        system: str,
        run_id: str,
        *,
        say: Callable[[str], None],
        wall: Callable[[], float] = time.time,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._run = JournaledRun(
            journal_version=1, system=system, run_id=run_id, supervisor=os.getpid()
        )
        self._say = say
        self._wall = wall
        self._clock = clock
        self._began = clock()
        self._waiting: list[bytes] | None = []
        self._path: Path | None = None
        self._file: int | None = None
        self._bytes = 0
        self._torn = False
        self._failed_s: float | None = None
        self._plan: Plan | None = None
        self._seen: Observation | None = None
        self._looked: Look | None = None
        self._positions: Callable[[], Mapping[str, int]] = dict
        self._noted: dict[str, int] = {}

    @contextlib.contextmanager
    def writing(
        self, directory: Path, *, positions: Callable[[], Mapping[str, int]]
    ) -> Iterator[None]:
        """Write into `directory` meanwhile.

        Args:
            directory: of the run's logs.
            positions: returns how many bytes the log file of each process has.
        """
        self._path = directory / JOURNAL_NAME
        self._positions = positions
        waiting, self._waiting = self._waiting or [], None
        for line in waiting:
            self._write(line)
        try:
            yield
        finally:
            self._shut()
            self._path = None

    @contextlib.contextmanager
    def noting_use(self, living: Callable[[], Iterable[RunningProcess]]) -> Iterator[None]:
        """Note what processes use every USE_S meanwhile, in the running event loop.

        Args:
            living: returns the living processes.
        """
        loop = asyncio.get_running_loop()
        timers: list[asyncio.TimerHandle] = []

        def note() -> None:
            timers[:] = [loop.call_later(USE_S, note)]
            self._note_use(living())

        timers.append(loop.call_later(USE_S, note))
        try:
            yield
        finally:
            timers[0].cancel()

    def on_event(self, event: Event) -> None:
        """Note an event; a listener of the run."""
        if isinstance(event, LogLine):
            return
        self._make_room()
        if isinstance(event, VerdictChanged):
            verdict = dataclasses.replace(event.verdict, flows=(), open_endpoints=())
            event = dataclasses.replace(event, verdict=verdict)
        plain = codec.to_plain(event)
        assert isinstance(plain, dict)
        self._add(event={"event": event.kind, **plain}, marks=isinstance(event, _MARKED))

    def looked(
        self,
        plan: Plan,
        observation: Observation,
        verdict: Verdict,
        *,
        stage: Stage,
        machines: frozenset[str] | None,
        ahead: frozenset[str],
        over: Mapping[str, str],
    ) -> None:
        """Note what was seen and what `verify` found, if that differs from the last time."""
        self._make_room()
        if plan is not self._plan and plan != self._plan:
            self._plan = plan
            self._add(plan=without_secrets(plan))
        before = self._seen
        seen = Observation() if before is None else before
        same = Look(
            stage=stage,
            outcome=verdict.verdict,
            findings=tuple(map(judged_finding, verdict.findings)),
            machines=None if machines is None else tuple(sorted(machines)),
            ahead=tuple(sorted(ahead)),
            over=dict(over),
        )
        look = _told(same, seen, observation, whole=before is None)
        if look == self._looked:
            return
        self._looked = same
        self._seen = observation
        self._add(look=look)

    def _shut(self) -> None:
        if self._file is not None:
            os.close(self._file)
        self._file, self._bytes, self._torn = None, 0, False

    def _make_room(self) -> None:
        """Begin a new file where this one is full, with all that it takes to read it alone."""
        if self._bytes < LARGEST_JOURNAL or self._path is None:
            return
        plan, seen, looked = self._plan, self._seen, self._looked
        try:
            self._path.replace(self._path.with_name(f"{self._path.name}.1"))
        except OSError as error:
            self._fails(error)
            return
        self._shut()
        self._noted.clear()
        if plan is not None:
            self._add(plan=without_secrets(plan))
        if seen is not None and looked is not None:
            self._add(look=_told(looked, Observation(), seen, whole=True))

    def _note_use(self, living: Iterable[RunningProcess]) -> None:
        self._make_room()
        found = {each.name: resource_use(each.pid, each.cgroup) for each in living}
        use = {name: each for name, each in found.items() if each is not None}
        if use:
            self._add(use=use, marks=True)

    def _add(self, *, marks: bool = False, **content: object) -> None:
        if marks:
            output = {
                name: position
                for name, position in self._positions().items()
                if position != self._noted.get(name)
            }
            if output:
                self._noted.update(output)
                content["output"] = output
        line = self._line(**content)
        if self._waiting is None:
            self._write(line)
        else:
            self._waiting.append(line)

    def _line(self, **content: object) -> bytes:
        now = {"at": round(self._wall(), 6), "elapsed_s": round(self._clock() - self._began, 6)}
        return codec.to_json({**now, **content}) + b"\n"

    def _write(self, line: bytes) -> None:
        if self._path is None:
            return  # the run is over
        if self._failed_s is not None and self._clock() - self._failed_s < _TRIED_AGAIN_S:
            self._misses()
            return
        try:
            self._put(line)
            self._failed_s = None
        except OSError as error:
            self._fails(error)

    def _fails(self, error: OSError) -> None:
        first, self._failed_s = self._failed_s is None, self._clock()
        self._misses()
        if first:
            self._say(
                f"cannot write {str(self._path)!r}: {error.strerror}; the run goes on, and "
                "what happens meanwhile is missing there"
            )

    def _misses(self) -> None:
        """What follows cannot be told from what is not written: begin with all again."""
        self._seen = self._plan = self._looked = None
        self._noted.clear()

    def _put(self, line: bytes) -> None:
        if self._file is None:
            self._file = self._open()
        if not self._bytes:
            line = self._line(run=self._run) + line
        data = memoryview(b"\n" * self._torn + line)
        while data:
            written = os.write(self._file, data)
            self._bytes += written
            data = data[written:]
            self._torn = bool(data)

    def _open(self) -> int:
        assert self._path is not None
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
        file = os.open(self._path, flags, 0o600)
        self._bytes = os.fstat(file).st_size
        return file


def _told(look: Look, before: Observation, now: Observation, *, whole: bool) -> Look:
    """Return `look` with how what was seen differs from what was seen before."""
    nodes = changed(before.nodes, now.nodes, _node_key)
    endpoints = changed(before.endpoints, now.endpoints, _endpoint_key)
    reports = changed(before.configurations, now.configurations, _name)
    parameters = changed(before.parameters, now.parameters, _node)
    return dataclasses.replace(
        look,
        whole=whole,
        nodes=nodes and NodesChange(gone=nodes[0], new=nodes[1]),
        endpoints=endpoints and EndpointsChange(gone=endpoints[0], new=endpoints[1]),
        configurations=reports and ConfigurationsChange(gone=reports[0], new=reports[1]),
        parameters=parameters and ParametersChange(gone=parameters[0], new=parameters[1]),
    )


def _node_key(node: ObservedNode) -> Hashable:
    return node.full_name


def _endpoint_key(endpoint: ObservedEndpoint) -> Hashable:
    return endpoint.kind, endpoint.node, endpoint.name, endpoint.gid


def _name(configuration: NodeConfiguration) -> Hashable:
    return configuration.name


def _node(parameters: NodeParameters) -> Hashable:
    return parameters.node


def changed(
    before: tuple[T, ...], now: tuple[T, ...], key: Callable[[T], Hashable]
) -> tuple[tuple[int, ...], tuple[tuple[int, T], ...]] | None:
    """Return (gone, new) as in NodesChange; None where nothing changed.

    Args:
        before: the list before.
        now: the list now; what stays keeps its order, or is gone and new.
        key: of two values that are equal, it is equal, too.
    """
    if before is now or before == now:
        return None
    places: dict[Hashable, list[int]] = {}
    for index in reversed(range(len(before))):
        places.setdefault(key(before[index]), []).append(index)
    kept: set[int] = set()
    new: list[tuple[int, T]] = []
    last = -1
    for index, value in enumerate(now):
        candidates = places.get(key(value), [])
        while candidates:
            place = candidates.pop()
            if place > last and (before[place] is value or before[place] == value):
                kept.add(place)
                last = place
                break
        else:
            new.append((index, value))
    return tuple(each for each in range(len(before)) if each not in kept), tuple(new)


def restored(
    before: tuple[T, ...], gone: Iterable[int], new: Iterable[tuple[int, T]]
) -> tuple[T, ...]:
    """Return the list that `changed` was told of.

    Raises:
        ValueError: an index that does not fit: a line is missing.
    """
    left = set(gone)
    if left and max(left) >= len(before):
        raise ValueError("the line before is missing")
    values = [value for index, value in enumerate(before) if index not in left]
    for index, value in new:
        if index > len(values):
            raise ValueError("the line before is missing")
        values.insert(index, value)
    return tuple(values)
