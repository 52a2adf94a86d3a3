"""What may pass by itself while a system is watched, and for how long."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, FlowTransport
from lifecycle.plan.model import Plan
from lifecycle.supervisor.connections.negotiation import NegotiatedSource
from lifecycle.supervisor.judging.grace_period import PASSING_S, GracePeriod
from lifecycle.verify.judge import verify
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Finding, Stage, Verdict
from tests.builders import endpoint, node, planned
from tests.unit.supervisor.fakes import verdict_of
from tests.unit.supervisor.test_supervisor_negotiation import LISTENER, TALKER, known, plan_of
from tests.unit.verify.perfect import perfect

PUB = EndpointKind.PUBLISHER
OK = verdict_of(Outcome.OK)
UNATTRIBUTED = "graph.unattributed-endpoint"


def grown() -> tuple[Plan, Plan]:
    """A plan, and what is expected once both nodes made an endpoint of /news in code."""
    source = NegotiatedSource(plan_of())
    source.instructions(known(TALKER, LISTENER))
    before = source.expected
    more = [
        replace(
            each,
            checksum="1",
            endpoints=(
                *each.endpoints,
                replace(each.endpoints[0], name="news", resolved="/news"),
            ),
        )
        for each in (TALKER, LISTENER)
    ]
    source.instructions(known(*more))
    return before, source.expected


BEFORE, AFTER = grown()


def found(*findings: tuple[str, str, str]) -> Verdict:
    """A violated verdict of (rule, subject, node)."""
    return Verdict(
        verdict=Outcome.VIOLATED,
        blocking=True,
        findings=tuple(
            Finding(
                rule=rule,
                outcome=Outcome.VIOLATED,
                subject=subject,
                expected="",
                observed="",
                message="",
                node=node,
                endpoint=PUB if rule == "graph.missing-endpoint" else None,
            )
            for rule, subject, node in findings
        ),
        flows=(),
    )


YOUNG = [
    ("graph.missing-endpoint", "/news", "/talker"),
    ("flow.wrong-medium", "/news: /talker → /listener", ""),
    ("graph.unmatched-flow", "/news: /talker → /listener", ""),
]


@pytest.mark.parametrize("finding", YOUNG, ids=lambda each: each[0])
def test_what_has_only_just_become_expected_may_be_missing_for_a_moment(
    finding: tuple[str, str, str],
) -> None:
    grace_period = GracePeriod()
    assert grace_period.after(None, OK, BEFORE, 10.0) == (OK, None)
    bad = found(finding)
    assert grace_period.after(OK, bad, AFTER, 20.0) == (OK, PASSING_S)
    assert grace_period.after(OK, bad, AFTER, 20.25) == (OK, PASSING_S - 0.25)
    assert grace_period.after(OK, bad, AFTER, 20.0 + PASSING_S) == (bad, None)


@pytest.mark.parametrize(
    ("findings", "plan"),
    [
        ([("graph.missing-endpoint", "/chatter", "/talker")], AFTER),
        ([("flow.wrong-medium", "/chatter: /talker → /listener", "")], AFTER),
        ([("graph.missing-node", "/talker", "/talker")], AFTER),
        ([("connection.missing", "/talker", "/talker")], AFTER),
        # It was expected at the first look already.
        ([("graph.missing-endpoint", "/chatter", "/talker")], BEFORE),
        # With whatever else is wrong all of it is told.
        ([YOUNG[0], ("graph.missing-node", "/talker", "/talker")], AFTER),
    ],
)
def test_what_was_expected_before_may_not(findings: list[tuple[str, str, str]], plan: Plan) -> None:
    grace_period = GracePeriod()
    grace_period.after(None, OK, BEFORE, 10.0)
    bad = found(*findings)
    assert grace_period.after(OK, bad, plan, 20.0) == (bad, None)


def test_a_connection_that_was_only_just_negotiated_may_be_missing_for_a_moment() -> None:
    plan = plan_of(transport=FlowTransport.UDPV4)
    source = NegotiatedSource(plan)
    source.instructions(known(TALKER, LISTENER))
    grace_period = GracePeriod()
    grace_period.after(None, OK, plan, 10.0)
    bad = found(("connection.missing", "/talker", "/talker"))
    assert grace_period.after(OK, bad, source.expected, 20.0) == (OK, PASSING_S)


def test_what_healed_is_told_at_once_too() -> None:
    grace_period = GracePeriod()
    bad = found(("graph.missing-node", "/talker", "/talker"))
    grace_period.after(None, bad, BEFORE, 10.0)
    other = found(YOUNG[0])
    assert grace_period.after(bad, other, AFTER, 20.0) == (other, None)


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


def test_the_first_verdict_of_all_is_told_whatever_it_is() -> None:
    bad = found((UNATTRIBUTED, "/rosout", ""))
    assert GracePeriod().after(None, bad, BEFORE, 0.0) == (bad, None)


def test_a_client_that_has_only_just_become_expected_may_be_unmatched_for_a_moment() -> None:
    grace_period = GracePeriod()
    grace_period.after(None, OK, BEFORE, 10.0)
    asks = replace(AFTER.nodes[0].endpoints[0], kind=EndpointKind.SERVICE_CLIENT, resolved="/ask")
    answers = replace(asks, kind=EndpointKind.SERVICE_SERVER)
    client, server = AFTER.nodes[:2]
    plan = replace(
        AFTER,
        nodes=(
            replace(client, endpoints=(*client.endpoints, asks)),
            replace(server, endpoints=(*server.endpoints, answers)),
        ),
    )
    names = client.full_name, server.full_name
    bad = found(("graph.unmatched-client", f"/ask: {names[0]} → {names[1]}", names[0]))
    assert grace_period.after(OK, bad, plan, 20.0) == (OK, PASSING_S)
    assert grace_period.after(OK, bad, plan, 20.0 + PASSING_S) == (bad, None)


STATUS = "not_installed_interfaces/srv/Status"


def with_client(plan: Plan, *hashes: str) -> Verdict:
    """The verdict on a tool's client for each hash, seen while the name of the tool is not known.

    That is so while the tool comes and while it goes.
    """
    seen = perfect(plan, Stage.ACTIVE)
    server = replace(seen.endpoints[0], type_hash="RIHS01_a RIHS01_a")
    client = replace(server, kind=EndpointKind.SERVICE_CLIENT, node="", gid="010f78fd" + 24 * "0")
    clients = (replace(client, type_hash=each) for each in hashes)
    observation = replace(seen, endpoints=(server, *clients))
    return verify(plan, observation, stage=Stage.ACTIVE)


def test_a_client_of_an_unknown_node_that_is_half_seen_may_pass() -> None:
    plan = planned(
        node("station", endpoint(EndpointKind.SERVICE_SERVER, "/status", STATUS, qos=None))
    )
    fine = with_client(plan)
    half = with_client(plan, "")
    both = {"graph.unattributed-endpoint", "graph.type-definition-differs"}
    assert {each.rule for each in half.findings} - {each.rule for each in fine.findings} == both
    grace_period = GracePeriod()
    grace_period.after(None, fine, plan, 0.0)
    assert grace_period.after(fine, half, plan, 10.0) == (fine, PASSING_S)
    assert grace_period.after(fine, half, plan, 10.0 + PASSING_S) == (half, None)


def test_a_client_of_an_unknown_node_with_another_definition_is_told_at_once() -> None:
    plan = planned(
        node("station", endpoint(EndpointKind.SERVICE_SERVER, "/status", STATUS, qos=None))
    )
    fine = with_client(plan)
    other = with_client(plan, "RIHS01_b RIHS01_b")
    assert other.verdict is Outcome.VIOLATED
    grace_period = GracePeriod()
    grace_period.after(None, fine, plan, 0.0)
    assert grace_period.after(fine, other, plan, 10.0) == (other, None)
