"""Side by side with rclpy.lifecycle.LifecycleNode, through the services, pair by pair.

Every (primary state, transition) pair is asked by id and by label; where rcl allows the transition,
with callbacks that return SUCCESS, FAILURE and ERROR, that raise, and with each answer of on_error.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from lifecycle_driver import Driver, Edge
from managed_node import ManagedNode
from rclpy.lifecycle import TransitionCallbackReturn

from lifecycle import LifecycleNode

OWN_LABELS = {"connect", "disconnect"}
_NUMBERS = itertools.count()
PATHS = {
    "unconfigured": (),
    "inactive": ("configure",),
    "active": ("configure", "activate"),
    "finalized": ("shutdown",),
}
ALLOWED = {
    "unconfigured": {"configure": 1, "shutdown": 5},
    "inactive": {"cleanup": 2, "activate": 3, "shutdown": 6},
    "active": {"deactivate": 4, "shutdown": 7},
    "finalized": {},
}
IDS = [*range(10), 10, 11, 12, 20, 30, 31, 40, 50, 60, 61, 62, 99, 255]
LABELS = [
    "create",
    "configure",
    "cleanup",
    "activate",
    "deactivate",
    "shutdown",
    "destroy",
    "transition_success",
    "transition_failure",
    "transition_error",
    "Configure",
    "nonsense",
]
ON_ERROR = ["SUCCESS", "FAILURE", "ERROR", "raise"]


class Scripted:
    """Callbacks that do what the test says."""

    behaviour = "SUCCESS"
    on_error_behaviour = "SUCCESS"

    def act(self, state: Any) -> Any:
        self.called.append((self.behaviour, state.state_id, state.label))
        return perform(self.behaviour)

    on_configure = on_activate = on_deactivate = on_cleanup = on_shutdown = act

    def on_error(self, state: Any) -> Any:
        self.called.append(("on_error", state.state_id, state.label))
        return perform(self.on_error_behaviour)


def perform(behaviour: str) -> Any:
    if behaviour == "raise":
        raise RuntimeError("as the test says")
    return TransitionCallbackReturn.__members__[behaviour]


class Ours(Scripted, LifecycleNode):
    def __init__(self, **options: Any) -> None:
        self.called: list[Any] = []
        super().__init__("ours", **options)


class Theirs(Scripted, ManagedNode):
    def __init__(self, **options: Any) -> None:
        self.called: list[Any] = []
        super().__init__("theirs", **options)


class Pair:
    """Both nodes, brought to the same state and asked the same things."""

    def __init__(self, driver: Driver, context: rclpy.Context) -> None:
        self.driver = driver
        # Each pair has names of its own: the farewell of the last one may still be under way.
        options = {
            "context": context,
            "enable_rosout": False,
            "namespace": f"/pair{next(_NUMBERS)}",
        }
        self.ours, self.theirs = Ours(**options), Theirs(**options)
        self.o = self.ours.get_fully_qualified_name()
        self.t = self.theirs.get_fully_qualified_name()
        driver.add(self.ours)
        driver.add(self.theirs)

    def bring_to(self, state: str) -> None:
        for label in PATHS[state]:
            assert self.driver.set(self.o, label)
            assert self.driver.set(self.t, label)
        self.driver.settle()
        for node in (self.ours, self.theirs):
            node.called.clear()
            self.driver.events[node.get_fully_qualified_name()].clear()

    def behave(self, behaviour: str, on_error: str) -> None:
        for node in (self.ours, self.theirs):
            node.behaviour = behaviour
            node.on_error_behaviour = on_error

    def compare(self, *, id_: int = 0, label: str = "") -> bool:
        """Ask both, compare all that can be seen; returns whether the state is as before."""
        driver = self.driver
        before = driver.state(self.o)
        assert driver.change(self.o, id_=id_, label=label) == driver.change(
            self.t, id_=id_, label=label
        )
        driver.settle()
        assert driver.state(self.o) == driver.state(self.t)
        assert without_own(driver.available(self.o)) == driver.available(self.t)
        assert driver.heard(self.o) == driver.heard(self.t)
        assert self.ours.called == self.theirs.called
        return driver.state(self.o) == before

    def close(self) -> None:
        self.driver.remove(self.ours)
        self.driver.remove(self.theirs)


def without_own(edges: list[Edge]) -> list[Edge]:
    return [edge for edge in edges if edge[1] not in OWN_LABELS]


@pytest.fixture
def pair(driver: Driver, context: rclpy.Context) -> Iterator[Pair]:
    pair = Pair(driver, context)
    yield pair
    pair.close()


@pytest.mark.parametrize("state", PATHS)
def test_a_transition_that_rcl_refuses_changes_nothing_and_leaves_the_node_alive(
    pair: Pair, state: str
) -> None:
    pair.bring_to(state)
    allowed = ALLOWED[state]
    for id_ in IDS:
        if id_ not in allowed.values():
            assert pair.compare(id_=id_), f"id {id_} was taken"
    for label in LABELS:
        if label not in allowed:
            assert pair.compare(label=label), f"label {label} was taken"
    assert pair.driver.heard(pair.o) == []


OUTCOMES = [
    *((behaviour, "SUCCESS") for behaviour in ("SUCCESS", "FAILURE")),
    *itertools.product(("ERROR", "raise"), ON_ERROR),
]


@pytest.mark.parametrize("by", ["id", "label"])
@pytest.mark.parametrize(("behaviour", "on_error"), OUTCOMES)
@pytest.mark.parametrize(
    ("state", "label"), [(state, label) for state, labels in ALLOWED.items() for label in labels]
)
def test_a_transition_that_rcl_takes_ends_the_same_for_every_outcome(
    pair: Pair, state: str, label: str, behaviour: str, on_error: str, by: str
) -> None:
    pair.bring_to(state)
    pair.behave(behaviour, on_error)
    if by == "id":
        pair.compare(id_=ALLOWED[state][label])
    else:
        pair.compare(label=label)
    assert len(pair.driver.heard(pair.o)) >= 2


def test_a_label_wins_over_an_id(pair: Pair) -> None:
    pair.compare(id_=1, label="shutdown")
    assert pair.driver.state(pair.o) == (4, "finalized")


def test_a_wrong_label_wins_over_a_right_id(pair: Pair) -> None:
    assert pair.compare(id_=1, label="nonsense")


def test_states_and_graph_are_rcls_and_the_graph_adds_connect_and_disconnect(pair: Pair) -> None:
    driver = pair.driver
    assert driver.states(pair.o) == driver.states(pair.t)
    assert without_own(driver.graph(pair.o)) == driver.graph(pair.t)
    assert [edge for edge in driver.graph(pair.o) if edge[1] in OWN_LABELS] == [
        (120, "connect", 2, "inactive", 2, "inactive"),
        (121, "disconnect", 2, "inactive", 2, "inactive"),
    ]


def test_names_types_and_qos_of_the_interface_are_rcls(pair: Pair) -> None:
    driver = pair.driver
    offered = {}
    for name in ("ours", "theirs"):
        namespace = pair.ours.get_namespace()
        services = driver.node.get_service_names_and_types_by_node(name, namespace)
        topics = driver.node.get_publisher_names_and_types_by_node(name, namespace)
        offered[name] = {
            (each.replace(f"{namespace}/{name}/", "~/"), tuple(types))
            for each, types in (*services, *topics)
        }
    set_parameters = ("rcl_interfaces/srv/SetParameters",)
    assert offered["ours"] - offered["theirs"] == {
        ("~/get_configuration", ("std_srvs/srv/Trigger",)),
        ("~/connect_to", set_parameters),
        ("~/map_to", set_parameters),
        ("~/disconnect", set_parameters),
        ("~/remap", set_parameters),
        ("/lifecycle/graph", ("std_msgs/msg/String",)),
    }
    assert offered["theirs"] - offered["ours"] == set()
    ours, theirs = (
        driver.node.get_publishers_info_by_topic(f"{name}/transition_event")[0]
        for name in (pair.o, pair.t)
    )
    assert ours.qos_profile == theirs.qos_profile


def test_connect_and_disconnect_work_by_label_and_are_announced(pair: Pair) -> None:
    pair.bring_to("inactive")
    driver = pair.driver
    own = [edge for edge in driver.available(pair.o) if edge[1] in OWN_LABELS]
    assert own == [(120, "connect", 2, "inactive", 2, "inactive")]
    assert driver.set(pair.o, "connect")
    assert driver.state(pair.o) == (2, "inactive")
    own = [edge for edge in driver.available(pair.o) if edge[1] in OWN_LABELS]
    assert own == [(121, "disconnect", 2, "inactive", 2, "inactive")]
    assert not driver.change(pair.o, label="connect")
    assert driver.set(pair.o, "disconnect")
    driver.settle()
    assert driver.heard(pair.o) == [
        (120, "connect", "inactive", "inactive"),
        (121, "disconnect", "inactive", "inactive"),
    ]


def test_a_connected_node_goes_on_as_rcls_does(pair: Pair) -> None:
    pair.bring_to("inactive")
    assert pair.driver.set(pair.o, "connect")
    pair.driver.settle()
    pair.driver.events[pair.o].clear()
    for label in ("activate", "deactivate", "activate", "deactivate", "cleanup", "shutdown"):
        pair.compare(label=label)
