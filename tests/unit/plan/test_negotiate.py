"""Negotiation: what carries each pair and why, and which connections that takes."""

from __future__ import annotations

import dataclasses
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lifecycle.manifest.model import EndpointKind, FlowTransport
from lifecycle.network.connection_url import Peer, parse
from lifecycle.network.medium import CONNECTABLE, RMW_DEFAULT
from lifecycle.plan.connections.hosts import Contact
from lifecycle.plan.negotiation.data_layer import DataLayerGraph, Party, PartyEndpoint, Terms
from lifecycle.plan.negotiation.negotiate import negotiate
from lifecycle.plan.negotiation.parties import transports_of

STRING = "std_msgs/msg/String"
HERE, THERE = "10.77.0.1", "10.77.0.2"
Wish = FlowTransport


def pub(topic: str = "/t", **rest: object) -> PartyEndpoint:
    """One publisher."""
    return PartyEndpoint(
        kind=EndpointKind.PUBLISHER, name=topic[1:], resolved=topic, type=STRING, **rest
    )


def sub(topic: str = "/t", **rest: object) -> PartyEndpoint:
    """One subscription."""
    return PartyEndpoint(
        kind=EndpointKind.SUBSCRIPTION, name=topic[1:], resolved=topic, type=STRING, **rest
    )


def party(key: str, *endpoints: PartyEndpoint, host: str = HERE, **rest: object) -> Party:
    """One node in a process of its own."""
    return Party(
        key=key,
        full_name=f"/{key}",
        host=host,
        process=str(rest.pop("process", key)),
        endpoints=endpoints,
        **rest,
    )


def media(graph: DataLayerGraph) -> dict[str, tuple[str, str]]:
    """What carries the data to each subscribing node, and why."""
    assert graph.problems == ()
    return {each.subscription: (each.medium, each.reason) for each in graph.flows}


def urls(graph: DataLayerGraph) -> dict[str, tuple[str, ...]]:
    """Each connection's URLs, `node name`."""
    return {f"{each.node} {each.name}": each.urls for each in graph.connections}


def problem(graph: DataLayerGraph) -> str:
    """The only problem, with its hint."""
    (only,) = graph.problems
    return f"{only.message}; {only.hint}" if only.hint else only.message


def test_what_own_participants_do_anyway_needs_no_connection():
    graph = negotiate(
        [
            party("p", pub()),
            party("inside", sub(), process="p"),
            party("near", sub()),
            party("far", sub(), host=THERE),
        ],
        {},
        Terms(),
    )
    assert media(graph) == {
        "inside": ("intraprocess", "same process"),
        "near": ("shm", "same host"),
        "far": ("udpv4", "other host"),
    }
    assert graph.connections == ()


def test_a_publisher_can_ask_for_udp_on_its_own_host():
    graph = negotiate([party("p", pub(transport=Wish.UDPV4)), party("s", sub())], {}, Terms())
    assert media(graph) == {"s": ("udpv4", "the publisher asks for it")}
    assert urls(graph) == {"p udpv4": ("udpv4://",)}


def test_a_link_overrides_what_the_publisher_asks_for():
    graph = negotiate(
        [party("p", pub(transport=Wish.UDPV4)), party("s", sub())],
        {("/t", "p", "s"): Wish.TCPV4},
        Terms(),
    )
    assert media(graph) == {"s": ("tcpv4", "a link says so")}
    assert urls(graph) == {
        "p tcpv4": (f"tcpv4://{HERE}:7910",),
        "s tcpv4": (f"tcpv4://{HERE}:7911?peer={HERE}:7910",),
    }


def test_a_subscription_can_ask_where_nobody_else_does():
    graph = negotiate([party("p", pub()), party("s", sub(transport=Wish.NETWORK))], {}, Terms())
    assert media(graph) == {"s": ("udpv4", "the subscription asks for it")}
    assert urls(graph) == {"p udpv4": ("udpv4://",)}


def test_both_ends_must_ask_for_the_same():
    graph = negotiate(
        [party("p", pub(transport=Wish.SHM)), party("s", sub(transport=Wish.TCPV4))], {}, Terms()
    )
    assert problem(graph) == (
        "cannot carry '/t' from 'p' to 's': the publisher asks for shm, the subscription for tcpv4;"
        " ask for the same at both ends, or let a link decide with 'transport:'"
    )


def test_one_datagram_goes_to_all_subscriptions_of_the_host_and_tcp_to_the_others():
    graph = negotiate(
        [
            party("p", pub(transport=Wish.MULTICAST)),
            party("near", sub()),
            party("near2", sub()),
            party("inside", sub(), process="p"),
            party("far", sub(), host=THERE),
        ],
        {},
        Terms(
            observers=(Contact(host=THERE, transport="tcpv4", peer=Peer(address=THERE, port=1)),)
        ),
    )
    assert media(graph) == {
        "near": ("udpm", "the publisher asks for it"),
        "near2": ("udpm", "the publisher asks for it"),
        "inside": ("intraprocess", "same process"),
        "far": ("tcpv4", "multicast stays on its host"),
    }
    group = "udpm://239.255.1.1:8910?ttl=0&interface=127.0.0.1"
    assert urls(graph) == {
        "p udpm_tcpv4_t": (group, f"tcpv4://{HERE}:7910?peer={THERE}:1"),
        "near udpm_t": (group,),
        "near2 udpm_t": (group,),
        "far tcpv4": (f"tcpv4://{THERE}:7910?peer={HERE}:7910&peer={THERE}:1",),
    }


def test_each_topic_that_goes_by_multicast_has_a_group_and_a_port_of_its_own():
    multicast = Wish.MULTICAST
    graph = negotiate(
        [
            party("p", pub("/a", transport=multicast), pub("/b", transport=multicast)),
            party("s", sub("/a"), sub("/b")),
        ],
        {},
        Terms(multicast_group="239.255.9.1", first_port=9000),
    )
    first = "udpm://239.255.9.1:10000?ttl=0&interface=127.0.0.1"
    second = "udpm://239.255.9.2:10001?ttl=0&interface=127.0.0.1"
    assert urls(graph) == {
        "p udpm_a": (first,),
        "p udpm_b": (second,),
        "s udpm_a": (first,),
        "s udpm_b": (second,),
    }


def test_many_listeners_without_shared_memory_share_one_datagram():
    none = tuple(each for each in CONNECTABLE if each != "shm")
    graph = negotiate(
        [
            party("p", pub(), own=("udpv6",)),
            party("a", sub(), own=("udpv4",), transports=none),
            party("b", sub(), own=("udpv4",), transports=none),
        ],
        {},
        Terms(),
    )
    reason = "2 processes of the host listen, and not by shared memory"
    assert media(graph) == {"a": ("udpm", reason), "b": ("udpm", reason)}


def test_what_must_arrive_and_is_larger_than_a_datagram_goes_by_tcp_to_other_hosts():
    parties = [
        party("p", pub(lossy=False, size_bytes=40_000)),
        party("near", sub()),
        party("far", sub(), host=THERE),
    ]
    assert media(negotiate(parties, {}, Terms())) == {
        "near": ("shm", "same host"),
        "far": ("tcpv4", "not lossy, and 40000 bytes are more than one datagram"),
    }


@pytest.mark.parametrize(
    ("lossy", "size"), [(None, 40_000), (True, 40_000), (False, 1000), (False, None)]
)
def test_otherwise_udp_does_for_other_hosts(lossy: bool | None, size: int | None):
    parties = [party("p", pub(lossy=lossy, size_bytes=size)), party("far", sub(), host=THERE)]
    assert media(negotiate(parties, {}, Terms())) == {"far": ("udpv4", "other host")}


def test_a_subscription_can_deny_that_its_data_bear_loss():
    parties = [
        party("p", pub(lossy=True, size_bytes=40_000)),
        party("far", sub(lossy=False), host=THERE),
    ]
    assert media(negotiate(parties, {}, Terms()))["far"][0] == "tcpv4"


def test_ipv6_hosts_talk_by_ipv6():
    v6 = ("udpv6", "tcpv4")
    graph = negotiate(
        [
            party("p", pub(), host="fd77::1", own=("shm",)),
            party("s", sub(), host="fd77::2", own=v6),
        ],
        {},
        Terms(),
    )
    assert media(graph) == {"s": ("udpv6", "other host, and no UDP over IPv4 between")}
    assert urls(graph) == {"p udpv6": ("udpv6://[fd77::1]",)}


def test_nothing_in_common_names_what_each_end_can():
    graph = negotiate(
        [
            party("p", pub(), own=("udpv4",), transports=("udpv4", "shm")),
            party("s", sub(), host=THERE, own=("tcpv4",), transports=("tcpv4",)),
        ],
        {},
        Terms(),
    )
    assert problem(graph) == (
        "cannot carry '/t' from 'p' to 's': 'p' can be connected by udpv4, shm; 's' by tcpv4; "
        "they are on different hosts, where shared memory is none"
    )
    assert graph.flows == ()


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"serializations": ("xcdr2",)},
            (
                "cannot carry '/t' from 'p' to 's': no wire format is common; 'p' has cdr; 's' has "
                "xcdr2"
            ),
        ),
        (
            {"paradigms": ("request-response",)},
            (
                "cannot carry '/t' from 'p' to 's': no communication paradigm is common; 'p' has "
                "publish-subscribe, request-response; 's' has request-response"
            ),
        ),
    ],
)
def test_without_common_ground_no_transport_helps(changes: dict[str, tuple[str, ...]], text: str):
    parties = [party("p", pub()), party("s", sub(), **changes)]
    assert problem(negotiate(parties, {}, Terms())) == text
    expected = problem(negotiate(parties, {("/t", "p", "s"): Wish.UDPV4}, Terms()))
    assert expected == text


def test_inside_a_process_nothing_can_be_chosen():
    parties = [party("p", pub()), party("s", sub(), process="p")]
    graph = negotiate(parties, {("/t", "p", "s"): Wish.UDPV4}, Terms())
    assert problem(graph) == (
        "cannot carry '/t' from 'p' to 's' by udpv4: both are in process 'p', and inside a process "
        "no transport is used; give one of the two another 'process:'"
    )


def test_a_connection_has_by_what_those_on_their_own_participant_discover_it():
    """Beside another transport, Fast DDS announces nothing by shared memory."""
    parties = [party("p", pub()), party("near", sub()), party("far", sub())]
    graph = negotiate(parties, {("/t", "p", "far"): Wish.TCPV4}, Terms())
    assert {key: medium for key, (medium, _) in media(graph).items()} == {
        "near": "shm",
        "far": "tcpv4",
    }
    assert list(urls(graph)) == ["far tcpv4", "p shm_udpv4_tcpv4"]


def test_shared_memory_alone_is_joined_by_shared_memory_alone():
    parties = [party("p", pub(by=("shm",), fixed=True)), party("s", sub())]
    assert urls(negotiate(parties, {}, Terms())) == {"s shm": ("shm://",)}


def test_shared_memory_wins_against_what_one_link_asks_for():
    graph = negotiate(
        [party("p", pub()), party("q", pub()), party("s", sub(fixed=True)), party("r", sub())],
        {("/t", "p", "s"): Wish.TCPV4},
        Terms(),
    )
    assert problem(graph) == (
        "cannot carry '/t' from 'p' to 's' by tcpv4, as a link says so: the publisher's "
        "participant has shm, tcpv4, udpv4, the subscription's shm, udpv4, so it would go by shm; "
        "ask for one transport for all that these two endpoints talk to"
    )


def test_a_node_that_makes_its_own_participants_is_met_by_the_other_end():
    graph = negotiate(
        [party("p", pub(), connectable=False), party("s", sub(transport=Wish.NETWORK))], {}, Terms()
    )
    assert urls(graph) == {"s udpv4": ("udpv4://",)}


def test_where_ports_are_fixed_connections_have_all_of_theirs_and_look_for_each_other():
    graph = negotiate(
        [
            party("p", pub(), own=("shm",)),
            party("s", sub(), own=("shm",)),
        ],
        {("/t", "p", "s"): Wish.UDPV4},
        Terms(fixed=True, taken=((HERE, (7911,)),)),
    )
    assert urls(graph) == {
        "p udpv4": (f"udpv4://{HERE}:7912?metatraffic_port=7910&output_port=7913&multicast=off",),
        "s udpv4": (
            (
                f"udpv4://{HERE}:7915?metatraffic_port=7914&output_port=7916&peer={HERE}:7910"
                "&multicast=off"
            ),
        ),
    }


def test_a_connection_is_a_client_of_the_discovery_server():
    server = Peer(address="10.77.0.3", port=42100)
    graph = negotiate(
        [party("p", pub(), own=("tcpv4",)), party("s", sub(), own=("tcpv4",))],
        {("/t", "p", "s"): Wish.SHM},
        Terms(server=server),
    )
    assert urls(graph) == {
        "p shm": ("shm://", "tcpv4://?server=10.77.0.3:42100"),
        "s shm": ("shm://", "tcpv4://?server=10.77.0.3:42100"),
    }


def test_publishers_that_are_told_apart_stay_apart():
    wish = Wish.UDPV4
    graph = negotiate(
        [
            party(
                "p",
                pub("/a", transport=wish, alone=True, group="_p_flow_0"),
                pub("/b", transport=wish, group="_p_flow_1"),
                pub("/c", transport=wish, group="_p_flow_1"),
                pub("/d", transport=wish),
            ),
            party("s", *(sub(topic) for topic in ("/a", "/b", "/c", "/d"))),
        ],
        {},
        Terms(),
    )
    assert {each.name: each.map for each in graph.connections} == {
        "udpv4": ("publishers/d",),
        "udpv4_p_flow_0_publishers_a": ("publishers/a",),
        "udpv4_p_flow_1": ("publishers/b", "publishers/c"),
    }


def test_a_new_subscriber_changes_nothing_for_those_that_are_there():
    parties = [
        party("p", pub(transport=Wish.MULTICAST)),
        party("near", sub()),
        party("far", sub(), host=THERE),
    ]
    before = negotiate(parties, {}, Terms())
    after = negotiate([*parties, party("a_new", sub(), host=THERE)], {}, Terms(), before=before)
    (new,) = {*after.connections} - {*before.connections}
    assert {*before.connections} < {*after.connections}
    assert (new.node, new.name, new.map) == ("a_new", "tcpv4", ("subscriptions/t",))
    assert new.urls == (f"tcpv4://{THERE}:7911?peer={HERE}:7910",)


def _endpoints(draw: random.Random) -> tuple[PartyEndpoint, ...]:
    ends = [(make, topic) for make in (pub, sub) for topic in ("/a", "/b")]
    return tuple(
        make(
            topic,
            transport=draw.choice([*FlowTransport, *[FlowTransport.ANY] * 7]),
            lossy=draw.choice((None, None, True, False)),
            size_bytes=draw.choice((None, 100, 100_000)),
            alone=make is pub and draw.random() < 0.2,
        )
        for make, topic in draw.sample(ends, draw.randint(0, 3))
    )


def _system(seed: int) -> tuple[list[Party], dict[tuple[str, str, str], Wish], Terms]:
    """A system out of a number: drawing each of its parts would take longer than negotiating."""
    draw = random.Random(seed)
    parties = []
    for key in draw.sample("abcdef", draw.randint(0, 5)):
        own = draw.choice((RMW_DEFAULT, ("shm",), ("udpv4",), ("tcpv4",), ("udpv6",)))
        able = draw.choice((CONNECTABLE, draw.sample(CONNECTABLE, draw.randint(0, 4))))
        parties.append(
            party(
                key,
                *_endpoints(draw),
                host=draw.choice((HERE, HERE, THERE, "fd77::3")),
                process=draw.choice(("one", key)),
                own=own,
                transports=tuple(sorted({*able, *own})),
                connectable=draw.random() < 0.8,
            )
        )
    wishes = {
        (draw.choice(("/a", "/b")), draw.choice("abcdef"), draw.choice("abcdef")): draw.choice(
            list(FlowTransport)
        )
        for _ in range(draw.randint(0, 3))
    }
    return parties, wishes, Terms(fixed=draw.random() < 0.5)


_SYSTEMS = st.integers(0, 2**32).map(_system)


@settings(max_examples=300, deadline=None)
@given(_SYSTEMS, st.randoms(use_true_random=False))
def test_any_order_of_parties_gives_the_same_graph(system: tuple, order: random.Random):
    parties, wishes, terms = system
    graph = negotiate(parties, wishes, terms)
    shuffled = [
        dataclasses.replace(
            each, endpoints=tuple(order.sample(each.endpoints, len(each.endpoints)))
        )
        for each in order.sample(parties, len(parties))
    ]
    assert negotiate(shuffled, wishes, terms) == graph
    assert negotiate(parties, wishes, terms, before=graph) == graph


@settings(max_examples=300, deadline=None)
@given(_SYSTEMS)
def test_every_pair_gets_a_medium_that_both_ends_support_or_a_problem(system: tuple):
    parties, wishes, terms = system
    graph = negotiate(parties, wishes, terms)
    known = {each.key: each for each in parties}
    pairs = {
        (each.resolved, one.key, other.key)
        for one in parties
        for each in one.endpoints
        if each.kind is EndpointKind.PUBLISHER
        for other in parties
        for end in other.endpoints
        if end.kind is EndpointKind.SUBSCRIPTION and end.resolved == each.resolved
    }
    carried = {(each.topic, each.publisher, each.subscription): each for each in graph.flows}
    refused = {(each.topic, each.publisher, each.subscription) for each in graph.problems}
    assert {*carried} | refused == pairs
    placed = {
        (each.node, label): transports_of(each.urls)
        for each in graph.connections
        for label in each.map
    }
    for (topic, one, other), flow in carried.items():
        if (topic, one, other) in refused or flow.medium in ("intraprocess", ""):
            continue
        for key, kind in ((one, "publishers"), (other, "subscriptions")):
            connected = placed.get((key, f"{kind}/{topic[1:]}"))
            has = {each.partition("@")[0] for each in connected or known[key].own}
            assert flow.medium in has or {flow.medium, *has} >= {"udpv4", "udpm"}
            assert connected is None or known[key].connectable
        if known[one].host != known[other].host:
            assert flow.medium not in ("shm", "udpm")
    for each in graph.connections:
        assert each.map
        assert all(str(parse(url)) == url for url in each.urls)


@settings(max_examples=200, deadline=None)
@given(_SYSTEMS)
def test_no_two_connections_of_a_host_are_given_one_port(system: tuple):
    parties, wishes, terms = system
    hosts = {each.key: each.host for each in parties}
    taken: dict[tuple[str, int], str] = {}
    for each in negotiate(parties, wishes, terms).connections:
        for url in map(parse, each.urls):
            own = (None if url.transport.value == "udpm" else url.port, url.metatraffic_port)
            for port in (*own, url.output_port):
                if port is not None:
                    place = (hosts[each.node], port)
                    assert taken.setdefault(place, f"{each.node} {each.name} {url}") == (
                        f"{each.node} {each.name} {url}"
                    )
