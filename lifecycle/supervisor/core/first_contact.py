"""Nodes that TCP did not let others discover are started again before a gate that waits for them.

Owns: who is, when, and how often. Pure.

Fast DDS 2.14 sometimes never uses a TCP connection that it has dialled: if the answer to its first
message arrives before the port inside the connection was noted, which happens when the dialling
thread loses its processor in between, the answer is ignored (BIND_CONNECTION_RESPONSE in
RTCPMessageManager::processRTCPMessage). Then nothing is sent that way for as long as both
participants live, and the dialled one takes no other connection from the same port. A participant
on another port is discovered by all from the beginning.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping

from lifecycle.plan.restart import moving_nodes
from lifecycle.supervisor.control.protocol import ProcessState
from lifecycle.supervisor.core import advance, gate
from lifecycle.supervisor.core.state import Level, Run
from lifecycle.supervisor.run.events import Event, Notice
from lifecycle.verify.judge import not_ok
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import rule
from lifecycle.verify.rules.catalogue import About
from lifecycle.verify.rules.nodes import MISSING_NODE
from lifecycle.verify.verdict import Stage, Verdict

UNCHANGED_S = 5.0
"""Who is discovered at all over TCP is after 0.1–1.6 s, on a machine with both processors busy
after 1–4 s; findings that have not changed for so long do not change any more."""

TRIES = 3
"""So many nodes are started again before a gate at most: each takes 1–5 s of the bring-up."""


def settle_first_contact(run: Run) -> list[Event]:
    """Have a node started again on a fresh port that others do not discover although it runs."""
    passage, judged = run.asked, run.judged
    if passage is None or not passage.at_gate or run.opening is not None or run.failures:
        return []
    if judged.verdict is None or gate.allows(run):
        return []
    is_late = passage.until_s - run.now_s <= UNCHANGED_S or passage.tries.total() >= TRIES
    if is_late or advance.stage_of(run) is not Stage.CONNECTED:
        return []
    if not gate.lasts_until(run, judged.since_s + UNCHANGED_S):
        return []
    name = undiscovered(judged.verdict, _restartable(run), passage.tries)
    node = None if name is None else run.node_named(name)
    if node is None:
        return []
    passage.tries[node.name] += 1
    judged.since_s = run.now_s
    for each in run.nodes_of(node.process):
        each.renew = True
    text = (
        f"{name!r} is started again on a fresh port: not discovered over TCP "
        f"for {UNCHANGED_S:g} s ({not_ok(judged.verdict)}); "
        f"try {passage.tries.total()} of {TRIES}"
    )
    return [Notice(message=text)]


def _restartable(run: Run) -> frozenset[str]:
    """Return the names of nodes that could be started again on fresh ports before the gate."""
    moving = moving_nodes(run.plan)
    active = {each.process for each in run.nodes.values() if each.level is Level.ACTIVE}
    return frozenset(
        each.name
        for key, each in run.nodes.items()
        if key in moving
        and each.process not in active
        and each.process in run.processes
        and run.processes[each.process].state is ProcessState.RUNNING
    )


def undiscovered(
    verdict: Verdict, restartable: Collection[str], tries: Mapping[str, int]
) -> str | None:
    """Return the full name of the node to start again; None where that would mend nothing.

    Of two ends that do not match either may be the undiscovered one: it is who lacks most,
    then who was started again least often, then the last by name.

    Args:
        verdict: that keeps the gate closed.
        restartable: full names of nodes that get fresh ports when they are started again, and whose
            process is ours and holds no active node.
        tries: how often each was started again before.
    """
    violated = [each for each in verdict.findings if each.outcome is Outcome.VIOLATED]
    if not all(rule(each.rule).if_undiscovered for each in violated):
        return None
    missing = [each for each in violated if each.rule == MISSING_NODE.id]
    # Who is not there yet, or not so far, keeps others waiting that nothing is wrong with.
    coming = (each for each in violated if rule(each.rule).about is About.PROGRESS)
    awaited = {each.node for each in (*missing, *coming)}
    unmatched = (each for each in violated if rule(each.rule).about is About.MATCH)
    pairs = (each.ends for each in unmatched if awaited.isdisjoint(each.ends))
    lacks = Counter(
        name
        for names in (*pairs, *((each.node,) for each in missing))
        for name in names
        if name in restartable
    )
    return max(lacks, key=lambda name: (lacks[name], -tries.get(name, 0), name), default=None)
