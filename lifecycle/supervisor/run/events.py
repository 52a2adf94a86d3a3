"""Typed events of a run, which listeners get from its supervisor.

Owns: the event types, their JSON names, and `Emitter`, which gives each event to every listener in
order. Presentation lives in cli/. Must not import rclpy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import msgspec

from lifecycle.errors import BringUpError
from lifecycle.node.host.control import Operation
from lifecycle.supervisor.control.protocol import ProcessState, Reach
from lifecycle.verify.verdict import Stage, Verdict


class Event(msgspec.Struct, frozen=True, kw_only=True, tag_field="event"):
    """What happened in a run; its JSON names its kind as `event`."""

    @property
    def kind(self) -> str:
        """Its name in JSON."""
        return str(self.__struct_config__.tag)


class RunStarted(Event, frozen=True, kw_only=True, tag="run"):
    """A supervisor took charge of a system.

    Attributes:
        log_directory: where each process's output is kept.
    """

    system: str
    domain_id: int
    rmw: str
    discovery_range: str
    nodes: tuple[str, ...]
    processes: tuple[str, ...]
    log_directory: str


class ProcessChanged(Event, frozen=True, kw_only=True, tag="process"):
    """A process changed its state.

    Attributes:
        pid: 0 before it was spawned.
        detail: how it ended, `exit status 1`, `killed by SIGKILL`; else empty.
    """

    process: str
    state: ProcessState
    pid: int = 0
    detail: str = ""


class RequestSent(Event, frozen=True, kw_only=True, tag="request"):
    """A request to one node is about to be sent; what the gate's promise is checked against."""

    node: str
    operation: Operation


class NodeChanged(Event, frozen=True, kw_only=True, tag="node"):
    """A node came a step further, or its state changed.

    Attributes:
        node: fully qualified name.
        state: lifecycle_msgs/State label; empty for a node that is not managed.
    """

    node: str
    reach: Reach
    state: str = ""
    connected: bool = False


class WiringChanged(Event, frozen=True, kw_only=True, tag="wiring"):
    """The authority made a connection or a mapping, unmade one, or failed to.

    Attributes:
        operation: CONNECT_TO, MAP_TO or DISCONNECT_FROM.
        connection: its name; empty for the node's own participant.
        endpoint: `publishers/video`, of a mapping.
        urls: what a connection was made to.
        attempt: 1 unless it was lost or could not be made before.
        error: why it could not be made; empty if it was.
    """

    node: str
    operation: Operation
    connection: str = ""
    endpoint: str = ""
    urls: tuple[str, ...] = ()
    attempt: int = 1
    error: str = ""


class WiringLost(Event, frozen=True, kw_only=True, tag="lost"):
    """A connection or a mapping that the authority had made is no more.

    Attributes:
        connection: its name; empty for the node's own participant.
        endpoint: `publishers/video`, of a mapping; empty for a connection.
    """

    node: str
    connection: str = ""
    endpoint: str = ""


class NodeSilent(Event, frozen=True, kw_only=True, tag="silent"):
    """Nothing can be expected of a node any more, though it has not left.

    Attributes:
        cause: "stopped" by a signal, "hung" in a callback, "lost" from the network, or "told" by
            its own supervisor.
    """

    node: str
    cause: str
    message: str


class NodeAlive(Event, frozen=True, kw_only=True, tag="alive"):
    """A node is not silent any more.

    Attributes:
        silent_s: for how long it was silent.
        there: False for one that is not in the graph, or has not started: what made it silent is
            over, and no more is known.
    """

    node: str
    silent_s: float
    there: bool = True


class NodeJoined(Event, frozen=True, kw_only=True, tag="joined"):
    """A node is in the graph that was not there when it was last looked at."""

    node: str


class NodeLeft(Event, frozen=True, kw_only=True, tag="left"):
    """A node is not in the graph any more; what is silent leaves it when its DDS lease is over."""

    node: str


class MachineConnection(Event, frozen=True, kw_only=True, tag="connection"):
    """The supervisor of another machine is connected, or not any more.

    Attributes:
        machine: its name in the manifest.
        established: it is connected.
        lost_s: for how long it was not; 0 the first time.
        left: its supervisor was shut down and said so; else the connection was lost.
    """

    machine: str
    established: bool
    lost_s: float = 0.0
    left: bool = False


class LogLine(Event, frozen=True, kw_only=True, tag="log"):
    """One line that a process wrote.

    Attributes:
        stream: "stdout" or "stderr".
    """

    process: str
    stream: str
    line: str


class VerdictChanged(Event, frozen=True, kw_only=True, tag="verdict"):
    """The running system was judged and the result differs from the one before."""

    stage: Stage
    verdict: Verdict


class GateOpened(Event, frozen=True, kw_only=True, tag="gate"):
    """The verdict lets the system activate.

    Attributes:
        trusted: what could not be verified and is taken on trust, in one line; empty if nothing.
    """

    outcome: str
    nodes: tuple[str, ...]
    trusted: str = ""


class SystemReached(Event, frozen=True, kw_only=True, tag="system"):
    """The whole system is connected, verified or active.

    Attributes:
        reached: "connected", "verified" or "active".
        elapsed_s: since the supervisor started.
    """

    reached: str
    elapsed_s: float


class Failure(Event, frozen=True, kw_only=True, tag="failure"):
    """A step that failed, or a process that ended unasked; the last verdict has it as a finding.

    Attributes:
        rule: id of the finding it becomes, `run.process-died`.
        subject: node or process, as in that finding.
        process: name of the process concerned; empty if there is none of ours.
        log: the file with all that its process wrote, which came as log events, too.
        ends_run: the run ends for it; not so under --keep-going, and where it is started again.
    """

    rule: str
    subject: str
    message: str
    process: str = ""
    log: str = ""
    ends_run: bool = True


class StepFailedError(BringUpError):
    """A step of bring-up failed that is no request to a node; `failure` is all of it."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(failure.message)
        self.failure = failure


class RestartScheduled(Event, frozen=True, kw_only=True, tag="backoff"):
    """A process failed that is to be started again; until then it is in backoff.

    Attributes:
        nodes: those that are started again with it; all of them are down.
        reason: the failure, a whole sentence.
        stderr: the last line that it wrote to standard error; empty if none.
        restarts: how often it was started again before.
        in_s: seconds until it is.
    """

    process: str
    nodes: tuple[str, ...]
    reason: str
    stderr: str
    restarts: int
    in_s: float


class Restarted(Event, frozen=True, kw_only=True, tag="restarted"):
    """A process that failed is as far again as the system is: active and verified, or paused.

    Attributes:
        nodes: those in it.
        restarts: how often it has been started again.
        took_s: since its failure.
    """

    process: str
    nodes: tuple[str, ...]
    restarts: int
    took_s: float


class GaveUp(Event, frozen=True, kw_only=True, tag="gave_up"):
    """A process failed too often to be started again; the run ends for it.

    The finding `run.gave-up` has the last failure; all are events of the run, and in its journal.
    """

    process: str
    restarts: int


class ConsequenceTaken(Event, frozen=True, kw_only=True, tag="consequence"):
    """A violation of an active system lasts, and what the manifest asks for is done about it.

    Attributes:
        action: "deactivate", "mode", "pause" or "stop".
        nodes: those that are deactivated; empty where it is for the whole system.
        rule: id of the finding's rule.
        message: the finding's, a whole sentence.
    """

    action: str
    nodes: tuple[str, ...]
    rule: str
    subject: str
    message: str


class ModeEntered(Event, frozen=True, kw_only=True, tag="mode"):
    """The system is in another mode.

    Attributes:
        mode: its name.
        before: that of the mode that it was in.
        inactive: names of the nodes that it keeps inactive.
        parameters: names of the nodes that have other parameters than in the mode before.
    """

    mode: str
    before: str
    inactive: tuple[str, ...]
    parameters: tuple[str, ...] = ()


class ManifestApplied(Event, frozen=True, kw_only=True, tag="apply"):
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

    stage: str
    manifest: str
    revision: int
    differences: tuple[str, ...] = ()
    added: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    restarted: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    reason: str = ""


class Notice(Event, frozen=True, kw_only=True, tag="notice"):
    """Something a person should know that changes nothing: orphans swept, a step forced."""

    message: str


class Stopping(Event, frozen=True, kw_only=True, tag="stopping"):
    """The system is being taken down."""

    reason: str


class Stopped(Event, frozen=True, kw_only=True, tag="stopped"):
    """Nothing of the system runs any more.

    Attributes:
        reason: why the run ended, as in its report; empty if it did not come so far.
    """

    exit_code: int
    elapsed_s: float
    reason: str = ""


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


def to_record(event: Event) -> dict[str, Any]:
    """Return `event` as the JSON object that `--format json` prints."""
    plain: dict[str, Any] = msgspec.to_builtins(event)
    return plain


_KINDS = {str(each.__struct_config__.tag): each for each in Event.__subclasses__()}


def from_record(record: Mapping[str, Any]) -> Event | None:
    """Return the event that `to_record` wrote; None for a kind that this version does not know.

    Raises:
        ValueError: it is not what its kind has.
    """
    kind = _KINDS.get(str(record.get("event")))
    return None if kind is None else msgspec.convert(record, kind)
