"""What carries a flow, and whether that is what it needs."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, FlowTransport, Machine
from lifecycle.network.nfe import (
    InternetProtocol,
    NetworkFlowEndpoint,
    TransportProtocol,
    UniqueRequirement,
)
from lifecycle.plan.model import Plan
from lifecycle.verify.network_flows import carrier
from lifecycle.verify.observation import Identity
from lifecycle.verify.outcome import ConnectionReport
from lifecycle.verify.verdict import Finding, Stage
from tests.builders import at, need, node, planned, publisher, subscription
from tests.unit.verify.edits import Edit, both, change_configuration, change_report
from tests.unit.verify.lines import verify
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
NETWORK = FlowTransport.NETWORK
STRICTLY = UniqueRequirement.STRICTLY_REQUIRED


def nfe(transport: str, internet: str, address: str, port: int = 7000) -> NetworkFlowEndpoint:
    return NetworkFlowEndpoint(
        transport_protocol=TransportProtocol(transport),
        internet_protocol=InternetProtocol(internet),
        transport_port=port,
        internet_address=address,
    )


SHM = nfe("unknown", "unknown", "")
UDP4, UDP6 = nfe("udp", "ipv4", "10.0.0.1"), nfe("udp", "ipv6", "fd00::1")
GROUP4 = nfe("udp", "ipv4", "239.255.1.9")
ODD = nfe("unknown", "unknown", "10.0.0.1")
TCP4, TCP6 = nfe("tcp", "ipv4", "10.0.0.1"), nfe("tcp", "ipv6", "fd00::1")


def process(number: int, machine: str = "m") -> Identity:
    return Identity(machine_id=machine, process_id=number, node_id=f"/n@{number}")


@pytest.mark.parametrize(
    ("source", "destination", "publisher", "subscription", "used"),
    [
        ((SHM, UDP4), (SHM, UDP4), process(1), process(2), "shm"),
        ((SHM, UDP4), (SHM, UDP4), process(1), process(2, "other"), "udpv4"),
        ((SHM, UDP4), (SHM, UDP4), process(1), process(1), "intraprocess"),
        ((UDP4,), (UDP4,), process(1), process(1), "intraprocess"),
        ((UDP4,), (UDP4,), process(1), process(1, "other"), "udpv4"),
        ((UDP4,), (SHM, UDP4), process(1), process(2), "udpv4"),
        ((SHM, UDP4), (UDP4,), process(1), process(2), "udpv4"),
        ((UDP6,), (UDP6,), process(1), process(2), "udpv6"),
        ((UDP4, UDP6), (UDP6, UDP4), process(1), process(2), "udpv6"),
        ((TCP4,), (TCP4,), process(1), process(2), "tcpv4"),
        ((TCP6, UDP4), (TCP6,), process(1), process(2), "tcpv6"),
        ((UDP4,), (UDP4, GROUP4), process(1), process(2), "udpm"),
        ((UDP4,), (GROUP4,), process(1), process(2), "udpm"),
        ((SHM, UDP4), (SHM, GROUP4), process(1), process(2), "shm"),
        ((UDP4, TCP4), (GROUP4, TCP4), process(1), process(2, "other"), "tcpv4"),
        ((TCP4,), (GROUP4, TCP4), process(1), process(2), "tcpv4"),
        ((UDP4,), (UDP6,), process(1), process(2), "none"),
        ((SHM,), (SHM,), process(1), process(2, "other"), "none"),
        ((nfe("udp", "ipv4", ""),), (nfe("udp", "ipv4", ""),), process(1), process(2), "none"),
        ((ODD, UDP4), (ODD, UDP4), process(1), process(2), "udpv4"),
        ((UDP4,), (nfe("udp", "ipv4", "robot.local"),), process(1), process(2), "udpv4"),
        ((TCP4,), (nfe("tcp", "ipv4", "239.255.1.9"),), process(1), process(2), "tcpv4"),
        ((UDP4,), (nfe("udp", "ipv6", "ff02::9"),), process(1), process(2), "none"),
        ((UDP6,), (nfe("udp", "ipv6", "ff02::9"),), process(1), process(2), "udpm"),
        ((), (UDP4,), process(1), process(2), "unknown"),
        ((UDP4,), (), process(1), process(2), "unknown"),
        ((UDP4,), (UDP4,), None, process(2), "unknown"),
        ((UDP4,), (UDP4,), process(1), None, "unknown"),
    ],
)
def test_what_carries_a_flow_follows_from_process_machine_and_what_both_ends_have(
    source, destination, publisher, subscription, used
):
    assert carrier(source, destination, publisher, subscription) == used


def pair(publishing: FlowTransport, subscribing: FlowTransport, **rest: object) -> Plan:
    return planned(
        node("one", publisher("a"), needs=[need(PUB, "a", transport=publishing)], **rest),
        node("two", subscription("a"), needs=[need(SUB, "a", transport=subscribing)], **rest),
    )


def findings(plan: Plan, edit: Edit) -> list[tuple[str, str, str]]:
    verdict = verify(plan, edit(perfect(plan)), stage=Stage.CONNECTED)
    return [(each.rule, each.outcome.value, each.observed) for each in verdict.findings]


@pytest.mark.parametrize(
    ("publishing", "subscribing"), [(NETWORK, FlowTransport.ANY), (FlowTransport.ANY, NETWORK)]
)
def test_one_end_without_shared_memory_is_enough_for_the_network(publishing, subscribing):
    plan = pair(publishing, subscribing)
    verdict = verify(plan, perfect(plan), stage=Stage.CONNECTED)
    assert verdict.findings == ()
    assert [each.effective_transport for each in verdict.flows] == ["udpv4"]


@pytest.mark.parametrize(
    ("receives", "source"), [((TCP4,), (TCP4,)), ((UDP4,), (UDP4,)), ((GROUP4,), (UDP4,))]
)
def test_a_flow_has_only_those_sockets_of_a_connection_that_carry_it(receives, source):
    plan = pair(NETWORK, FlowTransport.ANY)
    edit = both(
        change_report(PUB, "/a", nfes=(UDP4, TCP4)), change_report(SUB, "/a", nfes=receives)
    )
    (flow,) = verify(plan, edit(perfect(plan)), stage=Stage.CONNECTED).flows
    assert (flow.source, flow.destination) == (source, receives)


LISTED = change_report(PUB, "/a", nfes=(SHM, nfe("udp", "ipv4", "0.0.0.0", 40000)))


@pytest.mark.parametrize(
    ("plan", "edit", "expected"),
    [
        (
            pair(NETWORK, FlowTransport.ANY),
            LISTED,
            ("flow.wrong-transport", "violated", "shared memory"),
        ),
        (
            pair(NETWORK, FlowTransport.ANY),
            both(
                change_configuration("/one", identity=process(1)),
                change_configuration("/two", identity=process(1)),
            ),
            ("flow.wrong-transport", "violated", "handed over inside their process"),
        ),
        (
            pair(NETWORK, FlowTransport.ANY),
            change_report(SUB, "/a", nfes=(UDP6,)),
            ("flow.wrong-transport", "violated", "no transport that both have"),
        ),
        (
            pair(NETWORK, FlowTransport.ANY),
            change_report(PUB, "/a", nfes=None),
            ("flow.wrong-transport", "unverifiable", "not known"),
        ),
    ],
)
def test_what_is_no_network(plan: Plan, edit: Edit, expected: tuple[str, str, str]):
    assert findings(plan, edit) == [expected]


MACHINES = (
    Machine(name="m1", address="10.0.0.1", at=at(2)),
    Machine(name="m2", address="10.0.0.2", at=at(2)),
)
BRIDGE = nfe("udp", "ipv4", "172.17.0.1")


def on_two_machines(*, declared: bool) -> Plan:
    plan = planned(
        node("one", subscription("a"), needs=[need(SUB, "a", STRICTLY)], machine="m1"),
        node("two", subscription("b"), needs=[need(SUB, "b", STRICTLY)], machine="m2"),
    )
    return replace(plan, machines=MACHINES) if declared else plan


BOTH_BRIDGED = both(
    change_report(SUB, "/a", nfes=(nfe("udp", "ipv4", "10.0.0.1"), BRIDGE)),
    change_report(SUB, "/b", nfes=(nfe("udp", "ipv4", "10.0.0.2"), BRIDGE)),
)


def test_container_bridges_of_one_address_do_not_make_two_machines_share_a_flow():
    assert findings(on_two_machines(declared=True), BOTH_BRIDGED) == []


# --- what a connection carries where the RMW lists no NFE of it


def seen_by(plan: Plan, edit: Edit) -> str:
    """What carries the one flow of the plan."""
    (flow,) = verify(plan, edit(perfect(plan)), stage=Stage.CONNECTED).flows
    return flow.effective_transport


def connected(node_name: str, *urls: str, name: str = "net") -> Edit:
    """The node has this connection, and others before and after it."""
    return change_configuration(
        node_name,
        connections=(
            ConnectionReport(name="first", urls=("udpv6://",)),
            ConnectionReport(name=name, urls=urls),
            ConnectionReport(name="last", urls=("udpv6://",)),
        ),
    )


def by_connection(kind: EndpointKind, *urls: str, **report: object) -> Edit:
    """One end lists no NFE and is mapped onto a connection with these URLs."""
    mapped = {"nfes": (), "connection": "net", "mapped": True, **report}
    return both(
        connected("/one" if kind is PUB else "/two", *urls), change_report(kind, "/a", **mapped)
    )


EVERYTHING = (TCP4, TCP6, UDP4, UDP6, SHM)
ANY = pair(FlowTransport.ANY, FlowTransport.ANY)


def apart(edit: Edit) -> Edit:
    """The two nodes run on two machines."""
    return both(edit, change_configuration("/two", identity=process(2, "other")))


@pytest.mark.parametrize(
    ("urls", "near", "far"),
    [
        (("shm://",), "shm", "none"),
        (("udpv4://",), "udpv4", "udpv4"),
        (("udpv4://10.0.0.1:7000",), "udpv4", "udpv4"),
        (("udpv6://",), "udpv6", "udpv6"),
        (("udpv6://[fd00::1]:7000",), "udpv6", "udpv6"),
        (("tcpv4://10.0.0.1:5100",), "tcpv4", "tcpv4"),
        (("tcpv4://:5100",), "tcpv4", "tcpv4"),
        (("udpm://239.255.1.9:7901",), "udpv4", "udpv4"),
        (("udpm://[ff02::9]:7901",), "udpv6", "udpv6"),
        (("no url", "udpv6://"), "udpv6", "udpv6"),
        (("no url",), "unknown", "unknown"),
        ((), "unknown", "unknown"),
    ],
)
def test_a_publisher_without_nfes_sends_by_what_it_was_connected_to(urls, near, far):
    edit = both(by_connection(PUB, *urls), change_report(SUB, "/a", nfes=EVERYTHING))
    assert seen_by(ANY, edit) == near
    assert seen_by(ANY, apart(edit)) == far


@pytest.mark.parametrize(
    ("urls", "near", "far"),
    [
        (("shm://",), "shm", "none"),
        (("udpv4://",), "udpv4", "udpv4"),
        (("udpm://239.255.1.9:7901",), "udpm", "none"),
        (("udpm://[ff02::9]:7901",), "udpm", "none"),
    ],
)
def test_a_subscription_without_nfes_receives_by_what_it_was_connected_to(urls, near, far):
    edit = both(change_report(PUB, "/a", nfes=EVERYTHING), by_connection(SUB, *urls))
    assert seen_by(ANY, edit) == near
    assert seen_by(ANY, apart(edit)) == far


@pytest.mark.parametrize(
    ("urls", "report", "used"),
    [
        # TCP is what the RMW does not list; what it lists is all of the rest.
        (("tcpv4://:5100",), {"nfes": (UDP6,)}, "tcpv4"),
        (("udpv4://",), {"nfes": (UDP6,)}, "udpv6"),
        (("tcpv4://:5100",), {"nfes": (TCP6,)}, "tcpv6"),
        (("tcpv4://:5100",), {"nfes": None}, "unknown"),
        (("tcpv4://:5100",), {"mapped": False}, "unknown"),
        (("tcpv4://:5100",), {"connection": "other"}, "unknown"),
        (("tcpv4://:5100",), {"connection": "last"}, "udpv6"),
    ],
)
def test_what_a_node_lists_wins_over_what_it_was_connected_to(urls, report, used):
    edit = both(by_connection(PUB, *urls, **report), change_report(SUB, "/a", nfes=EVERYTHING))
    assert seen_by(ANY, apart(edit)) == used


# --- what findings on transports say


def with_medium(medium: str, *, publishing: FlowTransport = FlowTransport.ANY) -> Plan:
    """A plan whose data layer somebody asked for, with this medium for the flow."""
    plan = pair(publishing, FlowTransport.ANY)
    return replace(
        plan,
        positions={"data_layer": at(5)},
        flows=tuple(replace(each, medium=medium) for each in plan.flows),
    )


def the_finding(plan: Plan, edit: Edit) -> Finding:
    (finding,) = (
        each
        for each in verify(plan, edit(perfect(plan)), stage=Stage.CONNECTED).findings
        if each.rule.startswith("flow.wrong-")
    )
    return finding


def test_a_flow_that_the_network_must_carry_is_found_wrong_once():
    plan = with_medium("udpv4", publishing=NETWORK)
    assert the_finding(plan, LISTED).rule == "flow.wrong-transport"
    by_udp = both(
        change_report(PUB, "/a", nfes=(UDP4, UDP6)), change_report(SUB, "/a", nfes=(UDP6,))
    )
    assert the_finding(plan, by_udp).rule == "flow.wrong-medium"
