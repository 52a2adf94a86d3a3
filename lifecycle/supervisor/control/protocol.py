"""What is asked on a supervisor's control socket and what it answers: the client's side.

Owns: the requests and replies, one JSON object per line; the words of a status; and asking:
`status`, `look`, `differences`, `order`, `down`. All that a verb loads which asks a running
supervisor, so nothing here imports plans, rules or asyncio.
"""

from __future__ import annotations

import enum
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
from msgspec.structs import replace

from lifecycle.codec import from_json, to_json
from lifecycle.errors import BringUpError, ExitCode, UsageError
from lifecycle.measure.flows import FlowMeasurement
from lifecycle.run_directory import (
    RunDirectory,
    connect,
    is_held,
    lost,
    new_run_id,
    silent,
)
from lifecycle.verify.outcome import ConnectionReport, Outcome

if TYPE_CHECKING:
    from lifecycle.plan.model import Plan
    from lifecycle.supervisor.control.server import SupervisorSnapshot


_LARGEST_ANSWER = 64 * 2**20
"""Bytes of a line; a look holds a whole plan and all that was seen."""
_READ = 2**18


class ProcessState(enum.Enum):
    """The life of one operating system process; BACKOFF is the wait before it is started again."""

    STARTING = "starting"
    RUNNING = "running"
    BACKOFF = "backoff"
    STOPPING = "stopping"
    EXITED = "exited"


class Reach(enum.Enum):
    """How far one node is brought up; ordered, one value per step of bring-up."""

    WAITING = "waiting"
    STARTED = "started"
    CONFIGURED = "configured"
    CONNECTED = "connected"
    ACTIVE = "active"
    STOPPED = "stopped"


class Failed(msgspec.Struct, frozen=True, kw_only=True):
    """One failure of a process.

    Attributes:
        rule: id of the finding that it is, `run.process-died`.
        subject: node or process, as in that finding.
        message: a whole sentence.
        exit_status: of the process; None if it did not end by itself, or a signal ended it.
        signal: name of the signal that ended it, `SIGKILL`; empty if none did.
        stderr: the last line that it wrote to standard error; empty if none.
        elapsed_s: when, in seconds since the supervisor started.
        at: when, UTC by ISO 8601, for people and logs.
    """

    rule: str
    subject: str
    message: str
    exit_status: int | None = None
    signal: str = ""
    stderr: str = ""
    elapsed_s: float = 0.0
    at: str = ""


class NodeStatus(msgspec.Struct, frozen=True, kw_only=True):
    """One node.

    Attributes:
        node: fully qualified name.
        process: name of its process; empty if this supervisor does not run it.
        process_state: None if this supervisor does not run it.
        pid: of its process; 0 if this supervisor does not run it.
        state: lifecycle_msgs/State label; empty for a node that is not managed.
        doing: what it does or waits for; empty when nothing.
        matched: publishers and subscriptions with at least one match.
        unreported: those of which no end reports whether they match.
        endpoints: declared publishers and subscriptions.
        unique_flows: flows from or to it that are weakly or strongly unique.
        flows: flows from or to it.
        findings: findings of the last verdict that concern it.
        silent: why nothing can be expected of it; empty while it is alive.
        died: how its process ended unasked, or that its own code destroyed it while that runs;
            empty otherwise. It then has no state, and no matches.
        connections: as it reports them, its own participant left out.
        uptime_s: since its process was started; None while there is none of ours.
        restarts: how often its process was started again by policy.
        last_failure: of its process, that it was, or is to be, started again after; None if there
            was none.
        next_try_s: seconds until its process is started again; None if that is not planned.
    """

    node: str
    process: str
    process_state: ProcessState | None
    pid: int
    managed: bool
    reach: Reach
    state: str
    doing: str
    matched: int
    endpoints: int
    unique_flows: int
    flows: int
    findings: int
    unreported: int = 0
    silent: str = ""
    died: str = ""
    connections: tuple[ConnectionReport, ...] = ()
    uptime_s: float | None = None
    restarts: int = 0
    last_failure: Failed | None = None
    next_try_s: float | None = None


class SystemStatus(msgspec.Struct, frozen=True, kw_only=True):
    """One system.

    Attributes:
        phase: "connecting", "verifying", "activating", "measuring" (active, and what is declared of
            its data is not decided yet), "active", "pausing", "paused", "held" (some
            nodes wait at a gate that stayed or was closed), "restarting",
            "switching" (to another mode), "applying" (another manifest), "rolling back" (to the
            manifest before) or "stopping".
        verdict: of the last judgement; None before the first.
        not_ok: what keeps it from being ok, in one line; empty where nothing does.
        supervisor: pid.
        mode: name of the one that it is in; empty for a system without modes.
        manifest: path of the manifest in force, as it was given; empty where it is not known.
        revision: number of it in this run; 1 for the one that it began with.
        ends: why it is being taken down; empty while it is not.
        measured: what has arrived of each flow, where the manifest declares numbers of any.
    """

    system: str
    domain_id: int
    phase: str
    verdict: Outcome | None
    supervisor: int
    elapsed_s: float
    nodes: tuple[NodeStatus, ...]
    not_ok: str = ""
    mode: str = ""
    manifest: str = ""
    revision: int = 1
    ends: str = ""
    measured: tuple[FlowMeasurement, ...] = ()


def timeless(status: SystemStatus) -> SystemStatus:
    """Return a status without what changes with every second."""
    nodes = (replace(each, uptime_s=None, next_try_s=None) for each in status.nodes)
    return replace(status, elapsed_s=0.0, nodes=tuple(nodes))


class ControlRequest(enum.Enum):
    """What a supervisor can be asked."""

    STATUS = "status"
    DOWN = "down"
    LOOK = "look"
    PAUSE = "pause"
    RESUME = "resume"
    RESTART = "restart"
    MODE = "mode"
    APPLY = "apply"


class Question(msgspec.Struct, frozen=True, kw_only=True):
    """Client → supervisor.

    Attributes:
        node: for RESTART, manifest key or fully qualified name; empty for the whole system.
        plan: for STATUS and orders, the Plan of the client's manifest as it is now; None if
            it was given none. What reads it knows its type, see server.py.
        mode: for MODE, the name of the one to enter.
        dry_run: for APPLY, only say what would become of the system.
        timeout_s: for APPLY, seconds until the system must be active by `plan`; else it goes back.
            0 is as long as a bring-up may take.
    """

    ask: ControlRequest
    node: str = ""
    plan: object = None
    mode: str = ""
    dry_run: bool = False
    timeout_s: float = 0.0


class ChangedNodes(msgspec.Struct, frozen=True, kw_only=True):
    """What another manifest is for the nodes of a system; all others stay as they are.

    Attributes:
        differences: between the manifests, one line each.
        added: full names of nodes, likewise of the others.
        removed: are taken down, and their processes end.
        restarted: their processes are started again.
        parameters: are given parameters while they run, and are restarted if they refuse them.
        revision: of the manifest that is in force in the end.
    """

    differences: tuple[str, ...] = ()
    added: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    restarted: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    revision: int = 1


class Answer(msgspec.Struct, frozen=True, kw_only=True):
    """Supervisor → client.

    Attributes:
        status: for STATUS.
        exit_code: for DOWN, of the supervisor, sent once nothing of the system runs any more; for
            an order, what came of it.
        error: why an order was not carried out; empty if it was.
        differences: for STATUS with a plan, how that differs from what runs, one line each.
        change: for APPLY, what it is about.
        look: for LOOK, a SupervisorSnapshot: what reads it knows its type, see server.py.
    """

    status: SystemStatus | None = None
    exit_code: int | None = None
    error: str = ""
    differences: tuple[str, ...] = ()
    change: ChangedNodes | None = None
    look: msgspec.Raw = msgspec.Raw(b"null")


def ask(path: Path, question: Question, timeout_s: float) -> Answer | None:
    """Ask the supervisor that listens at `path`.

    Returns:
        Its answer; None if it ended without one.

    Raises:
        TimeoutError: no whole answer within `timeout_s`.
        UsageError: what answers is no supervisor of this version.
        OSError: no supervisor listens there.
    """
    deadline = time.monotonic() + timeout_s
    with connect(path, timeout_s) as sock:
        sock.sendall(to_json(question) + b"\n")
        line = bytearray()
        while not line.endswith(b"\n"):  # nothing follows an answer
            if len(line) > _LARGEST_ANSWER:
                raise strange(path, f"{len(line)} bytes without an end")
            if (left_s := deadline - time.monotonic()) <= 0:
                raise TimeoutError
            sock.settimeout(left_s)
            if not (data := sock.recv(_READ)):
                return None
            line += data
    try:
        return from_json(bytes(line), Answer)
    except ValueError as error:
        raise strange(path, str(error)) from error


def strange(path: Path, why: str) -> UsageError:
    """Return the error that an answer is which no supervisor of this version gives."""
    return UsageError(
        f"cannot understand the answer of {path.parent.name!r}: {why}",
        hint="use the version of lifecycle that started it, or end the process that listens at "
        f"{path}",
    )


STATUS_S = 5.0
_SOCKET = "control"


def status(path: Path) -> SystemStatus:
    """Ask a supervisor for its status.

    Raises:
        UsageError: it runs no more.
        TimeoutError: it does not answer.
    """
    answer = _answered(path, Question(ask=ControlRequest.STATUS), STATUS_S)
    if answer.status is None:
        raise strange(path / _SOCKET, "it has no status")
    return answer.status


def look(path: Path) -> SupervisorSnapshot:
    """Ask a supervisor for its plan, what it sees and its verdict.

    Raises:
        UsageError: it runs no more.
        TimeoutError: it does not answer.
    """
    from lifecycle.supervisor.control.server import shown  # its types are a whole plan's

    return shown(path / _SOCKET, _answered(path, Question(ask=ControlRequest.LOOK), STATUS_S))


def follow(path: Path) -> Iterator[SupervisorSnapshot]:
    """Yield what a supervisor knows, twice a second where that is new, until it has ended.

    Raises:
        UsageError: it runs no more.
        TimeoutError: it does not answer.
    """
    from lifecycle.supervisor.control.server import shown

    question, last = Question(ask=ControlRequest.LOOK), None
    answer: Answer | None = _answered(path, question, STATUS_S)
    while answer is not None:
        seen = shown(path / _SOCKET, answer)
        if (news := replace(seen, status=timeless(seen.status))) != last:
            last = news
            yield seen
        time.sleep(_FOLLOWED_S)
        answer = _asked(path, question, STATUS_S)


def differences(path: Path, plan: Plan) -> tuple[str, ...]:
    """Ask a supervisor how `plan` differs from what it runs, one line each.

    Returns:
        Nothing where they do not differ, or no answer comes in time: a notice is not worth a wait.
    """
    question = Question(ask=ControlRequest.STATUS, plan=plan)
    try:
        answer = _asked(path, question, STATUS_S)
    except TimeoutError:
        return ()
    return () if answer is None else answer.differences


_ANSWERED = frozenset(ExitCode) - {ExitCode.INTERNAL}
"""Exit codes that may be passed on; a supervisor reports an error of its own to no client."""


def order(path: Path, question: Question, timeout_s: float) -> Answer:
    """Have a supervisor pause, resume or restart its system, or one node of it.

    Returns:
        Its exit code and, where it is not OK, why.

    Raises:
        UsageError: it runs no more, or does not answer; it was ordered nothing then.
        BringUpError: it is not done after `timeout_s`; it goes on all the same.
    """
    _check_answers(path)
    try:
        answer = _answered(path, question, timeout_s)
    except TimeoutError as error:
        raise BringUpError(
            f"cannot {question.ask.value} {path.name!r} within {timeout_s:g} s; it is still at it",
            hint=f"see what it does: lifecycle status {path.name}",
        ) from error
    if answer.exit_code not in _ANSWERED:
        code = answer.exit_code
        why = "it has no exit code" if code is None else f"its exit code is {code}"
        raise strange(path / _SOCKET, why)
    return answer


def _answered(path: Path, question: Question, timeout_s: float) -> Answer:
    if (answer := _asked(path, question, timeout_s)) is None:
        raise lost(path)
    return answer


def _asked(path: Path, question: Question, timeout_s: float) -> Answer | None:
    """Return the answer of a supervisor; None if it is not there any more."""
    try:
        return ask(path / _SOCKET, question, timeout_s)
    except (FileNotFoundError, ConnectionError):
        return None


def _check_answers(path: Path) -> None:
    """Raise UsageError if a supervisor listens and does not answer, as after SIGSTOP."""
    try:
        _asked(path, Question(ask=ControlRequest.STATUS), STATUS_S)
    except TimeoutError as error:
        raise silent(path) from error


def down(path: Path, timeout_s: float) -> ExitCode:
    """End a system, and clean up where its supervisor cannot any more.

    Returns:
        OK once nothing of it runs.

    Raises:
        TimeoutError: it still runs after `timeout_s`.
        UsageError: it does not answer, or is no supervisor of this version.
        ProgrammingError: nothing runs, but something of it could not be removed from a network.
    """
    _check_answers(path)
    deadline = time.monotonic() + timeout_s
    question, left_s = Question(ask=ControlRequest.DOWN), timeout_s
    answer: Answer | None = None
    while True:
        answer = answer or _asked(path, question, left_s)
        if answer is not None and answer.exit_code is None:
            raise strange(path / _SOCKET, "it has no exit code")
        if not is_held(path):
            break
        # It is just starting, and will listen; or ending, and does so no more; or has answered.
        if time.monotonic() > deadline:
            raise TimeoutError
        time.sleep(_AGAIN_S)
        left_s = max(_AGAIN_S, deadline - time.monotonic())
    if answer is not None:
        return ExitCode.OK
    from lifecycle.middleware.process.shared_memory import sweep
    from lifecycle.supervisor.connections.networks import remove_programmed
    from lifecycle.supervisor.processes.fork_server import end_run

    directory = RunDirectory.acquire(path.parent, path.name, new_run_id())
    try:
        if directory.previous is not None:
            end_run(directory.previous)
            sweep()
        remove_programmed(path, max(1.0, deadline - time.monotonic()))
    finally:
        directory.release()
    return ExitCode.OK


_FOLLOWED_S = 0.5

_AGAIN_S = 0.02
"""Neither a lock nor a socket that is yet to be made can be waited for with a deadline."""
