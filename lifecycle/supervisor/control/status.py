"""Status of a running system, for tables and `lifecycle status`; its result in the end.

Owns: how a status is drawn from the running system and its last verdict; and how failures join a
verdict, so that every run ends in one verdict that names each cause once. Must not import rclpy.
"""

from __future__ import annotations

import datetime as dt
import os
from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING

from msgspec.structs import replace

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import EndpointKind, RunKind, UniqueHow
from lifecycle.supervisor.control.protocol import NodeStatus, ProcessState, SystemStatus
from lifecycle.supervisor.core.advance import phase_of
from lifecycle.supervisor.core.failure import exit_code_of
from lifecycle.supervisor.run.events import Failure
from lifecycle.supervisor.run.options import UpResult
from lifecycle.verify.judge import not_ok
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import rule
from lifecycle.verify.rules.catalogue import GAVE_UP, PROCESS_DIED, node_of
from lifecycle.verify.rules.state import WRONG_STATE
from lifecycle.verify.verdict import NOT_JUDGED, Finding, FlowReport, RunEnd, Verdict

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lifecycle.supervisor.core.state import Process, Run
    from lifecycle.supervisor.nodes.system import NodeRun, System
    from lifecycle.verify.observation import NodeConfiguration


def process_state(run: Run, process: Process) -> ProcessState:
    """Return the state of a process as people and clients read it."""
    if process.state is not None:
        return process.state
    if process.end is None:
        return ProcessState.STARTING
    return ProcessState.BACKOFF if process.failed and not run.ending else ProcessState.EXITED


def _node_status(system: System, node: NodeRun, elapsed_s: float) -> NodeStatus:
    run, verdict = system.run, system.run.judged.verdict
    process, known = node.process, run.processes.get(node.core.process)
    runs = known is not None and known.is_alive and process is not None and process.pid != 0
    pid = 0 if process is None else process.pid
    died = _died(run, known, pid)
    if runs and node.is_destroyed:
        died = f"destroyed by its own code; pid {pid} runs on"
    configuration = None if died else node.configuration
    flows = [
        flow
        for flow in (() if verdict is None else verdict.flows)
        if node.name in (flow.publisher, flow.subscription)
    ]
    matches = _matches(node, configuration, flows)
    external = node.planned.run.kind is RunKind.ATTACH
    last = None if known is None else known.failure
    if last is not None:
        ago = dt.timedelta(seconds=elapsed_s - last.elapsed_s)
        at = dt.datetime.now(dt.timezone.utc) - ago
        last = replace(last, at=at.isoformat(timespec="milliseconds"))
    due_s = node.core.due_s - elapsed_s
    return NodeStatus(
        node=node.name,
        process="" if external else node.planned.process,
        process_state=None if known is None else process_state(run, known),
        pid=pid,
        managed=node.planned.managed,
        reach=node.reach,
        state="" if died else _state(node, verdict),
        doing=node.doing or node.core.withheld,
        matched=matches.count(True),
        unreported=matches.count(None),
        endpoints=len(matches),
        unique_flows=sum(flow.unique in (UniqueHow.WEAKLY, UniqueHow.STRONGLY) for flow in flows),
        flows=len(flows),
        findings=sum(
            node.name in (finding.node, finding.subject)
            for finding in (() if verdict is None else verdict.findings)
        ),
        silent=system.liveliness.silent.get(node.name, ""),
        died=died,
        connections=tuple(
            each
            for each in (() if configuration is None else configuration.connections)
            if each.name
        ),
        uptime_s=elapsed_s - process.started_s if runs and process is not None else None,
        restarts=0 if known is None else known.restarts,
        last_failure=last,
        next_try_s=due_s if known is not None and known.failed and due_s > 0 else None,
    )


def _state(node: NodeRun, verdict: Verdict | None) -> str:
    """Return a node's state; of one that others can drive unseen, what the last judgement saw."""
    judged = (
        each.observed
        for each in (() if verdict is None or node.is_hosted else verdict.findings)
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


def _died(run: Run, process: Process | None, pid: int) -> str:
    """Say how a node's process ended without being asked to; empty if it has not."""
    if process is None or process.end is None or process.escalation is not None or process.is_over:
        return ""
    if run.ending is not None and process.failure is None and not run.deaths:
        return ""
    return f"pid {pid} died: {process.end.text}"


def system_status(system: System) -> SystemStatus:
    """Return what is known of the whole system."""
    run, elapsed_s = system.run, system.emit.elapsed_s
    verdict = run.judged.verdict
    return SystemStatus(
        system=run.plan.system,
        domain_id=run.plan.domain_id,
        phase=phase_of(run),
        verdict=None if verdict is None else verdict.verdict,
        supervisor=os.getpid(),
        elapsed_s=elapsed_s,
        nodes=tuple(_node_status(system, node, elapsed_s) for node in system.nodes.values()),
        not_ok="" if verdict is None else not_ok(verdict),
        mode=run.mode,
        manifest=run.first.manifest_path,
        revision=run.revision,
        ends="" if run.ending is None else run.ending.why,
        measured=() if verdict is None else verdict.measured,
    )


def finding_of(failure: Failure) -> Finding:
    """Return the finding that a failure is."""
    found = rule(failure.rule)
    return found.finding(
        outcome=Outcome.VIOLATED,
        subject=failure.subject,
        expected="",
        observed="",
        message=failure.message,
        node=node_of(failure.subject),
        hint=f"{found.fix}: {failure.log}" if failure.log and found.names_log else "",
    )


def ended_early(reason: str, exit_code: ExitCode, *failures: Failure) -> UpResult:
    """Return the result of a run that ended before there was anything to judge."""
    verdict = with_failures(NOT_JUDGED, failures) if failures else NOT_JUDGED
    run = RunEnd(reason=reason, reached=None, exit_code=exit_code)
    return UpResult(exit_code=exit_code, verdict=replace(verdict, run=run))


def with_failures(
    verdict: Verdict, failures: Iterable[Failure], gone: Collection[str] = ()
) -> Verdict:
    """Return `verdict`, violated, with all that failed as its first findings, each once.

    What only follows from a process that ended is not said again: that its nodes (full names in
    `gone`) are not there, and that others lack what they brought along.
    """
    findings = tuple({(each.rule, each.subject): finding_of(each) for each in failures}.values())
    named = {(each.rule, each.subject) for each in findings}
    rest = (
        each
        for each in verdict.findings
        if (each.rule, each.subject) not in named
        and (rule(each.rule).about is None or set(gone).isdisjoint((each.subject, *each.nodes)))
    )
    return replace(verdict, verdict=Outcome.VIOLATED, blocking=True, findings=(*findings, *rest))


def result_of(system: System, latest: Verdict) -> UpResult:
    """Return the result of a run that is over; `latest` is the verdict by which it began to end."""
    run = system.run
    ending = run.ending
    assert ending is not None
    code, reason = exit_code_of(run), ending.reason
    failures = [*ending.failures, *run.deaths]
    verdict = with_failures(latest, failures, _gone(system, failures)) if failures else latest
    if later := run.deaths[ending.deaths :]:
        died = ", ".join(f"{each.subject} ({each.rule})" for each in later)
        reason = f"{reason}, but failed: {died} while it was taken down"
    if run.hurry and ending.code is ExitCode.OK and code is ExitCode.INTERRUPTED:
        reason = f"{reason}; interrupted while it was taken down"
    end = RunEnd(reason=reason, reached=run.furthest or None, exit_code=code, trusted=run.trusted)
    return UpResult(exit_code=code, verdict=replace(verdict, run=end), plan=run.first)


_ENDED = (PROCESS_DIED.id, GAVE_UP.id)


def _gone(system: System, failures: Iterable[Failure]) -> frozenset[str]:
    """Return the names of the nodes that are not there any more, as their process has ended."""
    processes = {each.process for each in failures if each.rule in _ENDED and each.process}
    return frozenset(node.name for name in processes for node in system.carried_by(name))
