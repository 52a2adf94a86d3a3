"""Process states and their legal changes.

Owns: `ProcessState`, `ProcessExit` and the table of changes. The words are not node states: only
nodes are "active". Pure.
"""

from __future__ import annotations

import dataclasses
import enum
import os
import signal


class ProcessState(enum.Enum):
    """The life of one operating system process; BACKOFF is the wait before it is started again."""

    STARTING = "starting"
    RUNNING = "running"
    BACKOFF = "backoff"
    STOPPING = "stopping"
    EXITED = "exited"


CHANGES: dict[ProcessState, frozenset[ProcessState]] = {
    ProcessState.STARTING: frozenset(
        {ProcessState.RUNNING, ProcessState.STOPPING, ProcessState.EXITED}
    ),
    ProcessState.RUNNING: frozenset({ProcessState.STOPPING, ProcessState.EXITED}),
    ProcessState.STOPPING: frozenset({ProcessState.EXITED}),
    ProcessState.EXITED: frozenset({ProcessState.BACKOFF, ProcessState.STARTING}),
    ProcessState.BACKOFF: frozenset({ProcessState.STARTING, ProcessState.EXITED}),
}
"""Every legal change; a pair that is missing is a bug of the caller."""


def change(old: ProcessState, new: ProcessState) -> ProcessState:
    """Return `new` if a process may go there from `old`.

    Raises:
        ValueError: it may not; a bug of the caller.
    """
    if new not in CHANGES[old]:
        allowed = ", ".join(sorted(state.value for state in CHANGES[old]))
        raise ValueError(
            f"cannot change a process from {old.value!r} to {new.value!r}; allowed: {allowed}"
        )
    return new


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ProcessExit:
    """How a process ended.

    Attributes:
        status: exit status, 0–255; None if a signal ended it or it is not known.
        signal: number of the signal that ended it; None otherwise.
    """

    status: int | None = None
    signal: int | None = None

    @classmethod
    def from_wait(cls, raw: int) -> ProcessExit:
        """Decode the status word of waitpid(2)."""
        code = os.waitstatus_to_exitcode(raw)
        return cls(status=code) if code >= 0 else cls(signal=-code)

    def __str__(self) -> str:
        if self.signal is not None:
            try:
                return f"killed by {signal.Signals(self.signal).name}"
            except ValueError:
                return f"killed by signal {self.signal}"
        if self.status is not None:
            return f"exit status {self.status}"
        return "ended, exit status unknown"
