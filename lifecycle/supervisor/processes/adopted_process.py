"""Processes that others started and whose nodes are adopted: what is known, and when they end.

Owns: `RunningNode`, a node of the graph with the processes that it may be in; and `AdoptedProcess`,
of which a pidfd notifies the end (pidfd_open(2)). It is never signalled: who started it ends it.
Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Iterable

from lifecycle import dataclasses
from lifecycle.plan import PlannedNode
from lifecycle.printable import one_line
from lifecycle.supervisor.run.failure import StepFailedError
from lifecycle.verify import PROCESS_DIED

_LONGEST_COMMAND = 100


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class RunningNode:
    """A node that is in the graph.

    Attributes:
        name: fully qualified.
        count: how many nodes carry this name.
        processes: of this host that it runs in, with their command lines, by pid; empty where that
            is not known. More than one is several nodes.
    """

    name: str
    count: int = 1
    processes: dict[int, str] = dataclasses.field(default_factory=dict)

    @property
    def pid(self) -> int:
        """Its process; 0 if it is not known."""
        return next(iter(self.processes), 0)

    @property
    def where(self) -> str:
        """Its process as people read it; empty if it is not known."""
        if not self.processes:
            return ""
        command = one_line(self.processes[self.pid])
        cut = "" if len(command) <= _LONGEST_COMMAND else "…"
        return f"pid {self.pid}, {command[:_LONGEST_COMMAND]}{cut}"


class AdoptedProcess:
    """A process that others started; `close` it.

    Args:
        pid: of a process on this host.
        nodes: of ours that it runs.
        on_end: called once, when it has ended.

    Attributes:
        ended: resolves when it has ended, with all that is known of how.
        is_over: it has ended, and all of its nodes may end by themselves.
    """

    def __init__(
        self, pid: int, nodes: Iterable[PlannedNode], on_end: Callable[[AdoptedProcess], None]
    ) -> None:
        self.pid = pid
        self.nodes = tuple(nodes)
        self.ended: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._on_end = on_end
        self._pidfd: int | None = None
        try:
            self._pidfd = os.pidfd_open(pid)
        except ProcessLookupError:
            asyncio.get_running_loop().call_soon(self._ends)
        else:
            asyncio.get_running_loop().add_reader(self._pidfd, self._ends)

    @property
    def name(self) -> str:
        """What it is called among the processes of a run."""
        return f"pid {self.pid}"

    @property
    def is_over(self) -> bool:
        """See above."""
        return self.ended.done() and all(each.may_end for each in self.nodes)

    @property
    def died(self) -> bool:
        """It has ended although it was to run."""
        return self.ended.done() and not self.is_over

    def failure(self) -> StepFailedError:
        """Return the failure that its end is."""
        names = " and ".join(repr(each.full_name) for each in self.nodes)
        return StepFailedError(
            f"cannot keep {names} running: pid {self.pid}, which was adopted, has ended; how it "
            "ended is known to who started it",
            rule=PROCESS_DIED,
            subject=self.nodes[0].full_name,
        )

    def close(self) -> None:
        """Watch it no more."""
        if self._pidfd is not None:
            asyncio.get_running_loop().remove_reader(self._pidfd)
            os.close(self._pidfd)
            self._pidfd = None

    def _ends(self) -> None:
        self.close()
        if not self.ended.done():
            self.ended.set_result("ended; it was adopted, and who started it knows how")
            self._on_end(self)
