"""What may pass by itself while a system is watched, and for how long."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind
from lifecycle.plan.model import ParticipantConnections, Plan, PlannedParticipant
from lifecycle.supervisor.shell.settling import PASSING_S, GracePeriod
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
    grace_period = GracePeriod()
    assert grace_period.after(None, OK, BEFORE, 10.0) == (OK, None)
    bad = found(finding)
    assert grace_period.after(OK, bad, plan, 20.0) == (OK, PASSING_S)
    assert grace_period.after(OK, bad, plan, 20.25) == (OK, PASSING_S - 0.25)
    assert grace_period.after(OK, bad, plan, 20.0 + PASSING_S) == (bad, None)


@pytest.mark.parametrize(
    ("findings", "plan"),
    [
        ([("graph.missing-endpoint", "/chatter", "/talker")], AFTER),
        ([("flow.wrong-medium", "/chatter: /talker → /listener")], AFTER),
        ([GONE], AFTER),
        ([("connection.missing", "/talker")], AFTER),
        # It was expected at the first look already.
        ([("graph.missing-endpoint", "/chatter", "/talker")], BEFORE),
        # With whatever else is wrong all of it is said.
        ([NEWS, GONE], AFTER),
    ],
)
def test_what_was_expected_before_may_not(findings: list[tuple[str, ...]], plan: Plan) -> None:
    grace_period = GracePeriod()
    grace_period.after(None, OK, BEFORE, 10.0)
    bad = found(*findings)
    assert grace_period.after(OK, bad, plan, 20.0) == (bad, None)


def test_the_first_verdict_and_what_healed_are_said_at_once() -> None:
    grace_period = GracePeriod()
    first = found((UNATTRIBUTED, "/rosout", ""), GONE)
    assert grace_period.after(None, first, BEFORE, 10.0) == (first, None)
    other = found(NEWS)
    assert grace_period.after(first, other, AFTER, 20.0) == (other, None)


def test_each_newcomer_has_a_moment_of_its_own() -> None:
    grace_period = GracePeriod()
    grace_period.after(None, OK, BEFORE, 0.0)
    one = found((UNATTRIBUTED, "/rosout", ""))
    two = found((UNATTRIBUTED, "/rosout", ""), (UNATTRIBUTED, "/parameter_events", ""))
    assert grace_period.after(OK, one, BEFORE, 1.0) == (OK, PASSING_S)
    assert grace_period.after(OK, two, BEFORE, 1.5) == (OK, PASSING_S - 0.5)
    assert grace_period.after(OK, OK, BEFORE, 1.75) == (OK, None)
    # Gone, and there again: that is another newcomer.
    assert grace_period.after(OK, one, BEFORE, 2.0) == (OK, PASSING_S)


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
    for seen, holds in ((half, (fine, PASSING_S)), (other, (other, None))):
        grace_period = GracePeriod()
        grace_period.after(None, fine, STATION, 0.0)
        assert grace_period.after(fine, seen, STATION, 10.0) == holds
        assert grace_period.after(fine, seen, STATION, 10.0 + PASSING_S) == (seen, None)
