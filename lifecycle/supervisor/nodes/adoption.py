"""Nodes that ran before their supervisor: which are adopted, and what keeps it from adopting them.

Owns: `Adoption`, which decides on all of them before anything is started, or refuses; and
`ran_before`, which keeps requests from a node that ran before when none is adopted. What becomes of
an adopted process is processes/adopted_process.py's. Must not import rclpy.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from typing import Protocol

from lifecycle.run_directory import start_ticks
from lifecycle.supervisor.nodes.system import NodeRun, System
from lifecycle.supervisor.processes.adopted_process import AdoptedProcess, RunningNode
from lifecycle.supervisor.run.events import Notice
from lifecycle.supervisor.run.failure import StepFailedError
from lifecycle.verify import DUPLICATE_NODE, START_FAILED, Finding, Outcome

SETTLE_S = 5.0
"""For discovery to show all that runs; usually it has settled within a second."""


class Census(Protocol):
    """What shows the nodes that run, see nodes/observer_participant.py."""

    async def running(self, wait_s: float) -> tuple[tuple[RunningNode, ...], str]:
        """Return the nodes in the graph once discovery has settled, and what it lacked in the end.

        Args:
            wait_s: seconds, > 0, that it may take.
        """

    def processes(self) -> dict[str, dict[int, str]]:
        """Return the command lines of this host's processes by full node name and pid."""


def ran_before(node: NodeRun, census: Census, ours: Collection[int]) -> tuple[Finding, ...]:
    """Return a finding if a node of this name runs in a process that is older than ours.

    Requests to services would reach both, and both would obey.

    Args:
        node: that has a process of ours.
        census: knows whose process each node is in.
        ours: pids of all that this supervisor started; one may run it that is older: a container.
    """
    assert node.process is not None
    began = start_ticks(node.process.pid)
    if began is None:
        return ()
    older = RunningNode(
        name=node.name,
        processes={
            pid: command
            for pid, command in census.processes().get(node.name, {}).items()
            if pid not in ours and (start_ticks(pid) or began) < began
        },
    )
    if not older.processes:
        return ()
    return (
        DUPLICATE_NODE.on_node(
            Outcome.VIOLATED,
            node.planned,
            expected="1 node of this name",
            observed=f"one more in {older.where}",
            message=f"cannot drive {node.name}: a node of this name ran before ({older.where}), and"
            " would obey, too",
            hint="have it adopted: lifecycle up MANIFEST --adopt; or end it",
        ),
    )


class Adoption:
    """Decides which nodes of a system are adopted; nothing was started yet, and nothing asked.

    Args:
        system: nothing of which runs yet by its own supervisor.
        running: all nodes in the graph.
    """

    def __init__(self, system: System, running: Iterable[RunningNode]) -> None:
        self._system = system
        there = {each.name: each for each in running}
        self.found = {
            key: there[node.name] for key, node in system.nodes.items() if node.name in there
        }

    def findings(self) -> tuple[Finding, ...]:
        """Return a finding for each node that cannot be driven because it runs more than once."""
        found = []
        for key, each in self.found.items():
            count = max(each.count, len(each.processes))
            if count < 2:
                continue
            pids = ", ".join(str(pid) for pid in sorted(each.processes))
            found.append(
                DUPLICATE_NODE.on_node(
                    Outcome.VIOLATED,
                    self._system.nodes[key].planned,
                    expected="1 node of this name",
                    observed=f"{count} nodes",
                    message=f"cannot adopt {each.name}: {count} nodes are named so"
                    + (f", in the processes {pids}" if len(each.processes) > 1 else ""),
                    hint="end all but one of them: nothing was started, and nothing asked of them",
                )
            )
        return tuple(found)

    def adopt(self, on_end: Callable[[AdoptedProcess], None]) -> frozenset[str]:
        """Have the system adopt what was found; return the full names of the nodes.

        Raises:
            StepFailedError: a process would be started for some of its nodes while others of them
                run already.
        """
        self._check_processes()
        system = self._system
        system.adopt(self.found)
        nodes: dict[int, list[NodeRun]] = {}
        for key, each in self.found.items():
            if each.pid:
                nodes.setdefault(each.pid, []).append(system.nodes[key])
        for pid, hosted in nodes.items():
            process = AdoptedProcess(pid, [each.planned for each in hosted], on_end)
            system.adopted = (*system.adopted, process)
            for node in hosted:
                node.adopted = process
        return frozenset(each.name for each in self.found.values())

    def _check_processes(self) -> None:
        for process in self._system.processes.values():
            keys = process.planned.nodes
            there = [key for key in keys if key in self.found]
            missing = [self._system.nodes[key].name for key in keys if key not in self.found]
            if there and missing:
                one = self.found[there[0]]
                where = f" in pid {one.pid}" if one.pid else ""
                raise StepFailedError(
                    f"cannot start {missing[0]!r}: the manifest has it in one process with "
                    f"{one.name!r}, which runs already{where}; end that one, and both are started, "
                    "or start them together, and both are adopted",
                    rule=START_FAILED,
                    subject=missing[0],
                )
            pids = {self.found[key].pid for key in there} - {0}
            if len(pids) > 1:
                names = " and ".join(self.found[key].name for key in there)
                message = f"{names} run in processes of their own; the manifest has them in one"
                self._system.emit(Notice(message=message))
