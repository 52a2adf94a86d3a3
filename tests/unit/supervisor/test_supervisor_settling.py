"""What may pass by itself while a system is watched, and for how long."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind
from lifecycle.plan.model import ParticipantConnections, Plan, PlannedParticipant
from lifecycle.supervisor.core.state import NEVER_S
from lifecycle.supervisor.shell.settling import PASSING_S, Passing
from lifecycle.verify.judge import verify
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Stage, Verdict
from tests.builders import endpoint, node, planned, publisher, subscription
from tests.unit.supervisor.fakes import verdict
from tests.unit.verify.perfect import perfect

ASK = ("/ask", "not_installed_interfaces/srv/Ask")
SERVER = endpoint(EndpointKind.SERVICE_SERVER, *ASK, qos=None)
CLIENT = endpoint(EndpointKind.SERVICE_CLIENT, *ASK, qos=None)

BEFORE = planned(node("talker", publisher("/chatter")), node("listener", subscription("/chatter")))
AFTER = planned(
    node("talker", publisher("/chatter"), publisher("/news"), CLIENT),
    node("listener", subscription("/chatter"), subscription("/news"), SERVER),
)
"""The same once both nodes made endpoints of /news and of /ask in code."""

_NET = ParticipantConnections(urls=("udpv4://10.77.0.1:7911",))
_CONNECTED = PlannedParticipant(
    name="_talker_net", dscp=None, reason="", connection="net", connections=_NET
)
CONNECTED = replace(
    BEFORE, nodes=(replace(BEFORE.nodes[0], participants=(_CONNECTED,)), BEFORE.nodes[1])
)
"""The same once a connection was negotiated."""

OK = verdict()
UNATTRIBUTED = "graph.unattributed-endpoint"


def found(*findings: tuple[str, ...]) -> Verdict:
    """A violated verdict; of endpoints publishers are missing."""
    made = verdict(*findings)
    missing = (
        replace(each, endpoint=EndpointKind.PUBLISHER)
        if each.rule == "graph.missing-endpoint"
        else each
        for each in made.findings
    )
    return replace(made, findings=tuple(missing))


NEWS = ("graph.missing-endpoint", "/news", "/talker")
GONE = ("graph.missing-node", "/talker")


@pytest.mark.parametrize(
    ("finding", "plan"),
    [
        (NEWS, AFTER),
        (("flow.wrong-medium", "/news: /talker → /listener"), AFTER),
        (("graph.unmatched-flow", "/news: /talker → /listener"), AFTER),
        (("graph.unmatched-client", "/ask: /talker → /listener"), AFTER),
        (("connection.missing", "/talker"), CONNECTED),
    ],
)
def test_what_has_only_just_become_expected_may_be_missing_for_a_moment(
    finding: tuple[str, ...], plan: Plan
) -> None:
    passing, bad = after(OK), found(finding)
    for later_s in (0.0, 0.25):
        assert rules(passing, bad, plan, 20.0 + later_s) == ([], PASSING_S - later_s)
    assert rules(passing, bad, plan, 20.0 + PASSING_S) == ([finding[0]], NEVER_S)


def after(verdict: Verdict, plan: Plan = BEFORE, at_s: float = 0.0) -> Passing:
    """One that has looked once."""
    passing = Passing()
    assert passing.without(verdict, plan, at_s, stage=Stage.ACTIVE) == (verdict, NEVER_S)
    return passing


def rules(passing: Passing, seen: Verdict, plan: Plan, now_s: float) -> tuple[list[str], float]:
    """The rules of what is left, and when to look again."""
    left, again_s = passing.without(seen, plan, now_s, stage=Stage.ACTIVE)
    return [each.rule for each in left.findings], again_s


@pytest.mark.parametrize(
    ("findings", "plan"),
    [
        ([("graph.missing-endpoint", "/chatter", "/talker")], AFTER),
        ([("flow.wrong-medium", "/chatter: /talker → /listener")], AFTER),
        ([GONE], AFTER),
        ([("connection.missing", "/talker")], AFTER),
        # It was expected at the first look already.
        ([("graph.missing-endpoint", "/chatter", "/talker")], BEFORE),
    ],
)
def test_what_was_expected_before_may_not(findings: list[tuple[str, ...]], plan: Plan) -> None:
    bad = found(*findings)
    assert rules(after(OK), bad, plan, 20.0) == ([each[0] for each in findings], NEVER_S)


def test_what_is_wrong_beside_it_is_said_at_once() -> None:
    assert rules(after(OK), found(NEWS, GONE), AFTER, 20.0) == ([GONE[0]], PASSING_S)


def test_at_a_gate_only_a_peer_that_is_not_known_yet_may_pass_and_only_behind_it() -> None:
    seen = found((UNATTRIBUTED, "/rosout", ""), ("graph.unknown-peer", "/chatter"))
    for stage, left in ((Stage.ACTIVE, 1), (Stage.CONNECTED, 2)):
        verdict, _ = after(OK).without(seen, BEFORE, 1.0, stage=stage, watched=False)
        assert len(verdict.findings) == left


def test_each_newcomer_has_a_moment_of_its_own() -> None:
    passing = after(OK)
    one = found((UNATTRIBUTED, "/rosout", ""))
    two = found((UNATTRIBUTED, "/rosout", ""), (UNATTRIBUTED, "/parameter_events", ""))
    assert rules(passing, one, BEFORE, 1.0) == ([], PASSING_S)
    assert rules(passing, two, BEFORE, 1.5) == ([], PASSING_S - 0.5)
    assert rules(passing, two, BEFORE, 2.0) == ([UNATTRIBUTED], PASSING_S - 0.5)
    assert rules(passing, OK, BEFORE, 2.25) == ([], NEVER_S)
    # Gone, and there again: that is another newcomer.
    assert rules(passing, one, BEFORE, 2.5) == ([], PASSING_S)


STATION = planned(node("station", SERVER))


def with_client(*hashes: str) -> Verdict:
    """The verdict on a tool's client for each hash, seen while the name of the tool is not known.

    That is so while the tool comes and while it goes.
    """
    seen = perfect(STATION, Stage.ACTIVE)
    server = replace(seen.endpoints[0], type_hash="RIHS01_a RIHS01_a")
    client = replace(server, kind=EndpointKind.SERVICE_CLIENT, node="", gid="010f78fd" + 24 * "0")
    clients = (replace(client, type_hash=each) for each in hashes)
    observation = replace(seen, endpoints=(server, *clients))
    return verify(STATION, observation, stage=Stage.ACTIVE)


def test_a_client_of_an_unknown_node_may_be_half_seen_and_not_of_another_definition() -> None:
    fine, half, other = with_client(), with_client(""), with_client("RIHS01_b RIHS01_b")
    both = {UNATTRIBUTED, "graph.type-definition-differs"}
    assert {each.rule for each in half.findings} - {each.rule for each in fine.findings} == both
    assert other.verdict is Outcome.VIOLATED
    said = {each.rule for each in other.findings} - {UNATTRIBUTED}
    for seen, at_first in ((half, set()), (other, said)):
        passing = after(fine, STATION)
        left, passes_s = rules(passing, seen, STATION, 10.0)
        assert ({*left} - {each.rule for each in fine.findings}, passes_s) == (at_first, PASSING_S)
        said = [each.rule for each in seen.findings]
        assert rules(passing, seen, STATION, 10.0 + PASSING_S) == (said, NEVER_S)
