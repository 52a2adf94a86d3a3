"""From node configurations to instructions, and to the plan that must then be seen."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import (
    Authority,
    DataLayer,
    DataLayerSource,
    EndpointKind,
    EndpointPolicy,
    FlowTransport,
    Policy,
)
from lifecycle.node.host.control import Operation
from lifecycle.plan.model import Plan
from lifecycle.supervisor.connections.instructions import (
    NegotiatedSource,
    expected_by_onlooker,
    steps,
    wired,
)
from lifecycle.verify.observation import EndpointReport, NodeConfiguration, Observation
from tests.builders import at, configuration, need, node, planned, publisher, reported, subscription
from tests.unit.supervisor.fakes import rewired

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION


def plan_of(*, transport: FlowTransport = FlowTransport.ANY, is_open: bool = True) -> Plan:
    policy = EndpointPolicy.OPEN if is_open else EndpointPolicy.DECLARED
    return planned(
        node(
            "talker",
            publisher("chatter"),
            needs=[need(PUB, "chatter", transport=transport)],
            endpoints=EndpointPolicy.OPEN,
        ),
        node("listener", subscription("chatter"), endpoints=EndpointPolicy.OPEN),
        data_layer=DataLayer(
            authority=Authority.SUPERVISOR, source=DataLayerSource.DYNAMIC, events=True
        ),
        positions={"data_layer": at(4)},
        policy=Policy(undeclared_nodes=policy),
    )


def configured(
    name: str, *endpoints: tuple[EndpointKind, str], transports: tuple[str, ...] = ()
) -> NodeConfiguration:
    return configuration(
        name,
        *(reported(kind, each) for kind, each in endpoints),
        process_id=sum(name.encode()),
        connected=False,
        transports=transports or ("shm", "udpv4", "udpv6", "udpm", "tcpv4"),
        checksum="0",
    )


TALKER = configured("/talker", (PUB, "chatter"))
LISTENER = configured("/listener", (SUB, "chatter"))
GUEST = configured("/guest", (SUB, "chatter"))


def known(*configurations: NodeConfiguration) -> dict[str, NodeConfiguration]:
    return {each.name: each for each in configurations}


def media(plan: Plan) -> dict[tuple[str, str, str], str]:
    return {(each.topic, each.publisher, each.subscription): each.medium for each in plan.flows}


def test_what_the_own_participants_do_anyway_needs_no_connection() -> None:
    source = NegotiatedSource(plan_of())
    told = source.instructions(known(TALKER, LISTENER))
    assert {name: each.connections for name, each in told.items()} == {
        "/talker": (),
        "/listener": (),
    }
    assert told["/talker"].mappings == (("publishers/chatter", ""),)
    assert media(source.expected) == {("/chatter", "talker", "listener"): "shm"}


def test_a_wish_for_another_medium_becomes_a_connection_of_the_plan_and_of_the_node() -> None:
    source = NegotiatedSource(plan_of(transport=FlowTransport.UDPV4))
    told = source.instructions(known(TALKER, LISTENER))
    ((name, how),) = told["/talker"].connections
    assert how.urls[0].startswith("udpv4://")
    assert told["/talker"].mappings == (("publishers/chatter", name),)
    expected = source.expected.node("talker")
    assert [each.connection for each in expected.participants] == [name]
    assert expected.endpoints[0].participant == expected.participants[0].name
    assert media(source.expected) == {("/chatter", "talker", "listener"): "udpv4"}


def test_the_same_reports_are_not_negotiated_again() -> None:
    source = NegotiatedSource(plan_of())
    first = source.instructions(known(TALKER, LISTENER))
    matched = replace(TALKER, state="active")
    assert source.instructions(known(matched, LISTENER)) is first


def test_an_endpoint_made_in_code_is_expected_mapped_and_flows() -> None:
    def grown(report: NodeConfiguration, kind: EndpointKind) -> NodeConfiguration:
        news = EndpointReport(kind=kind, name="", resolved="/news", type="std_msgs/msg/String")
        return replace(report, checksum="1", endpoints=(*report.endpoints, news))

    source = NegotiatedSource(plan_of(transport=FlowTransport.UDPV4))
    before = source.instructions(known(TALKER, LISTENER))
    after = source.instructions(known(grown(TALKER, PUB), grown(LISTENER, SUB)))
    assert after["/talker"].connections == before["/talker"].connections
    assert after["/talker"].mappings == (*before["/talker"].mappings, ("publishers//news", ""))
    listener = source.expected.node("listener")
    assert [each.resolved for each in listener.endpoints] == ["/chatter", "/news"]
    assert media(source.expected)[("/news", "talker", "listener")] == "shm"


def test_a_guest_takes_part_in_an_open_system_only_and_leaves_nothing_behind() -> None:
    source = NegotiatedSource(plan_of(is_open=False))
    assert "/guest" not in source.instructions(known(TALKER, LISTENER, GUEST))
    source = NegotiatedSource(plan_of(transport=FlowTransport.TCPV4))
    alone = source.instructions(known(TALKER, LISTENER))
    with_guest = source.instructions(known(TALKER, LISTENER, GUEST))
    assert with_guest["/guest"].connections != ()
    assert source.instructions(known(TALKER, LISTENER)).keys() == alone.keys()
    # One that cannot be connected is no problem of the system.
    poor = configured("/guest", (SUB, "chatter"), transports=("udpv4",))
    source.instructions(known(TALKER, LISTENER, poor))
    assert source.problems == ()


# What an onlooker expects of a system whose connections were negotiated without it.

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
def test_an_onlooker_negotiates_the_same_also_after_guests_came_and_went(
    way: FlowTransport,
) -> None:
    plan = plan_of(transport=way)
    authority = NegotiatedSource(plan)
    now = wired_by(authority, TALKER, LISTENER)
    # Who has made all of it is asked for nothing more.
    wanted = authority.instructions(now)
    assert all(steps(wanted[name], wired(each)) == () for name, each in now.items())
    # The ports of who comes later are not those that a new negotiation would give out first.
    earlier = configured("/earlier", (SUB, "chatter"))
    now = wired_by(authority, *now.values(), earlier)
    del now["/earlier"]
    now = wired_by(authority, *now.values(), GUEST)
    assert expected_by_onlooker(plan, seen(now)) == (authority.expected, ())


def test_what_somebody_else_connected_is_not_expected() -> None:
    plan = plan_of(transport=FlowTransport.UDPV4)
    authority = NegotiatedSource(plan)
    now = wired_by(authority, TALKER, LISTENER)
    urls = ("udpv4://127.0.0.1",)
    talker = rewired(now["/talker"], Operation.CONNECT_TO, connection="mine", urls=urls)
    now["/talker"] = rewired(
        talker, Operation.MAP_TO, connection="mine", endpoint="publishers/chatter"
    )
    expected = expected_by_onlooker(plan, seen(now))[0].node("talker")
    assert "mine" not in [each.connection for each in expected.participants]


def test_an_onlooker_expects_an_endpoint_made_in_code_with_its_flow() -> None:
    plan = plan_of()
    news = replace(TALKER.endpoints[0], name="news", resolved="/news")
    heard = replace(LISTENER.endpoints[0], name="news", resolved="/news")
    talker = replace(TALKER, endpoints=(*TALKER.endpoints, news))
    listener = replace(LISTENER, endpoints=(*LISTENER.endpoints, heard))
    expected, _ = expected_by_onlooker(plan, seen(known(talker, listener)))
    assert media(expected) == {
        ("/chatter", "talker", "listener"): "shm",
        ("/news", "talker", "listener"): "shm",
    }


def test_what_cannot_be_connected_is_a_finding() -> None:
    plan = plan_of(transport=FlowTransport.TCPV4)
    poor = replace(LISTENER, transports=("udpv4", "shm"))
    _, (finding,) = expected_by_onlooker(plan, seen(known(TALKER, poor)))
    assert (finding.rule, finding.subject) == ("run.not-wired", plan.system)
    assert finding.message.startswith("cannot carry '/chatter' from 'talker' to 'listener' by tcp")


def test_where_nothing_is_negotiated_the_plan_is_what_must_be() -> None:
    plan: Plan = replace(plan_of(), data_layer=DataLayer(), positions={"data_layer": at(4)})
    assert expected_by_onlooker(plan, seen(known(TALKER, LISTENER))) == (plan, ())
