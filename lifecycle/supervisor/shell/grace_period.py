"""What may pass by itself while a system is watched, and for how long.

Owns: `GracePeriod`: the facts of one change arrive one by one, and a verdict that is worse by what
is not known yet alone is kept back for a moment. The gate itself has no grace period. Pure.
"""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.manifest.model import EndpointKind
from lifecycle.plan.model import Plan
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import rule
from lifecycle.verify.rules.catalogue import About
from lifecycle.verify.rules.endpoints import DEFINITION_DIFFERS, UNATTRIBUTED_ENDPOINT
from lifecycle.verify.rules.matching import SERVER_OF
from lifecycle.verify.rules.nodes import UNDECLARED_NODE
from lifecycle.verify.rules.parameters import SILENT_CLOCK
from lifecycle.verify.tool_filter import is_hidden_node
from lifecycle.verify.verdict import Finding, FindingKey, Verdict

PASSING_S = 1.0
"""Discovery shows a newcomer's endpoints before its name, measured 0.02–0.45 s earlier; what nodes
have only just been asked for, or have just made in code, is seen 0.01–0.1 s later."""

_Place = tuple[object, ...]


class GracePeriod:
    """Knows since when something that may pass is wrong.

    Two kinds of findings may: an endpoint whose node is not known (yet), with what is not known of
    it for that reason; and whatever concerns an endpoint, a connection or a flow that must be there
    only since a moment ago, because the authority has just decided so.
    """

    def __init__(self) -> None:
        self._plan: Plan | None = None
        self._demanded: dict[tuple[_Place, str], float] = {}
        self._latest: dict[_Place, float] = {}
        self._unknown: dict[FindingKey, float] = {}

    def after(
        self, last: Verdict | None, verdict: Verdict, expected: Plan, now_s: float
    ) -> tuple[Verdict, float | None]:
        """Return the verdict that holds, and after how many seconds it has to be judged again.

        The seconds are None where what was found now holds.

        Args:
            last: the verdict that holds so far; None before the first.
            verdict: what was found now.
            expected: the plan that it was judged against.
            now_s: on any clock that only goes forward.
        """
        self._note(verdict, expected, now_s)
        before = set() if last is None else {each.key for each in last.findings}
        worse = [each for each in verdict.findings if each.key not in before]
        healed = before - {each.key for each in verdict.findings}
        if last is None or healed or not worse:
            return verdict, None
        left_s = [self._since(each) + PASSING_S - now_s for each in worse]
        if min(left_s) <= 0:
            return verdict, None
        return last, min(left_s)

    def _note(self, verdict: Verdict, expected: Plan, now_s: float) -> None:
        self._unknown = {
            each.key: self._unknown.get(each.key, now_s)
            for each in verdict.findings
            if _is_of_unknown_node(each)
        }
        if expected is self._plan:
            return
        since = float("-inf") if self._plan is None else now_s
        self._plan = expected
        self._demanded = {each: self._demanded.get(each, since) for each in _demands(expected)}
        self._latest = {}
        for (place, _), since in self._demanded.items():
            self._latest[place] = max(since, self._latest.get(place, since))

    def _since(self, finding: Finding) -> float:
        """Return since when a finding may pass; -inf if it may not."""
        if _is_of_unknown_node(finding):
            return self._unknown[finding.key]
        places: set[_Place] = {
            (finding.subject,),
            (finding.node, finding.endpoint, finding.subject),
        }
        if rule(finding.rule).about is About.CONNECTION:
            places.add(("connection", finding.node))
        return max(self._latest.get(place, float("-inf")) for place in places)


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
