"""What a verdict must not be misled by: what passes by itself, and that we stood still.

Owns: `Passing`: the facts of one change arrive one by one, and what is not known yet alone is kept
back for a moment. The gate itself has no grace period. And
`Standstill`: this process was stopped or frozen, or its machine slept. What arrives meanwhile waits
in the kernel, and the middleware needs a moment to take it in: no verdict of before is one of now.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator

from lifecycle.manifest.model import EndpointKind
from lifecycle.plan.model import Plan
from lifecycle.supervisor.core.state import NEVER_S
from lifecycle.verify.judge import without_findings
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import rule
from lifecycle.verify.rules.catalogue import About
from lifecycle.verify.rules.endpoints import DEFINITION_DIFFERS, UNATTRIBUTED_ENDPOINT
from lifecycle.verify.rules.matching import SERVER_OF, UNKNOWN_PEER
from lifecycle.verify.rules.nodes import UNDECLARED_NODE
from lifecycle.verify.rules.parameters import SILENT_CLOCK
from lifecycle.verify.tool_filter import is_hidden_node
from lifecycle.verify.verdict import Finding, FindingKey, Stage, Verdict

PASSING_S = 1.0
"""Discovery shows a newcomer's endpoints before its name, measured 0.02–0.45 s earlier; what nodes
have only just been asked for, or have just made in code, is seen 0.01–0.1 s later."""

DISCOVERED_S = 3.5
"""A participant whose first announcements were lost is discovered with the next one, after 3 s by
default: a node of ours may be matched with it for so long before our participant knows it."""

_BEAT_S = 0.1
STILL_S = 0.25
"""A loop without a turn for so long, which did not compute either, stood still."""

_Place = tuple[object, ...]


class Passing:
    """Leaves out of verdicts what may pass by itself, for as long as it may.

    That is an endpoint whose node is not known (yet), with what is not known of it for that reason;
    whatever concerns an endpoint, a connection or a flow that must be there only since a moment
    ago, because the authority has just decided so; and a peer that only its match shows.
    """

    def __init__(self) -> None:
        self._plan: Plan | None = None
        self._demands: frozenset[tuple[_Place, str]] = frozenset()
        self._demanded_s: dict[_Place, float] = {}
        self._since_s: dict[FindingKey, float] = {}

    def without(
        self, verdict: Verdict, expected: Plan, now_s: float, *, stage: Stage, watched: bool = True
    ) -> tuple[Verdict, float]:
        """Return the verdict that holds, and in how many seconds to judge again.

        While it is not `watched` only peers that are not known yet may pass, behind the gate.
        """
        since_s = {each.key: self._since_s.get(each.key, now_s) for each in verdict.findings}
        self._since_s = since_s
        if expected is not self._plan:
            demands = frozenset(_demands(expected))
            if self._plan is not None:
                self._demanded_s |= {place: now_s for place, _ in demands - self._demands}
            self._plan, self._demands = expected, demands
        left_s = {
            each.key: self._passes_s(each, stage, watched=watched) - now_s
            for each in verdict.findings
        }
        passing = [each for each in verdict.findings if left_s[each.key] > 0]
        if not passing:
            return verdict, NEVER_S
        verdict = without_findings(verdict, passing, expected.policy)
        return verdict, min(left_s[each.key] for each in passing)

    def since_s(self, finding: Finding) -> float:
        """Return since when something is found that was so at the latest look."""
        return self._since_s[finding.key]

    def _passes_s(self, finding: Finding, stage: Stage, *, watched: bool) -> float:
        """Return until when a finding may pass; -inf if it may not."""
        if finding.rule == UNKNOWN_PEER.id and stage is Stage.ACTIVE:
            return self._since_s[finding.key] + DISCOVERED_S
        if not watched:
            return float("-inf")
        if _is_of_unknown_node(finding):
            return self._since_s[finding.key] + PASSING_S
        places: list[_Place] = [
            (finding.subject,),
            (finding.node, finding.endpoint, finding.subject),
        ]
        if rule(finding.rule).about is About.CONNECTION:
            places.append(("connection", finding.node))
        return max(self._demanded_s.get(place, float("-inf")) for place in places) + PASSING_S


def _is_of_unknown_node(finding: Finding) -> bool:
    """Whether a finding says that it is not known whose an endpoint is, or no type hash of it.

    Of a hidden participant discovery may be ahead of its node's report.

    A client and a server of a service are two DDS endpoints each, which are seen one after the
    other as they come and as they go: until both are there, none of their hash is known.
    """
    if finding.rule == DEFINITION_DIFFERS.id:
        return not finding.node and finding.outcome is Outcome.UNVERIFIABLE
    if finding.rule == UNDECLARED_NODE.id:
        return is_hidden_node(finding.node)
    # Who publishes the time begins to once it is active.
    return finding.rule in (UNATTRIBUTED_ENDPOINT.id, SILENT_CLOCK.id)


def _demands(plan: Plan) -> Iterator[tuple[_Place, str]]:
    """Yield what must be there: where a finding would say that it is not, and how it must be."""
    names = {each.key: each.full_name for each in plan.nodes}
    servers: dict[tuple[EndpointKind | None, str], list[str]] = {}
    for node in plan.nodes:
        for each in node.endpoints:
            servers.setdefault((each.kind, each.resolved), []).append(node.full_name)
    for node in plan.nodes:
        for each in node.endpoints:
            yield (node.full_name, each.kind, each.resolved), each.participant
            for server in servers.get((SERVER_OF.get(each.kind), each.resolved), ()):
                yield (f"{each.resolved}: {node.full_name} → {server}",), ""
        for one in node.participants:
            yield ("connection", node.full_name), f"{one.connection} {one.connections.urls}"
    for flow in plan.flows:
        ends = f"{names[flow.publisher]} → {names[flow.subscription]}"
        yield (f"{flow.topic}: {ends}",), flow.medium


class Standstill:
    """Counts for how often the running loop stood still; `close` it."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._count = 0
        self._last_s, self._cpu_s = _now_s(), time.thread_time()
        self._timer = self._loop.call_later(_BEAT_S, self._beat)

    def count(self) -> int:
        """Return how often it stood still until this very moment; call it in the loop."""
        now_s, cpu_s = _now_s(), time.thread_time()
        if now_s - self._last_s - (cpu_s - self._cpu_s) > STILL_S:
            self._count += 1
        self._last_s, self._cpu_s = now_s, cpu_s
        return self._count

    def close(self) -> None:
        """Notice nothing more."""
        self._timer.cancel()

    def _beat(self) -> None:
        self.count()
        self._timer = self._loop.call_later(_BEAT_S, self._beat)


def _now_s() -> float:
    """Return the time of CLOCK_BOOTTIME, which also goes on while the machine sleeps."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)
