"""Typed events of a run, which listeners get from its supervisor.

Owns: the event types, their JSON names, and `Emitter`, which gives each event to every listener in
order. Presentation lives in cli/. Must not import rclpy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Union, get_args

import msgspec

from lifecycle.codec import to_plain
from lifecycle.node.host.control import Operation
from lifecycle.supervisor.control.protocol import Failed, ProcessState, Reach
from lifecycle.verify.verdict import Stage, Verdict


class RunStarted(msgspec.Struct, frozen=True, kw_only=True):
    """A supervisor took charge of a system.

    Attributes:
        log_directory: where each process's output is kept.
    """

    kind: ClassVar[str] = "run"
    system: str
    domain_id: int
    rmw: str
    discovery_range: str
    nodes: tuple[str, ...]
    processes: tuple[str, ...]
    log_directory: str


class ProcessChanged(msgspec.Struct, frozen=True, kw_only=True):
    """A process changed its state.

    Attributes:
        pid: 0 before it was spawned.
        detail: how it ended, `exit status 1`, `killed by SIGKILL`; else empty.
    """

    kind: ClassVar[str] = "process"
    process: str
    state: ProcessState
    pid: int = 0
    detail: str = ""


class RequestSent(msgspec.Struct, frozen=True, kw_only=True):
    """A request to one node is about to be sent; what the gate's promise is checked against."""

    kind: ClassVar[str] = "request"
    node: str
    operation: Operation


class NodeChanged(msgspec.Struct, frozen=True, kw_only=True):
    """A node came a step further, or its state changed.

    Attributes:
        node: fully qualified name.
        state: lifecycle_msgs/State label; empty for a node that is not managed.
    """

    kind: ClassVar[str] = "node"
    node: str
    reach: Reach
    state: str = ""
    connected: bool = False


class WiringChanged(msgspec.Struct, frozen=True, kw_only=True):
    """The authority made a connection or a mapping, unmade one, or failed to.

    Attributes:
        operation: CONNECT_TO, MAP_TO or DISCONNECT_FROM.
        connection: its name; empty for the node's own participant.
        endpoint: `publishers/video`, of a mapping.
        urls: what a connection was made to.
        attempt: 1 unless it was lost or could not be made before.
        error: why it could not be made; empty if it was.
    """

    kind: ClassVar[str] = "wiring"
    node: str
    operation: Operation
    connection: str = ""
    endpoint: str = ""
    urls: tuple[str, ...] = ()
    attempt: int = 1
    error: str = ""


class WiringLost(msgspec.Struct, frozen=True, kw_only=True):
    """A connection or a mapping that the authority had made is no more.

    Attributes:
        connection: its name; empty for the node's own participant.
        endpoint: `publishers/video`, of a mapping; empty for a connection.
    """

    kind: ClassVar[str] = "lost"
    node: str
    connection: str = ""
    endpoint: str = ""


class NodeSilent(msgspec.Struct, frozen=True, kw_only=True):
    """Nothing can be expected of a node any more, though it has not left.

    Attributes:
        cause: "stopped" by a signal, "hung" in a callback, "unserved" by an overloaded machine,
            "lost" from the network, or "told" by its own supervisor.
    """

    kind: ClassVar[str] = "silent"
    node: str
    cause: str
    message: str


class NodeAlive(msgspec.Struct, frozen=True, kw_only=True):
    """A node is not silent any more.

    Attributes:
        silent_s: for how long it was silent.
        there: False for one that is not in the graph, or has not started: what made it silent is
            over, and no more is known.
    """

    kind: ClassVar[str] = "alive"
    node: str
    silent_s: float
    there: bool = True


class NodeJoined(msgspec.Struct, frozen=True, kw_only=True):
    """A node is in the graph that was not there when it was last looked at."""

    kind: ClassVar[str] = "joined"
    node: str


class NodeLeft(msgspec.Struct, frozen=True, kw_only=True):
    """A node is not in the graph any more; what is silent leaves it when its DDS lease is over."""

    kind: ClassVar[str] = "left"
    node: str


class MachineConnection(msgspec.Struct, frozen=True, kw_only=True):
    """The supervisor of another machine is connected, or not any more.

    Attributes:
        machine: its name in the manifest.
        established: it is connected.
        lost_s: for how long it was not; 0 the first time.
        left: its supervisor was shut down and said so; else the connection was lost.
    """

    kind: ClassVar[str] = "connection"
    machine: str
    established: bool
    lost_s: float = 0.0
    left: bool = False


class LogLine(msgspec.Struct, frozen=True, kw_only=True):
    """One line that a process wrote.

    Attributes:
        stream: "stdout" or "stderr".
    """

    kind: ClassVar[str] = "log"
    process: str
    stream: str
    line: str


class VerdictChanged(msgspec.Struct, frozen=True, kw_only=True):
    """The running system was judged and the result differs from the one before."""

    kind: ClassVar[str] = "verdict"
    stage: Stage
    verdict: Verdict


class GateOpened(msgspec.Struct, frozen=True, kw_only=True):
    """The verdict lets the system activate.

    Attributes:
        trusted: what could not be verified and is taken on trust, in one line; empty if nothing.
    """

    kind: ClassVar[str] = "gate"
    outcome: str
    nodes: tuple[str, ...]
    trusted: str = ""


class SystemReached(msgspec.Struct, frozen=True, kw_only=True):
    """The whole system is connected, verified or active.

    Attributes:
        reached: "connected", "verified" or "active".
        elapsed_s: since the supervisor started.
    """

    kind: ClassVar[str] = "system"
    reached: str
    elapsed_s: float


class StageTimed(msgspec.Struct, frozen=True, kw_only=True):
    """How long a stage of bring-up took; `up --timings` has one of each once bring-up is over.

    Attributes:
        stage: "supervisor", "processes", "configured", "connected", "observed", "verified",
            "active" or "total".
        took_s: since the stage before it was over; of the total, all of it.
        elapsed_s: since the command was started.
        last: name of the node that was the last to come so far, where it was a node's to do.
    """

    kind: ClassVar[str] = "stage"
    stage: str
    took_s: float
    elapsed_s: float
    last: str = ""


class Failure(msgspec.Struct, frozen=True, kw_only=True):
    """A step that failed, or a process that ended unasked; the last verdict has it as a finding.

    Attributes:
        rule: id of the finding it becomes, `run.process-died`.
        subject: node or process, as in that finding.
        process: name of the process concerned; empty if there is none of ours.
        log: the file with all that its process wrote, which came as log events, too.
        ends_run: the run ends for it; not so under --keep-going, and where it is started again.
    """

    kind: ClassVar[str] = "failure"
    rule: str
    subject: str
    message: str
    process: str = ""
    log: str = ""
    ends_run: bool = True


class RestartScheduled(msgspec.Struct, frozen=True, kw_only=True):
    """A process failed that is to be started again; until then it is in backoff.

    Attributes:
        nodes: those that are started again with it; all of them are down.
        reason: the failure, a whole sentence.
        stderr: the last line that it wrote to standard error; empty if none.
        restarts: how often it was started again before.
        in_s: seconds until it is.
    """

    kind: ClassVar[str] = "backoff"
    process: str
    nodes: tuple[str, ...]
    reason: str
    stderr: str
    restarts: int
    in_s: float


class Restarted(msgspec.Struct, frozen=True, kw_only=True):
    """A process that failed is as far again as the system is: active and verified, or paused.

    Attributes:
        nodes: those in it.
        restarts: how often it has been started again.
        took_s: since its failure.
    """

    kind: ClassVar[str] = "restarted"
    process: str
    nodes: tuple[str, ...]
    restarts: int
    took_s: float


class GaveUp(msgspec.Struct, frozen=True, kw_only=True):
    """A process failed too often to be started again; the run ends for it.

    Attributes:
        history: its failures, the last at the end.
    """

    kind: ClassVar[str] = "gave_up"
    process: str
    restarts: int
    history: tuple[Failed, ...]


class ConsequenceTaken(msgspec.Struct, frozen=True, kw_only=True):
    """A violation of an active system lasts, and what the manifest asks for is done about it.

    Attributes:
        action: "deactivate", "mode", "pause" or "stop".
        nodes: those that are deactivated; empty where it is for the whole system.
        rule: id of the finding's rule.
        message: the finding's, a whole sentence.
    """

    kind: ClassVar[str] = "consequence"
    action: str
    nodes: tuple[str, ...]
    rule: str
    subject: str
    message: str


class ModeEntered(msgspec.Struct, frozen=True, kw_only=True):
    """The system is in another mode.

    Attributes:
        mode: its name.
        before: that of the mode that it was in.
        inactive: names of the nodes that it keeps inactive.
        parameters: names of the nodes that have other parameters than in the mode before.
    """

    kind: ClassVar[str] = "mode"
    mode: str
    before: str
    inactive: tuple[str, ...]
    parameters: tuple[str, ...] = ()


class ManifestApplied(msgspec.Struct, frozen=True, kw_only=True):
    """A running system is to run by another manifest, does so, or goes back to the one before.

    Attributes:
        stage: "begun", "applied", "rolling_back" or "rolled_back".
        manifest: path of the one that is, or was, to be applied.
        revision: number of the one that is in force at this moment.
        differences: from the manifest in force before, one line each.
        added: names of nodes, likewise of the others; of those that stay none is there.
        parameters: that are only given parameters.
        reason: why the system goes back; else empty.
    """

    kind: ClassVar[str] = "apply"
    stage: str
    manifest: str
    revision: int
    differences: tuple[str, ...] = ()
    added: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    restarted: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    reason: str = ""


class Notice(msgspec.Struct, frozen=True, kw_only=True):
    """Something a person should know that changes nothing: orphans swept, a step forced."""

    kind: ClassVar[str] = "notice"
    message: str


class Stopping(msgspec.Struct, frozen=True, kw_only=True):
    """The system is being taken down."""

    kind: ClassVar[str] = "stopping"
    reason: str


class Stopped(msgspec.Struct, frozen=True, kw_only=True):
    """Nothing of the system runs any more.

    Attributes:
        reason: why the run ended, as in its report; empty if it did not come so far.
    """

    kind: ClassVar[str] = "stopped"
    exit_code: int
    elapsed_s: float
    reason: str = ""


Event = Union[  # noqa: UP007 - a run-time alias on Python 3.10
    RunStarted,
    ProcessChanged,
    RequestSent,
    NodeChanged,
    WiringChanged,
    WiringLost,
    NodeSilent,
    NodeAlive,
    NodeJoined,
    NodeLeft,
    MachineConnection,
    LogLine,
    VerdictChanged,
    GateOpened,
    SystemReached,
    StageTimed,
    Failure,
    RestartScheduled,
    Restarted,
    GaveUp,
    ConsequenceTaken,
    ModeEntered,
    ManifestApplied,
    Notice,
    Stopping,
    Stopped,
]
Listener = Callable[[Event], None]


class Emitter:
    """Gives every event to every listener, in the order of their registration.

    Args:
        clock: seconds, on any clock that only goes forward.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._listeners: list[Listener] = []
        self._clock = clock
        self._began = clock()

    @property
    def elapsed_s(self) -> float:
        """Seconds since this emitter, and with it the run, began."""
        return self._clock() - self._began

    def listen(self, listener: Listener) -> None:
        """Add a listener; it runs in the supervisor's loop and must not block."""
        self._listeners.append(listener)

    def __call__(self, event: Event) -> None:
        """Give `event` to every listener."""
        for listener in tuple(self._listeners):
            listener(event)


def to_record(event: Event) -> dict[str, object]:
    """Return `event` as the JSON object that `--format json` prints."""
    plain = to_plain(event)
    assert isinstance(plain, dict)
    if isinstance(event, VerdictChanged):
        from lifecycle.verify.report import plain_findings  # imports every rule

        plain["verdict"]["findings"] = plain_findings(event.verdict)
    return {"event": event.kind, **plain}


_KINDS: dict[str, type[Event]] = {each.kind: each for each in get_args(Event)}


def from_record(record: Mapping[str, Any]) -> Event | None:
    """Return the event that `to_record` wrote; None for a kind that this version does not know.

    Raises:
        ValueError: it is not what its kind has.
    """
    kind = _KINDS.get(str(record.get("event")))
    return None if kind is None else msgspec.convert(record, kind)
