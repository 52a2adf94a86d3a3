"""Negotiation: what carries each pair and why, and which connections that takes."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, FlowTransport
from lifecycle.network.connection_url import Peer, parse
from lifecycle.network.medium import CONNECTABLE, RMW_DEFAULT
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.discovery import Contact
from lifecycle.plan.media import DataLayerGraph, Party, Terms, transports_of
from lifecycle.plan.model import ParticipantConnections, PlannedEndpoint, PlannedParticipant
from lifecycle.plan.negotiate import negotiate
from tests.builders import at

STRING = "std_msgs/msg/String"
HERE, THERE = "10.77.0.1", "10.77.0.2"
Wish = FlowTransport


def _end(kind: EndpointKind, topic: str, **rest: object) -> PlannedEndpoint:
    return PlannedEndpoint(
        kind=kind, name=topic[1:], resolved=topic, type=STRING, qos=None, at=at(9), **rest
    )


def pub(topic: str = "/t", *, alone: bool = False, **rest: object) -> PlannedEndpoint:
    """One publisher; `alone`: it needs a flow of its own."""
    unique = UniqueRequirement.STRICTLY_REQUIRED if alone else UniqueRequirement.NOT_REQUIRED
    return _end(EndpointKind.PUBLISHER, topic, unique=unique, **rest)


def sub(topic: str = "/t", **rest: object) -> PlannedEndpoint:
    """One subscription."""
    return _end(EndpointKind.SUBSCRIPTION, topic, **rest)


def extra(name: str, connection: str = "", *urls: str) -> PlannedParticipant:
    """One participant beside a node's own; what is on a connection stays there."""
    return PlannedParticipant(
        name=name,
        dscp=None,
        reason="",
        connection=connection,
        connections=ParticipantConnections(urls=urls),
    )


def party(key: str, *endpoints: PlannedEndpoint, host: str = HERE, **rest: object) -> Party:
    """One node in a process of its own."""
    return Party(
        key=key,
        host=host,
        process=str(rest.pop("process", key)),
        endpoints=endpoints,
        **rest,
    )


def media(graph: DataLayerGraph) -> dict[str, tuple[str, str]]:
    """What carries the data to each subscribing node, and why."""
    assert graph.problems == ()
    return {each.subscription: (each.medium, each.medium_reason) for each in graph.flows}


def urls(graph: DataLayerGraph) -> dict[str, tuple[str, ...]]:
    """Each connection's URLs, `node name`."""
    return {f"{each.node} {each.name}": each.urls for each in graph.connections}


NO_SHM = tuple(each for each in CONNECTABLE if each != "shm")
MULTICAST = Wish.MULTICAST
GROUP = "udpm://239.255.1.1:8910?ttl=0&interface=127.0.0.1"
FIRST, SECOND = (
    f"udpm://239.255.9.{number}:{9999 + number}?ttl=0&interface=127.0.0.1" for number in (1, 2)
)
WATCHING = Contact(host=THERE, transport="tcpv4", peer=Peer(address=THERE, port=1))
LISTENERS = "2 processes of the host listen, and not by shared memory"
LARGE = "not lossy, and 40000 bytes are more than one datagram"
SERVED = ("shm://", "tcpv4://?server=10.77.0.3:42100")
TO_S = ("/t", "p", "s")

MADE = {
    "what own participants do anyway needs no connection": (
        [
            party("p", pub()),
            party("inside", sub(), process="p"),
            party("near", sub()),
            party("far", sub(), host=THERE),
        ],
        {},
        Terms(),
        {
            "inside": ("intraprocess", "same process"),
            "near": ("shm", "same host"),
            "far": ("udpv4", "other host"),
        },
        {},
    ),
    "a publisher can ask for UDP on its own host": (
        [party("p", pub(transport=Wish.UDPV4)), party("s", sub())],
        {},
        Terms(),
        {"s": ("udpv4", "the publisher asks for it")},
        {"p udpv4": ("udpv4://",)},
    ),
    "a link overrides what the publisher asks for": (
        [party("p", pub(transport=Wish.UDPV4)), party("s", sub())],
        {TO_S: Wish.TCPV4},
        Terms(),
        {"s": ("tcpv4", "a link says so")},
        {
            "p tcpv4": (f"tcpv4://{HERE}:7910",),
            "s tcpv4": (f"tcpv4://{HERE}:7911?peer={HERE}:7910",),
        },
    ),
    "a subscription can ask where nobody else does": (
        [party("p", pub()), party("s", sub(transport=Wish.NETWORK))],
        {},
        Terms(),
        {"s": ("udpv4", "the subscription asks for it")},
        {"p udpv4": ("udpv4://",)},
    ),
    "one datagram goes to all of the host, and TCP to the others": (
        [
            party("p", pub(transport=MULTICAST)),
            party("near", sub()),
            party("near2", sub()),
            party("inside", sub(), process="p"),
            party("far", sub(), host=THERE),
        ],
        {},
        Terms(
            observers=(Contact(host=THERE, transport="tcpv4", peer=Peer(address=THERE, port=1)),)
        ),
        {
            "near": ("udpm", "the publisher asks for it"),
            "near2": ("udpm", "the publisher asks for it"),
            "inside": ("intraprocess", "same process"),
            "far": ("tcpv4", "multicast stays on its host"),
        },
        {
            "p udpm_tcpv4_t": (GROUP, f"tcpv4://{HERE}:7910?peer={THERE}:1"),
            "near udpm_t": (GROUP,),
            "near2 udpm_t": (GROUP,),
            "far tcpv4": (f"tcpv4://{THERE}:7910?peer={HERE}:7910&peer={THERE}:1",),
        },
    ),
    "each topic that goes by multicast has a group and a port": (
        [
            party("p", pub("/a", transport=MULTICAST), pub("/b", transport=MULTICAST)),
            party("s", sub("/a"), sub("/b")),
        ],
        {},
        Terms(multicast_group="239.255.9.1", first_port=9000),
        {"s": ("udpm", "the publisher asks for it")},
        {"p udpm_a": (FIRST,), "p udpm_b": (SECOND,), "s udpm_a": (FIRST,), "s udpm_b": (SECOND,)},
    ),
    "many listeners without shared memory share one datagram": (
        [
            party("p", pub(), own=("udpv6",)),
            party("a", sub(), own=("udpv4",), transports=NO_SHM),
            party("b", sub(), own=("udpv4",), transports=NO_SHM),
        ],
        {},
        Terms(),
        {"a": ("udpm", LISTENERS), "b": ("udpm", LISTENERS)},
        None,
    ),
    "what must arrive and is large goes by TCP to other hosts": (
        [
            party("p", pub(lossy=False, max_message_size=40_000)),
            party("near", sub()),
            party("far", sub(), host=THERE),
        ],
        {},
        Terms(),
        {"near": ("shm", "same host"), "far": ("tcpv4", LARGE)},
        None,
    ),
    "a subscription can deny that its data bear loss": (
        [
            party("p", pub(lossy=True, max_message_size=40_000)),
            party("far", sub(lossy=False), host=THERE),
        ],
        {},
        Terms(),
        {"far": ("tcpv4", LARGE)},
        None,
    ),
    "IPv6 hosts talk by IPv6": (
        [
            party("p", pub(), host="fd77::1", own=("shm",)),
            party("s", sub(), host="fd77::2", own=("udpv6", "tcpv4")),
        ],
        {},
        Terms(),
        {"s": ("udpv6", "other host, and no UDP over IPv4 between")},
        {"p udpv6": ("udpv6://[fd77::1]",)},
    ),
    "beside another transport Fast DDS announces nothing by shared memory": (
        [party("p", pub()), party("near", sub()), party("far", sub())],
        {("/t", "p", "far"): Wish.TCPV4},
        Terms(),
        {"near": ("shm", "same host"), "far": ("tcpv4", "a link says so")},
        {
            "far tcpv4": (f"tcpv4://{HERE}:7910?peer={HERE}:7911",),
            "p shm_udpv4_tcpv4": ("shm://", "udpv4://", f"tcpv4://{HERE}:7911"),
        },
    ),
    "shared memory alone is joined by shared memory alone": (
        [
            party("p", pub(participant="net"), participants=(extra("net", "net", "shm://"),)),
            party("s", sub()),
        ],
        {},
        Terms(),
        {"s": ("shm", "same host")},
        {"s shm": ("shm://",)},
    ),
    "a node that makes its own participants is met by the other end": (
        [party("p", pub(), connectable=False), party("s", sub(transport=Wish.NETWORK))],
        {},
        Terms(),
        {"s": ("udpv4", "the subscription asks for it")},
        {"s udpv4": ("udpv4://",)},
    ),
    "where ports are fixed connections have all of theirs": (
        [party("p", pub(), own=("shm",)), party("s", sub(), own=("shm",))],
        {TO_S: Wish.UDPV4},
        Terms(fixed=True, taken={HERE: (7911,)}),
        {"s": ("udpv4", "a link says so")},
        {
            "p udpv4": (
                f"udpv4://{HERE}:7912?metatraffic_port=7910&output_port=7913&multicast=off",
            ),
            "s udpv4": (
                (
                    f"udpv4://{HERE}:7915?metatraffic_port=7914&output_port=7916&peer={HERE}:7910"
                    "&multicast=off"
                ),
            ),
        },
    ),
    "a connection is a client of the discovery server": (
        [party("p", pub(), own=("tcpv4",)), party("s", sub(), own=("tcpv4",))],
        {TO_S: Wish.SHM},
        Terms(server=Peer(address="10.77.0.3", port=42100)),
        {"s": ("shm", "a link says so")},
        {"p shm": SERVED, "s shm": SERVED},
    ),
}


@pytest.mark.parametrize("case", MADE)
def test_each_pair_is_carried_by_what_was_asked_for_or_is_there(case: str):
    parties, wishes, terms, carried, connections = MADE[case]
    graph = negotiate(parties, wishes, terms)
    assert media(graph) == carried
    assert connections is None or urls(graph) == connections


@pytest.mark.parametrize(
    ("lossy", "size"), [(None, 40_000), (True, 40_000), (False, 1000), (False, None)]
)
def test_otherwise_udp_does_for_other_hosts(lossy: bool | None, size: int | None):
    parties = [party("p", pub(lossy=lossy, max_message_size=size)), party("far", sub(), host=THERE)]
    assert media(negotiate(parties, {}, Terms())) == {"far": ("udpv4", "other host")}


REFUSED = {
    "both ends must ask for the same": (
        [party("p", pub(transport=Wish.SHM)), party("s", sub(transport=Wish.TCPV4))],
        {},
        (
            "cannot carry '/t' from 'p' to 's': the publisher asks for shm, the subscription for "
            "tcpv4; ask for the same at both ends, or let a link decide with 'transport:'"
        ),
    ),
    "nothing in common": (
        [
            party("p", pub(), own=("udpv4",), transports=("udpv4", "shm")),
            party("s", sub(), host=THERE, own=("tcpv4",), transports=("tcpv4",)),
        ],
        {},
        (
            "cannot carry '/t' from 'p' to 's': 'p' can be connected by udpv4, shm; 's' by tcpv4; "
            "shared memory does not leave a host, and an IP transport needs addresses of its "
            "version: 10.77.0.1 and 10.77.0.2"
        ),
    ),
    "inside a process nothing can be chosen": (
        [party("p", pub()), party("s", sub(), process="p")],
        {TO_S: Wish.UDPV4},
        (
            "cannot carry '/t' from 'p' to 's' by udpv4: both are in process 'p', and inside a "
            "process no transport is used; give one of the two another 'process:'"
        ),
    ),
    "shared memory wins against what one link asks for": (
        [
            party("p", pub()),
            party("q", pub()),
            party("s", sub(participant="net"), participants=(extra("net", "net"),)),
            party("r", sub()),
        ],
        {TO_S: Wish.TCPV4},
        (
            "cannot carry '/t' from 'p' to 's' by tcpv4, as a link says so: the publisher's "
            "participant has shm, tcpv4, udpv4, the subscription's shm, udpv4, so it would go by "
            "shm; ask for one transport for all that these two endpoints talk to"
        ),
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_pair_that_nothing_can_carry_is_one_problem(case: str):
    parties, wishes, text = REFUSED[case]
    (only,) = negotiate(parties, wishes, Terms()).problems
    assert f"{only.why.message}; {only.why.hint}".removesuffix("; ") == text


def test_publishers_that_are_told_apart_stay_apart():
    wish = Wish.UDPV4
    graph = negotiate(
        [
            party(
                "p",
                pub("/a", transport=wish, alone=True, participant="_p_flow_0"),
                pub("/b", transport=wish, participant="_p_flow_1"),
                pub("/c", transport=wish, participant="_p_flow_1"),
                pub("/d", transport=wish),
                participants=(extra("_p_flow_0"), extra("_p_flow_1")),
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


def _endpoints(draw: random.Random) -> tuple[PlannedEndpoint, ...]:
    ends = [(make, topic) for make in (pub, sub) for topic in ("/a", "/b")]
    return tuple(
        make(
            topic,
            transport=draw.choice([*FlowTransport, *[FlowTransport.ANY] * 7]),
            lossy=draw.choice((None, None, True, False)),
            max_message_size=draw.choice((None, 100, 100_000)),
            **({"alone": draw.random() < 0.2} if make is pub else {}),
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
        replace(each, endpoints=tuple(order.sample(each.endpoints, len(each.endpoints))))
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
    refused = {
        (each.flow.topic, each.flow.publisher, each.flow.subscription) for each in graph.problems
    }
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
