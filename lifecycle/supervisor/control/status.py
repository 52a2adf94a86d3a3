"""Status of a running system at one moment, for tables and for `lifecycle status`.

Owns: the status types and how they are drawn from the running system and its last verdict. Must not
import rclpy.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from lifecycle.manifest import RunKind, UniqueHow
from lifecycle.supervisor.run.events import ProcessState, Reach
from lifecycle.verify import ConnectionReport, Outcome, Verdict

if TYPE_CHECKING:
    from lifecycle.supervisor.nodes.system import NodeRun, System


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class NodeStatus:
    """One node.

    Attributes:
        node: fully qualified name.
        process: name of its process; empty if this supervisor does not run it.
        pid: also of an adopted node's process; 0 where it is not known.
        process_state: None if this supervisor does not run it.
        state: lifecycle_msgs/State label; empty for a node that is not managed.
        doing: what it does or waits for; empty when nothing.
        matched: publishers and subscriptions that report at least one match.
        endpoints: declared publishers and subscriptions.
        unique_flows: flows from or to it that are weakly or strongly unique.
        flows: flows from or to it.
        findings: findings of the last verdict that concern it.
        silent: why nothing can be expected of it; empty while it is alive.
        died: how its process ended unasked; empty while it runs. It then has no state, and no
            matches.
        connections: as it reports them, its own participant left out.
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
    silent: str = ""
    died: str = ""
    connections: tuple[ConnectionReport, ...] = ()


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class SystemStatus:
    """One system.

    Attributes:
        phase: "connecting", "verifying", "activating", "active", "pausing", "paused", "held" (some
            nodes wait at a gate that stayed closed), "restarting" or "stopping".
        verdict: of the last judgement; None before the first.
        not_ok: what keeps it from being ok, in one line; empty where nothing does.
        supervisor: pid.
    """

    system: str
    domain_id: int
    phase: str
    verdict: Outcome | None
    supervisor: int
    elapsed_s: float
    nodes: tuple[NodeStatus, ...]
    not_ok: str = ""


def node_status(node: NodeRun, verdict: Verdict | None, silent: str = "") -> NodeStatus:
    """Return what is known of one node."""
    died = _died(node)
    configuration = None if died else node.configuration
    reports = () if configuration is None else configuration.endpoints
    flows = [
        flow
        for flow in (() if verdict is None else verdict.flows)
        if node.name in (flow.publisher, flow.subscription)
    ]
    external = node.planned.run.kind is RunKind.ATTACH
    return NodeStatus(
        node=node.name,
        process="" if external else node.planned.process,
        process_state=None if node.process is None else node.process.state,
        pid=node.pid,
        managed=node.planned.managed,
        reach=node.reach,
        state="" if died else node.state,
        doing=node.doing,
        matched=sum(each.kind.is_topic and bool(each.matched) for each in reports),
        endpoints=sum(each.kind.is_topic for each in node.planned.endpoints),
        unique_flows=sum(flow.unique in (UniqueHow.WEAKLY, UniqueHow.STRONGLY) for flow in flows),
        flows=len(flows),
        findings=sum(
            node.name in (finding.node, finding.subject)
            for finding in (() if verdict is None else verdict.findings)
        ),
        silent=silent,
        died=died,
        connections=tuple(
            each
            for each in (() if configuration is None else configuration.connections)
            if each.name
        ),
    )


def _died(node: NodeRun) -> str:
    """Say how a node's process ended without being asked to; empty if it has not."""
    process = node.process
    if process is None or not process.died or not process.ended.done():
        return ""
    return f"pid {process.pid} died: {process.ended.result()}"


def system_status(
    system: System, verdict: Verdict | None, *, phase: str, supervisor: int, elapsed_s: float
) -> SystemStatus:
    """Return what is known of the whole system."""
    from lifecycle.verify import not_ok  # imports every rule, and clients need none

    silent = system.liveliness.silent
    return SystemStatus(
        system=system.plan.system,
        domain_id=system.plan.domain_id,
        phase=phase,
        verdict=None if verdict is None else verdict.verdict,
        supervisor=supervisor,
        elapsed_s=elapsed_s,
        nodes=tuple(
            node_status(node, verdict, silent.get(node.name, "")) for node in system.nodes.values()
        ),
        not_ok="" if verdict is None else not_ok(verdict),
    )
