"""The design article *Topological Discovery and Communication Negotiation*, as it is applied.

Its example, its declarative instructions, and what the planner, the authority and the negotiator
make of them. tests/articles/topological_discovery.md lists every statement of the article with its
test; most are proven where their code is.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.manifest.loading import load
from lifecycle.manifest.model import (
    Authority,
    DataLayer,
    DataLayerSource,
    Discovery,
    DiscoveryMode,
    EndpointKind,
    FlowTransport,
    Machine,
)
from lifecycle.network.connection_url import parse
from lifecycle.network.medium import Medium
from lifecycle.node.host.control import Operation
from lifecycle.plan.build import build_plan
from lifecycle.plan.discovery import Hosts
from lifecycle.plan.media import (
    DataLayerGraph,
    party_of_node,
    terms_of,
    wishes_of,
)
from lifecycle.plan.model import Plan
from lifecycle.plan.negotiate import negotiate
from lifecycle.supervisor.connections.instructions import (
    Instructions,
    NegotiatedSource,
    party_of,
    planned_instructions,
    steps,
)
from lifecycle.verify.observation import Identity, NodeConfiguration
from tests.builders import (
    at,
    configuration,
    link,
    manifest,
    need,
    node,
    planned,
    publisher,
    reported,
    subscription,
)

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
MACHINES = (
    Machine(name="m1", address="10.0.0.1", at=at(1)),
    Machine(name="m2", address="10.0.0.2", at=at(1)),
)

# --- Problem Space: the computational graph and the data layer graph

Placement = dict[str, tuple[str, str]]
"""Machine and process of each node."""
ARTICLE: Placement = {
    "n1": ("m1", "p1"),
    "n2": ("m1", "p1"),
    "n3": ("m1", "p2"),
    "n4": ("m2", "p3"),
}


def example(placement: Placement) -> Plan:
    """All publish and subscribe to T1; N1 publishes T2, to which the others subscribe."""
    nodes = []
    for key, (machine, process) in placement.items():
        t2 = publisher("t2") if key == "n1" else subscription("t2")
        t1 = (publisher("t1"), subscription("t1"))
        nodes.append(node(key, *t1, t2, machine=machine, process=process))
    return planned(*nodes, machines=MACHINES)


def computational_graph(plan: Plan) -> set[tuple[str, str, str, str]]:
    """Nodes and what they say and hear; nothing of processes, machines or media."""
    return {
        (node.full_name, each.kind.value, each.resolved, each.type)
        for node in plan.nodes
        for each in node.endpoints
    }


def data_layer_graph(plan: Plan) -> dict[tuple[str, str, str], str]:
    """What carries each topic from whom to whom."""
    return {(each.topic, each.publisher, each.subscription): each.medium for each in plan.flows}


def between(topic: str, media: dict[str, list[str]]) -> dict[tuple[str, str, str], str]:
    """Spell pairs, `n1→n2`, by their medium."""
    return {
        (topic, *pair.split("→")): medium  # type: ignore[misc]
        for medium, pairs in media.items()
        for pair in pairs
    }


def test_the_example_n1_to_n4_gets_a_medium_for_every_pair_by_process_and_machine():
    intraprocess = ["n1→n1", "n1→n2", "n2→n1", "n2→n2", "n3→n3", "n4→n4"]
    shm = ["n1→n3", "n2→n3", "n3→n1", "n3→n2"]
    network = ["n1→n4", "n2→n4", "n3→n4", "n4→n1", "n4→n2", "n4→n3"]
    t1 = {"intraprocess": intraprocess, "shm": shm, "udpv4": network}
    t2 = {"intraprocess": ["n1→n2"], "shm": ["n1→n3"], "udpv4": ["n1→n4"]}
    assert data_layer_graph(example(ARTICLE)) == between("/t1", t1) | between("/t2", t2)


PLACEMENTS: list[Placement] = [
    ARTICLE,
    dict.fromkeys(ARTICLE, ("m1", "p1")),
    {key: ("m1", key) for key in ARTICLE},
    {key: ("m1" if key < "n3" else "m2", key) for key in ARTICLE},
]


def test_the_example_placed_otherwise_is_the_same_computational_graph():
    plans = [example(each) for each in PLACEMENTS]
    assert all(computational_graph(each) == computational_graph(plans[0]) for each in plans)
    pairs = [set(data_layer_graph(each)) for each in plans]
    assert all(each == pairs[0] for each in pairs)


def test_the_example_placed_otherwise_is_another_data_layer_graph():
    graphs = [data_layer_graph(example(each)) for each in PLACEMENTS]
    assert all(one != other for one, other in itertools.combinations(graphs, 2))
    assert [set(each.values()) for each in graphs] == [
        {"intraprocess", "shm", "udpv4"},
        {"intraprocess"},
        {"intraprocess", "shm"},
        {"intraprocess", "shm", "udpv4"},
    ]


def test_a_node_is_neither_a_process_nor_forced_to_share_one():
    processes = {each.name: each.nodes for each in example(ARTICLE).processes}
    assert processes == {"p1": ("n1", "n2"), "p2": ("n3",), "p3": ("n4",)}


def test_the_negotiator_says_the_same_of_nodes_that_report_themselves():
    plan = example(ARTICLE)
    hosts = Hosts.of(plan)
    parties = [
        party_of(configured(plan, each.key), hosts.host(each.machine), planned=each)
        for each in plan.nodes
    ]
    graph = negotiate(parties, wishes_of(plan.flows), terms_of(plan))
    assert media(graph) == data_layer_graph(plan)


def media(graph: DataLayerGraph) -> dict[tuple[str, str, str], str]:
    assert graph.problems == ()
    return {(each.topic, each.publisher, each.subscription): each.medium for each in graph.flows}


def configured(plan: Plan, key: str, **changes: object) -> NodeConfiguration:
    """What a node of the plan says of itself through its configuration interface."""
    node = plan.node(key)
    return configuration(
        node.full_name,
        *(
            reported(each.kind, each.name, each.type, resolved=each.resolved)
            for each in node.endpoints
        ),
        **{
            "identity": Identity(
                machine_id=node.machine, process_id=sum(node.process.encode()), node_id=f"{key}@1"
            ),
            "connected": False,
            "transports": ("shm", "tcpv4", "udpm", "udpv4", "udpv6"),
            "checksum": "0",
            **changes,
        },
    )


# --- Statically Configured Nodes: declarative instructions

INSTRUCTIONS = """
manifest_version: 1
system: instructions
policy: {unpublished: ignore, unheard: ignore}
nodes:
  n:
    run: {python: "pkg:N"}
    interface:
      subscriptions:
        - {name: /foo, type: std_msgs/msg/String}
        - {name: /bar, type: std_msgs/msg/Empty}
      publishers:
        - {name: /answer, type: std_msgs/msg/String}
    connections:
      data:
        urls: ["udpm://225.82.79.83:11311/"]
        map: {subscriptions: [/foo, /bar]}
      out:
        urls: ["tcpv4://127.0.0.1:5100/"]
        map: {publishers: [/answer]}
"""


@pytest.fixture
def instructed(tmp_path: Path) -> Plan:
    path = tmp_path / "instructions.lifecycle.yaml"
    path.write_text(INSTRUCTIONS, encoding="utf-8")
    loaded = load(path, environment={})
    return build_plan(loaded.manifest, environment={})


def test_connect_to_topic_of_type_via_protocol_address_port_is_said_in_a_manifest(instructed: Plan):
    told = planned_instructions(instructed.node("n"))
    urls = dict(told.connections)
    said = {
        (each.resolved, each.type, *urls[connection].urls)
        for each in instructed.node("n").endpoints
        for endpoint, connection in told.mappings
        if endpoint == f"{each.kind.value}/{each.name}"
    }
    assert said == {
        ("/foo", "std_msgs/msg/String", "udpm://225.82.79.83:11311"),
        ("/bar", "std_msgs/msg/Empty", "udpm://225.82.79.83:11311"),
        ("/answer", "std_msgs/msg/String", "tcpv4://127.0.0.1:5100"),
    }


def test_iterating_over_the_instructions_is_connect_to_for_each_url_then_map_to_for_each_endpoint(
    instructed: Plan,
):
    told = steps(planned_instructions(instructed.node("n")), Instructions(node="/n"))
    # Once per connection, whatever is mapped onto it: the name is the handle.
    assert [(each.operation, each.connection, each.endpoint) for each in told] == [
        (Operation.CONNECT_TO, "data", ""),
        (Operation.CONNECT_TO, "out", ""),
        (Operation.MAP_TO, "out", "publishers//answer"),
        (Operation.MAP_TO, "data", "subscriptions//foo"),
        (Operation.MAP_TO, "data", "subscriptions//bar"),
    ]


def test_the_articles_url_is_a_multicast_group_and_a_port():
    url = parse("udpm://225.82.79.83:11311/")
    assert (url.transport, url.address, url.port) == (
        Medium.UDPM,
        "225.82.79.83",
        11311,
    )


# --- who decides: node configurations, a static list, hints


def pair(**rest: object) -> Plan:
    """A publisher and a subscription on two machines."""
    return planned(
        node("p", publisher("t"), machine="m1", **rest),
        node("s", subscription("t"), machine="m2"),
        machines=MACHINES,
    )


def negotiated(plan: Plan, *configurations: NodeConfiguration) -> str:
    """What carries /t from p to s, judged by what the nodes report."""
    hosts = Hosts.of(plan)
    known = {each.name: each for each in configurations}
    parties = [
        party_of(known[each.full_name], hosts.host(each.machine), planned=each)
        for each in plan.nodes
    ]
    return media(negotiate(parties, wishes_of(plan.flows), terms_of(plan)))["/t", "p", "s"]


def hinting(plan: Plan, *, lossy: bool, size_bytes: int) -> NodeConfiguration:
    configuration = configured(plan, "p")
    (endpoint,) = configuration.endpoints
    hinted = replace(endpoint, lossy=lossy, size_bytes=size_bytes)
    return replace(configuration, endpoints=(hinted,))


def test_a_node_hints_that_its_data_do_not_bear_unreliable_transport():
    plan = pair()
    assert negotiated(plan, configured(plan, "p"), configured(plan, "s")) == "udpv4"
    hint = hinting(plan, lossy=False, size_bytes=60_000)
    assert negotiated(plan, hint, configured(plan, "s")) == "tcpv4"


@pytest.mark.parametrize("said", [{"lossy": True}, {"transport": FlowTransport.UDPV4}])
def test_what_the_manifest_says_of_a_flow_overrides_the_nodes_hint(said: dict[str, object]):
    plan = pair(needs=[need(PUB, "t", **said)])
    hint = hinting(plan, lossy=False, size_bytes=60_000)
    assert negotiated(plan, hint, configured(plan, "s")) == "udpv4"


def test_a_link_overrides_the_nodes_hint_for_one_pair():
    system = manifest(
        node("p", publisher("t"), machine="m1"),
        node("s", subscription("t"), machine="m2"),
        links=[link("/t", "p", "s", transport=FlowTransport.UDPV4)],
        machines=MACHINES,
    )
    plan = build_plan(system, environment={})
    hint = hinting(plan, lossy=False, size_bytes=60_000)
    assert negotiated(plan, hint, configured(plan, "s")) == "udpv4"


def test_what_transports_do_you_support_is_answered_and_decides():
    plan = pair()
    hosts = Hosts.of(plan)
    one, other = configured(plan, "p"), configured(plan, "s", transports=("tcpv4",))
    parties = [party_of(one, hosts.host("m1")), party_of(other, hosts.host("m2"))]
    assert [each.transports for each in parties] == [
        ("shm", "tcpv4", "udpm", "udpv4", "udpv6"),
        ("tcpv4",),
    ]
    wish = ("/t", "/p", "/s")
    (problem,) = negotiate(parties, {wish: FlowTransport.UDPV6}, terms_of(plan)).problems
    assert problem.why.message == (
        "cannot carry '/t' from '/p' to '/s' by udpv6, as a link says so: '/p' can be connected "
        "by shm, tcpv4, udpm, udpv4, udpv6; '/s' by tcpv4"
    )
    graph = negotiate(parties, {wish: FlowTransport.TCPV4}, terms_of(plan))
    assert media(graph) == {wish: "tcpv4"}


def test_configurations_captured_statically_and_read_while_running_negotiate_the_same():
    plan = pair(needs=[need(PUB, "t", transport=FlowTransport.TCPV4)])
    hosts = Hosts.of(plan)
    bare = {key: replace(plan.node(key), participants=()) for key in ("p", "s")}
    statically = [party_of_node(each, hosts, rmw=plan.rmw) for each in bare.values()]
    dynamically = [
        party_of(configured(plan, key), hosts.host(each.machine), planned=each)
        for key, each in bare.items()
    ]
    one, other = (negotiate(each, {}, terms_of(plan)) for each in (statically, dynamically))
    assert one == other
    assert one.connections != ()


# --- negotiation systems


def intelligent(**data_layer: object) -> Plan:
    """Two subscribers on the publisher's machine, one on another."""
    heard = [node(key, subscription("t"), machine="m1") for key in ("near", "nearer")]
    return planned(
        node(
            "talker",
            publisher("t"),
            needs=[need(PUB, "t", transport=FlowTransport.MULTICAST)],
            machine="m1",
        ),
        *heard,
        node("far", subscription("t"), machine="m2"),
        machines=MACHINES,
        discovery=Discovery(mode=DiscoveryMode.STATIC, transport=FlowTransport.TCPV4),
        data_layer=DataLayer(**data_layer),
        positions={"data_layer": at(4)},
    )


def test_everybody_who_negotiates_from_the_same_configurations_comes_to_the_same_graph():
    """So no master is needed: each supervisor, or each node, may decide for itself."""
    plan = intelligent(authority=Authority.SUPERVISOR, source=DataLayerSource.DYNAMIC, events=True)
    told = [configured(plan, each.key) for each in plan.nodes]
    outcomes = []
    for order in (told, told[::-1]):
        source = NegotiatedSource(plan)
        outcomes.append((source.instructions({each.name: each for each in order}), source.expected))
    assert outcomes[0] == outcomes[1]
    assert {each.medium for each in outcomes[0][1].flows} == {"udpm", "tcpv4"}
