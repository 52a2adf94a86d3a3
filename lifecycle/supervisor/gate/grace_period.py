"""What is wrong for a passing moment only, because the facts of one change arrive one by one.

Owns: `GracePeriod`: which findings may pass by themselves while a system is watched, and for how
long a verdict that is worse by these alone is not told. The gate knows no such patience. Pure.
"""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.manifest.model import EndpointKind
from lifecycle.plan.model import Plan
from lifecycle.verify.rules import About, rule
from lifecycle.verify.rules.clients import SERVER_OF
from lifecycle.verify.rules.outsiders import UNATTRIBUTED_ENDPOINT
from lifecycle.verify.verdict import Finding, Verdict

PASSING_S = 1.0
"""Discovery shows a newcomer's endpoints before its name, measured 0.02–0.45 s earlier; what nodes
have only just been told, or have just made in code, is seen 0.01–0.1 s later."""

_Key = tuple[str, str, str, EndpointKind | None]
_Place = tuple[object, ...]


class GracePeriod:
    """Knows since when something that may pass is wrong.

    Two kinds of findings may: an endpoint whose node is not known (yet), and whatever concerns an
    endpoint, a connection or a flow that must be there only since a moment ago, because the
    authority has just decided so.
    """

    def __init__(self) -> None:
        self._plan: Plan | None = None
        self._demanded: dict[tuple[_Place, str], float] = {}
        self._unattributed: dict[_Key, float] = {}

    def standing(
        self, last: Verdict | None, verdict: Verdict, expected: Plan, now_s: float
    ) -> tuple[Verdict, float | None]:
        """Return the verdict that stands, and after how many seconds it has to be judged again.

        The seconds are None where what was found now stands.

        Args:
            last: the verdict that stands so far; None before the first.
            verdict: what was found now.
            expected: the plan that it was judged against.
            now_s: on any clock that only goes forward.
        """
        self._note(verdict, expected, now_s)
        before = set() if last is None else {_key(each) for each in last.findings}
        worse = [each for each in verdict.findings if _key(each) not in before]
        healed = before - {_key(each) for each in verdict.findings}
        if last is None or healed or not worse:
            return verdict, None
        left_s = [self._since(each) + PASSING_S - now_s for each in worse]
        if min(left_s) <= 0:
            return verdict, None
        return last, min(left_s)

    def _note(self, verdict: Verdict, expected: Plan, now_s: float) -> None:
        self._unattributed = {
            key: self._unattributed.get(key, now_s)
            for key in map(_key, verdict.findings)
            if key[0] == UNATTRIBUTED_ENDPOINT.id
        }
        if expected is self._plan:
            return
        since = float("-inf") if self._plan is None else now_s
        self._plan = expected
        self._demanded = {each: self._demanded.get(each, since) for each in _demands(expected)}

    def _since(self, finding: Finding) -> float:
        """Return since when a finding may pass; -inf if it may not."""
        if finding.rule == UNATTRIBUTED_ENDPOINT.id:
            return self._unattributed[_key(finding)]
        places: set[_Place] = {
            (finding.subject,),
            (finding.node, finding.endpoint, finding.subject),
        }
        if rule(finding.rule).about is About.CONNECTION:
            places.add(("connection", finding.node))
        return max(
            (since for (place, _), since in self._demanded.items() if place in places),
            default=float("-inf"),
        )


def _key(finding: Finding) -> _Key:
    return finding.rule, finding.subject, finding.node, finding.endpoint


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
