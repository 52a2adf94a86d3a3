"""Whatever the network does, the state of the graph becomes what is true (property tests)."""

from __future__ import annotations

import random
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from simulated import Reader, System

from lifecycle.graph.model import NodeLiveliness
from lifecycle.manifest.model import EndpointKind
from lifecycle.verify.observation import NodeConfiguration

STATES = ("active", "inactive", "unconfigured")
NAMES = ("/a", "/b")


def assert_true(reader: Reader, system: System) -> None:
    """The state shows every node that runs as it is, and no other as if it lived."""
    for name, node in system.nodes.items():
        view = reader.state.node(name)
        assert view is not None, f"{name} is not known"
        assert view.configuration == node.truth
        assert (view.state, view.connected) == (node.truth.state, True)
        assert view.incarnation == node.reporter.incarnation
        assert view.liveliness is NodeLiveliness.ALIVE
    others = [each for each in reader.state.nodes() if each.name not in system.nodes]
    assert {each.liveliness for each in others} <= {NodeLiveliness.SILENT}
    assert_indexed(reader)


def assert_indexed(reader: Reader) -> None:
    """The index holds exactly the endpoints of the nodes that are shown."""
    there = [
        (each.kind, each.resolved, view.name, each)
        for view in reader.state.nodes()
        for each in view.endpoints
    ]
    places = {(kind, topic) for kind, topic, _, _ in there}
    indexed = [
        (kind, topic, end.node.name, end.endpoint)
        for kind, topic in places
        for end in reader.state.endpoints(kind, topic)
    ]
    assert sorted(there, key=repr) == sorted(indexed, key=repr)
    held = {(kind, name) for kind in EndpointKind for name in reader.events.endpoints.names(kind)}
    assert held == places


def shown(reader: Reader) -> dict[str, tuple[str | None, NodeConfiguration | None]]:
    return {
        each.name: (each.state, each.configuration)
        for each in reader.state.nodes()
        if each.liveliness is NodeLiveliness.ALIVE
    }


def disturb(system: System, operation: str, name: str, number: int) -> None:
    """Let one thing happen."""
    node = system.nodes.get(name)
    if operation == "start":
        system.start(name, endpoints=number)
    elif operation == "kill":
        system.kill(name)
    elif operation == "leave":
        system.leave(name)
    elif operation == "part":
        cut = tuple(each.transport for each in system.nodes.values())
        system.network.partition(cut[number % (len(cut) + 1) :])
    elif operation == "heal":
        system.network.heal()
    elif node is not None:
        {
            "state": lambda: node.change_state(STATES[number % 3]),
            "add": lambda: node.add_endpoint(f"/t{number}"),
            "remove": node.remove_endpoint,
            "connect": lambda: node.connect(f"net{number % 2}"),
            "lose": lambda: node.lose_connection(f"net{number % 2}"),
            "disconnect": lambda: node.disconnect(f"net{number % 2}"),
            "match": lambda: node.match(number),
        }[operation]()


CHANGES = ("match", "state", "connect", "lose", "disconnect", "add", "remove")
COMINGS_AND_GOINGS = ("part", "heal", "leave", "kill", "start")


def happenings(*operations: str) -> st.SearchStrategy[list[tuple[str, str, int, float]]]:
    """What happens, to whom, a number, and how many seconds pass then."""
    one = st.tuples(
        st.sampled_from(operations),
        st.sampled_from(NAMES),
        st.integers(0, 3),
        st.sampled_from([0.3, 0.0, 0.02, 3.0, 9.0]),
    )
    return st.lists(one, min_size=3, max_size=20)


NETWORKS = st.fixed_dictionaries(
    {
        "seed": st.integers(0, 2**16),
        "loss": st.sampled_from([0.3, 0.0, 0.7]),
        "duplication": st.sampled_from([0.0, 0.5]),
        "delay_s": st.sampled_from([0.0, 0.05, 0.5]),
    }
)


def converges(network: dict[str, Any], happens: list[tuple[str, str, int, float]]) -> None:
    system = System(network["seed"])
    system.network.delay_s = (0.0, network["delay_s"])
    reader = Reader(system)
    for name in NAMES:
        system.start(name, endpoints=2)
    system.scheduler.advance(3.0)
    system.network.loss, system.network.duplication = network["loss"], network["duplication"]
    for operation, name, number, then_s in happens:
        disturb(system, operation, name, number)
        system.scheduler.advance(then_s)
    system.calm()
    assert_true(reader, system)


@settings(max_examples=150, deadline=None)
@given(network=NETWORKS, happens=happenings(*COMINGS_AND_GOINGS, *CHANGES))
def test_nodes_that_come_and_go_are_learnt_whatever_the_network_does(
    network: dict[str, Any], happens: list[tuple[str, str, int, float]]
) -> None:
    converges(network, happens)


@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 2**16))
def test_200_nodes_with_2000_endpoints_converge(seed: int) -> None:
    system = System(seed)
    accidents = random.Random(seed)
    network = system.network
    network.loss, network.duplication, network.delay_s = 0.2, 0.2, (0.0, 0.3)
    reader = Reader(system)
    names = [f"/n{number}" for number in range(200)]
    for name in names:
        system.start(name, endpoints=10)
    operations = ("state", "add", "remove", "connect", "lose", "disconnect", "match", "start")
    for _ in range(12):
        for name in accidents.sample(names, 40):
            number = accidents.randrange(10)
            operation = accidents.choice(operations)
            disturb(system, operation, name, 10 if operation == "start" else number)
        system.scheduler.advance(accidents.choice((0.05, 0.5, 2.0)))
        if accidents.random() < 0.3:
            transports = [each.transport for each in system.nodes.values()]
            accidents.shuffle(transports)
            system.network.partition(tuple(transports[:100]))
        elif accidents.random() < 0.4:
            system.network.heal()
    for name in accidents.sample(names, 5):
        system.kill(name)
    for name in accidents.sample(names, 5):
        system.leave(name)
    late = Reader(system)
    system.calm()
    assert sum(len(each.truth.endpoints) for each in system.nodes.values()) > 1800
    assert_true(reader, system)
    assert_true(late, system)
    assert shown(reader) == shown(late)
