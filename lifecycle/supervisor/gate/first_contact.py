"""Who was not discovered over TCP although it is there, and is to be started again on a fresh port.

Owns: `undiscovered`, which reads that from a verdict. Starting again is sequence.py's. Pure.

Fast DDS 2.14 sometimes never uses a connection that it has dialled: if the answer to what it said
first comes before the port inside the connection was noted, which happens when the thread that
dials loses its processor in between, the answer is passed over (BIND_CONNECTION_RESPONSE in
RTCPMessageManager::processRTCPMessage). Then nothing is sent that way for as long as the two live,
and who was dialled takes no other connection from the same port. A participant on another port
meets everybody anew.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping

from lifecycle.verify.rules import About, rule
from lifecycle.verify.rules.nodes import MISSING_NODE
from lifecycle.verify.verdict import Outcome, Verdict

UNCHANGED_S = 5.0
"""Who is discovered at all over TCP is after 0.1–1.6 s, on a machine with both processors busy
after 1–4 s; findings that have not changed for so long do not change any more."""

TRIES = 3
"""So many nodes are started again before a gate at most: each takes 1–5 s of the bring-up."""


def undiscovered(
    verdict: Verdict, restartable: Collection[str], tries: Mapping[str, int]
) -> str | None:
    """Return the full name of the node to start again; None where that would mend nothing.

    Of two ends that do not match either may be the one that is not heard: it is who lacks most,
    then who was started again least often, then the last by name.

    Args:
        verdict: that keeps the gate closed.
        restartable: full names of nodes that get fresh ports when they are started again, and whose
            process is ours and holds no active node.
        tries: how often each was started again before.
    """
    violated = [each for each in verdict.findings if each.outcome is Outcome.VIOLATED]
    if not all(rule(each.rule).if_unheard for each in violated):
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
