"""Status of a running system at one moment, for tables and for `lifecycle status`.

Owns: how a status is drawn from the running system and its last verdict. Must not import rclpy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lifecycle.manifest.model import EndpointKind, RunKind, UniqueHow
from lifecycle.supervisor.control.protocol import NodeStatus, SystemStatus
from lifecycle.verify.judge import not_ok
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.state import WRONG_STATE
from lifecycle.verify.verdict import FlowReport, Verdict

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lifecycle.supervisor.nodes.system import NodeRun, System
    from lifecycle.supervisor.policy.schedule import RestartSchedule
    from lifecycle.verify.observation import NodeConfiguration


def node_status(
    node: NodeRun,
    verdict: Verdict | None,
    silent: str,
    *,
    elapsed_s: float,
    schedule: RestartSchedule,
) -> NodeStatus:
    """Return what is known of one node.

    Args:
        node: which.
        verdict: the last one; None before the first.
        silent: why nothing can be expected of it.
        elapsed_s: seconds since the supervisor started.
        schedule: knows of restarts.
    """
    process = node.process
    runs = process is not None and process.pid != 0 and not process.is_gone
    known = None if process is None else schedule
    died = _died(node)
    configuration = None if died else node.configuration
    flows = [
        flow
        for flow in (() if verdict is None else verdict.flows)
        if node.name in (flow.publisher, flow.subscription)
    ]
    matches = _matches(node, configuration, flows)
    cpu_s, rss_bytes, threads = _use(process.pid) if runs and process is not None else (None,) * 3
    external = node.planned.run.kind is RunKind.ATTACH
    return NodeStatus(
        node=node.name,
        process="" if external else node.planned.process,
        process_state=None if node.process is None else node.process.state,
        pid=node.pid,
        managed=node.planned.managed,
        reach=node.reach,
        state="" if died else _state(node, verdict),
        doing=node.doing or node.withheld,
        matched=matches.count(True),
        unreported=matches.count(None),
        endpoints=len(matches),
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
        uptime_s=elapsed_s - process.started_s if runs and process is not None else None,
        restarts=0 if known is None else known.restarts(node.planned.process),
        last_failure=None if known is None else known.last_failure(node.planned.process),
        next_try_s=None if known is None else known.next_try_s(node.planned.process),
        cpu_s=cpu_s,
        rss_bytes=rss_bytes,
        threads=threads,
    )


def _use(pid: int) -> tuple[float | None, int | None, int | None]:
    """Return what a process uses: CPU time, seconds, resident bytes and threads; or nothing."""
    import psutil  # 15 ms, which no bring-up has to wait for

    try:
        process = psutil.Process(pid)
        with process.oneshot():
            times = process.cpu_times()
            return times.user + times.system, process.memory_info().rss, process.num_threads()
    except psutil.Error:
        return None, None, None


def _state(node: NodeRun, verdict: Verdict | None) -> str:
    """Return a node's state; of one that others can drive unseen, what the last judgement saw."""
    judged = (
        each.observed
        for each in (() if verdict is None or node.reports_changes else verdict.findings)
        if each.rule == WRONG_STATE.id and each.node == node.name
    )
    return next(judged, node.state)


def _matches(
    node: NodeRun, configuration: NodeConfiguration | None, flows: Sequence[FlowReport]
) -> list[bool | None]:
    """Return of each declared publisher and subscription whether it matches; None if unknown.

    Nodes that report nothing of themselves match where a flow of theirs is ok.
    """
    reported = {
        (each.kind, each.resolved): bool(each.matched)
        for each in (() if configuration is None else configuration.endpoints)
        if each.matched is not None
    }
    ok = {
        (kind, flow.topic)
        for flow in flows
        for kind, name in (
            (EndpointKind.PUBLISHER, flow.publisher),
            (EndpointKind.SUBSCRIPTION, flow.subscription),
        )
        if name == node.name and flow.outcome is Outcome.OK
    }
    places = [(each.kind, each.resolved) for each in node.planned.endpoints if each.kind.is_topic]
    return [reported.get(each, True if each in ok else None) for each in places]


def _died(node: NodeRun) -> str:
    """Say how a node's process ended without being asked to; empty if it has not."""
    process = node.process
    if process is None or not process.died or not process.ended.done():
        return ""
    return f"pid {process.pid} died: {process.ended.result()}"


def system_status(
    system: System,
    verdict: Verdict | None,
    *,
    phase: str,
    supervisor: int,
    elapsed_s: float,
    schedule: RestartSchedule,
    ends: str,
) -> SystemStatus:
    """Return what is known of the whole system, with what its processes use now."""
    silent = system.liveliness.silent
    return SystemStatus(
        system=system.plan.system,
        domain_id=system.plan.domain_id,
        phase=phase,
        verdict=None if verdict is None else verdict.verdict,
        supervisor=supervisor,
        elapsed_s=elapsed_s,
        nodes=tuple(
            node_status(
                node,
                verdict,
                silent.get(node.name, ""),
                elapsed_s=elapsed_s,
                schedule=schedule,
            )
            for node in system.nodes.values()
        ),
        not_ok="" if verdict is None else not_ok(verdict),
        mode=system.mode,
        manifest=system.first.manifest_path,
        revision=system.revision,
        ends=ends,
    )
