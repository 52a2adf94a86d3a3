"""Nodes that ran before their supervisor: `lifecycle up --adopt` takes them as attached.

Owns: `adopt`, which decides before anything is started; and `ran_before`, which keeps requests from
a node that ran before when none is adopted. Must not import rclpy.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

from lifecycle.plan.build import attached_to
from lifecycle.plan.model import Plan
from lifecycle.printable import one_line
from lifecycle.run_directory import start_ticks
from lifecycle.supervisor.nodes.system import NodeRun, System
from lifecycle.supervisor.run.events import Failure, Notice
from lifecycle.supervisor.run.failure import StepFailedError
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import START_FAILED
from lifecycle.verify.rules.nodes import DUPLICATE_NODE
from lifecycle.verify.verdict import Finding

if TYPE_CHECKING:
    from lifecycle.supervisor.nodes.observer_participant import ObserverParticipant

SETTLE_S = 5.0
"""For discovery to show all that runs; usually it has settled within a second."""

_LONGEST_COMMAND = 100


def ran_before(
    node: NodeRun, processes: Mapping[int, str], ours: Collection[int]
) -> tuple[Finding, ...]:
    """Return a finding if a node of this name runs in a process that is older than ours.

    Requests to services would reach both, and both would obey.

    Args:
        node: that has a process of ours.
        processes: command lines by pid of those that nodes of this name run in.
        ours: pids of all that this supervisor started; one may run it that is older: a container.
    """
    assert node.process is not None
    began = start_ticks(node.process.pid)
    if began is None:
        return ()
    older = {
        pid: command
        for pid, command in processes.items()
        if pid not in ours and (start_ticks(pid) or began) < began
    }
    if not older:
        return ()
    return (
        DUPLICATE_NODE.on(
            node.planned,
            outcome=Outcome.VIOLATED,
            expected="1 node of this name",
            observed=f"one more in {_where(older)}",
            message=f"cannot drive {node.name}: a node of this name ran before ({_where(older)}), "
            "and would obey, too",
            hint="have it adopted: lifecycle up MANIFEST --adopt; or end it",
        ),
    )


async def adopt(
    system: System, participant: ObserverParticipant
) -> tuple[Plan, tuple[Finding, ...]]:
    """Take the nodes of a system that run already as if its manifest attached to them.

    Args:
        system: nothing of which was started yet by this supervisor.
        participant: shows what runs.

    Returns:
        The plan that attaches to them, and a finding for each node that runs more than once;
        nothing is adopted then.

    Raises:
        StepFailedError: of a process with several nodes only some run.
    """
    nodes, unsettled = await participant.running(SETTLE_S)
    if unsettled:
        system.emit(Notice(message=f"what runs may not be all that is adopted: {unsettled}"))
    count = {each.full_name: each.count for each in nodes}
    found = {key: node for key, node in system.nodes.items() if node.name in count}
    if twice := [each for each in found.values() if count[each.name] > 1]:
        return system.plan, tuple(_runs_twice(each, count[each.name]) for each in twice)
    for process in system.run.processes.values():
        missing = [key for key in process.planned.nodes if key not in found]
        if 0 < len(missing) < len(process.planned.nodes):
            name = system.nodes[missing[0]].name
            text = (
                f"cannot start {name!r}: process {process.name!r} is to run it with others, which "
                "run already; end those and all are started, or start it with them"
            )
            raise StepFailedError(Failure(rule=START_FAILED.id, subject=name, message=text))
    if not found:
        system.emit(Notice(message="nothing is adopted: no node of the manifest runs yet"))
    processes = participant.processes()
    system.adopted = {each.name: _where(processes.get(each.name, {})) for each in found.values()}
    return attached_to(system.plan, found), ()


def _runs_twice(node: NodeRun, count: int) -> Finding:
    return DUPLICATE_NODE.on(
        node.planned,
        outcome=Outcome.VIOLATED,
        expected="1 node of this name",
        observed=f"{count} nodes",
        message=f"cannot adopt {node.name}: {count} nodes are named so",
        hint="end all but one of them: nothing was started, and nothing asked of them",
    )


def _where(processes: Mapping[int, str]) -> str:
    """Return a process as people read it; empty where none is known."""
    for pid, command in processes.items():
        text = one_line(command)
        cut = "" if len(text) <= _LONGEST_COMMAND else "…"
        return f"pid {pid}, {text[:_LONGEST_COMMAND]}{cut}"
    return ""
