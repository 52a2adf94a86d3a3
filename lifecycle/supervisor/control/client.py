"""Client of a running supervisor: reads its status, gives orders, ends it.

Owns: `status`, `look`, `differences`, `order`, `down`. Must not import rclpy.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING

from lifecycle.errors import ExitCode
from lifecycle.run_directory import (
    RunDirectory,
    boot_id,
    is_held,
    lost,
    new_run_id,
    read_record,
    start_ticks,
)
from lifecycle.supervisor.control.protocol import (
    A,
    Answer,
    ControlRequest,
    Question,
    SystemStatus,
    ask,
    strange,
)

if TYPE_CHECKING:
    from lifecycle.plan.model import Plan
    from lifecycle.supervisor.control.server import SupervisorSnapshot

STATUS_S = 5.0
_SOCKET = "control"


def status(path: Path) -> SystemStatus:
    """Ask a supervisor for its status.

    Raises:
        UsageError: it runs no more.
        TimeoutError: it does not answer.
    """
    answer = _answered(path, Question(ask=ControlRequest.STATUS), STATUS_S, Answer)
    if answer.status is None:
        raise strange(path / _SOCKET, "it has no status")
    return answer.status


def look(path: Path) -> SupervisorSnapshot:
    """Ask a supervisor for its plan, what it sees and its verdict.

    Raises:
        UsageError: it runs no more.
        TimeoutError: it does not answer.
    """
    from lifecycle.supervisor.control.server import LookAnswer  # its types are a whole plan's

    answer = _answered(path, Question(ask=ControlRequest.LOOK), STATUS_S, LookAnswer)
    if answer.look is None:
        raise strange(path / _SOCKET, "it shows nothing")
    return answer.look


def differences(path: Path, plan: Plan) -> tuple[str, ...]:
    """Ask a supervisor how `plan` differs from what it runs, one line each.

    Returns:
        Nothing where they do not differ, or no answer comes in time: a notice is not worth a wait.
    """
    question = Question(ask=ControlRequest.STATUS, plan=plan)
    try:
        answer = _asked(path, question, STATUS_S, Answer)
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
        UsageError: it runs no more.
        TimeoutError: it is not done after `timeout_s`; it goes on all the same.
    """
    answer = _answered(path, question, timeout_s, Answer)
    if answer.exit_code not in _ANSWERED:
        code = answer.exit_code
        why = "it has no exit code" if code is None else f"its exit code is {code}"
        raise strange(path / _SOCKET, why)
    return answer


def _answered(path: Path, question: Question, timeout_s: float, type_: type[A]) -> A:
    if (answer := _asked(path, question, timeout_s, type_)) is None:
        raise lost(path)
    return answer


def _asked(path: Path, question: Question, timeout_s: float, type_: type[A]) -> A | None:
    """Return the answer of a supervisor; None if it is not there any more."""
    try:
        return ask(path / _SOCKET, question, timeout_s, type_)
    except (FileNotFoundError, ConnectionError):
        return None


def down(path: Path, timeout_s: float) -> ExitCode:
    """End a system, and clean up where its supervisor cannot any more.

    Returns:
        OK once nothing of it runs.

    Raises:
        TimeoutError: it still runs after `timeout_s`.
        UsageError: what answers is no supervisor of this version.
        ProgrammingError: nothing runs, but something of it could not be removed from a network.
    """
    deadline = time.monotonic() + timeout_s
    patience = time.monotonic() + _STARTS_S
    question, left_s = Question(ask=ControlRequest.DOWN), timeout_s
    answer: Answer | None = None
    while True:
        answer = answer or _asked(path, question, left_s, Answer)
        if answer is not None and answer.exit_code is None:
            raise strange(path / _SOCKET, "it has no exit code")
        if not is_held(path):
            break
        # It is just starting, and will listen; or ending, and does so no more; or has answered.
        if time.monotonic() > deadline:
            raise TimeoutError
        if answer is None and time.monotonic() > patience:
            _terminate(path)
            patience = deadline
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


def _terminate(path: Path) -> None:
    """Have a supervisor end that does not listen (yet), as by SIGTERM: it may wait for long."""
    record = read_record(path)
    if record is None or record.boot_id != boot_id():
        return
    of = record.supervisor
    with contextlib.suppress(ProcessLookupError, PermissionError):
        pidfd = os.pidfd_open(of.pid)
        try:
            if start_ticks(of.pid) == of.start_ticks:
                signal.pidfd_send_signal(pidfd, signal.SIGTERM)
        finally:
            os.close(pidfd)


_AGAIN_S = 0.02
"""Neither a lock nor a socket that is yet to be made can be waited for with a deadline."""

_STARTS_S = 2.0
"""A supervisor listens sooner, unless it waits for a network interface or a discovery server."""
