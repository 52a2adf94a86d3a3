"""What an onlooker expects of a system whose connections were negotiated without it."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import DataLayer, EndpointKind, FlowTransport
from lifecycle.node.host.control import Operation
from lifecycle.plan.model import Plan
from lifecycle.supervisor.connections.desired_state import steps, wired
from lifecycle.supervisor.connections.negotiation import Expectation, NegotiatedSource
from lifecycle.verify.observation import NodeConfiguration, Observation
from tests.builders import at
from tests.unit.supervisor.fakes import rewired
from tests.unit.supervisor.test_supervisor_negotiation import (
    LISTENER,
    TALKER,
    configured,
    known,
    media,
    plan_of,
)

GUEST = configured("/guest", (EndpointKind.SUBSCRIPTION, "chatter"))
OTHER_WAYS = (
    FlowTransport.UDPV4,
    FlowTransport.TCPV4,
    FlowTransport.MULTICAST,
    FlowTransport.NETWORK,
)


def wired_by(source: NegotiatedSource, *nodes: NodeConfiguration) -> dict[str, NodeConfiguration]:
    """What nodes report once an authority has told them what it negotiated."""
    now = known(*nodes)
    for name, wanted in source.instructions(now).items():
        for step in steps(wanted, wired(now[name])):
            now[name] = rewired(
                now[name],
                step.operation,
                connection=step.connection,
                urls=step.connections.urls,
                endpoint=step.endpoint,
            )
    source.instructions(now)
    return now


def seen(now: dict[str, NodeConfiguration]) -> Observation:
    return Observation(configurations=tuple(now.values()))


@pytest.mark.parametrize("way", OTHER_WAYS, ids=lambda each: each.value)
def test_it_does_so_too_after_guests_came_and_went(way: FlowTransport) -> None:
    plan = plan_of(transport=way)
    authority = NegotiatedSource(plan)
    now = wired_by(authority, TALKER, LISTENER)
    # The ports of who comes later are not those that a new negotiation would give out first.
    earlier = configured("/earlier", (EndpointKind.SUBSCRIPTION, "chatter"))
    now = wired_by(authority, *now.values(), earlier)
    del now["/earlier"]
    now = wired_by(authority, *now.values(), GUEST)
    assert Expectation.of(plan, seen(now)) == Expectation(plan=authority.expected)


def test_what_somebody_else_connected_is_not_expected() -> None:
    plan = plan_of(transport=FlowTransport.UDPV4)
    authority = NegotiatedSource(plan)
    now = wired_by(authority, TALKER, LISTENER)
    now["/talker"] = rewired(
        now["/talker"], Operation.CONNECT_TO, connection="mine", urls=("udpv4://127.0.0.1",)
    )
    now["/talker"] = rewired(
        now["/talker"], Operation.MAP_TO, connection="mine", endpoint="publishers/chatter"
    )
    expected = Expectation.of(plan, seen(now)).plan.node("talker")
    assert "mine" not in [each.connection for each in expected.participants]


def test_an_endpoint_made_in_code_is_expected_with_its_flow() -> None:
    plan = plan_of()
    news = replace(TALKER.endpoints[0], name="news", resolved="/news")
    heard = replace(LISTENER.endpoints[0], name="news", resolved="/news")
    talker = replace(TALKER, endpoints=(*TALKER.endpoints, news))
    listener = replace(LISTENER, endpoints=(*LISTENER.endpoints, heard))
    expected = Expectation.of(plan, seen(known(talker, listener)))
    assert media(expected.plan) == {
        ("/chatter", "talker", "listener"): "shm",
        ("/news", "talker", "listener"): "shm",
    }


def test_what_cannot_be_connected_is_a_finding() -> None:
    plan = plan_of(transport=FlowTransport.TCPV4)
    poor = replace(LISTENER, transports=("udpv4", "shm"))
    (finding,) = Expectation.of(plan, seen(known(TALKER, poor))).findings
    assert (finding.rule, finding.subject) == ("run.not-wired", plan.system)
    assert finding.message.startswith("cannot carry '/chatter' from 'talker' to 'listener' by tcp")


def test_where_nothing_is_negotiated_the_plan_is_what_must_be() -> None:
    plan: Plan = replace(plan_of(), data_layer=DataLayer(), positions={"data_layer": at(4)})
    assert Expectation.of(plan, seen(known(TALKER, LISTENER))) == Expectation(plan=plan)
