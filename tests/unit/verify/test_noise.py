"""What belongs to tools and client libraries, and what makes an action."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind
from lifecycle.verify.observation import ObservedEndpoint
from lifecycle.verify.tool_filter import (
    DeclaredNames,
    action_part,
    fold_actions,
    is_noise_endpoint,
    our_nodes,
    tolerating_pattern,
)
from tests.builders import endpoint, node, planned, publisher, subscription

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
SERVER, CLIENT = EndpointKind.SERVICE_SERVER, EndpointKind.SERVICE_CLIENT
ACTION_SERVER, ACTION_CLIENT = EndpointKind.ACTION_SERVER, EndpointKind.ACTION_CLIENT

SERVER_PARTS = (
    (SERVER, "send_goal", "robot/action/Dock_SendGoal"),
    (SERVER, "cancel_goal", "action_msgs/srv/CancelGoal"),
    (SERVER, "get_result", "robot/action/Dock_GetResult"),
    (PUB, "feedback", "robot/action/Dock_FeedbackMessage"),
    (PUB, "status", "action_msgs/msg/GoalStatusArray"),
)


def parts(node: str = "/base", action: str = "/dock") -> list[ObservedEndpoint]:
    return [
        ObservedEndpoint(kind=kind, node=node, name=f"{action}/_action/{part}", type=type_)
        for kind, part, type_ in SERVER_PARTS
    ]


@pytest.mark.parametrize(
    "name",
    [
        "/_ros2cli_12",
        "/_ros2cli_daemon_0_abc",
        "/launch_ros_77",
        "/rqt_gui_py_node_1",
        "/rviz",
        "/rviz2",
        "/rviz_17",
        "/robot/transform_listener_impl_55aa",
        "/rosbag2_recorder",
        "/_lifecycle_observer_1",
    ],
)
def test_a_tool_is_noise(name: str):
    assert tolerating_pattern(name)


@pytest.mark.parametrize(
    "name", ["/camera", "/rviz_less/camera", "/robot/rqtish", "/launch", "/_camera_flow_0"]
)
def test_a_node_of_a_system_is_not_noise(name: str):
    assert not tolerating_pattern(name)


STRING = "std_msgs/msg/String"
SET_PARAMETERS = "rcl_interfaces/srv/SetParameters"
TRIGGER = "std_srvs/srv/Trigger"
GET_PARAMETERS = "rcl_interfaces/srv/GetParameters"
EVENT = "rcl_interfaces/msg/ParameterEvent"
TRANSITION = "lifecycle_msgs/msg/TransitionEvent"
LOAD_NODE = "composition_interfaces/srv/LoadNode"


@pytest.mark.parametrize(
    ("kind", "node", "name", "type_"),
    [
        (PUB, "/a", "/rosout", "rcl_interfaces/msg/Log"),
        (PUB, "/a", "/parameter_events", EVENT),
        (SUB, "/a", "/parameter_events", EVENT),
        (SUB, "/a", "/clock", "rosgraph_msgs/msg/Clock"),
        (PUB, "/ns/a", "/ns/a/transition_event", TRANSITION),
        (SUB, "/b", "/ns/a/transition_event", TRANSITION),
        (SERVER, "/ns/a", "/ns/a/get_parameters", GET_PARAMETERS),
        (SERVER, "/ns/a", "/ns/a/get_configuration", TRIGGER),
        (SERVER, "/ns/a", "/ns/a/map_to", SET_PARAMETERS),
        (PUB, "/ns/a", "/lifecycle/graph", STRING),
        (SUB, "/b", "/lifecycle/graph", STRING),
        (CLIENT, "/b", "/ns/a/change_state", "lifecycle_msgs/srv/ChangeState"),
        (SERVER, "/ns/a", "/ns/a/_container/load_node", LOAD_NODE),
        (CLIENT, "/b", "/ns/a/_container/load_node", LOAD_NODE),
        (PUB, "/a", "/reset/_service_event", "std_srvs/srv/Trigger_Event"),
    ],
)
def test_an_endpoint_of_a_client_library_is_noise(
    kind: EndpointKind, node: str, name: str, type_: str
):
    assert is_noise_endpoint(kind, node, name, type_, ours=True)


@pytest.mark.parametrize(
    ("kind", "node", "name", "type_"),
    [
        (SUB, "/a", "/rosout", STRING),  # a log viewer: somebody wrote that on purpose
        (PUB, "/a", "/clock", STRING),  # a simulator's main output
        (SERVER, "/a", "/b/get_parameters", GET_PARAMETERS),  # offered under another node's name
        (PUB, "/a", "/b/transition_event", TRANSITION),
        (PUB, "/a", "/a/transition_event", STRING),  # only the names are the library's
        (SUB, "/b", "/a/transition_event", STRING),
        (PUB, "/a", "/rosout", STRING),
        (SUB, "/a", "/clock", STRING),
        (PUB, "/a", "/reset/_service_event", STRING),
        (SUB, "/a", "/reset/_service_event", "std_srvs/srv/Trigger_Event"),
        (PUB, "", "/lifecycle/graph", STRING),  # the first sign of a node that nobody knows
        (SERVER, "/a", "/a/get_map", STRING),
        (SERVER, "/a", "/b/_container/load_node", LOAD_NODE),
        (SERVER, "/a", "/a/_container/load_node", STRING),
        (PUB, "/a", "/a/get_parameters", GET_PARAMETERS),
        (SERVER, "/a", "/a/get_parameters", TRIGGER),  # only the name is the library's
        (SERVER, "/a", "/a/disconnect", TRIGGER),
        (CLIENT, "/b", "/a/disconnect", TRIGGER),
    ],
)
def test_an_endpoint_that_somebody_made_is_not_noise(
    kind: EndpointKind, node: str, name: str, type_: str
):
    assert not is_noise_endpoint(kind, node, name, type_, ours=True)


@pytest.mark.parametrize("base", ["connect_to", "map_to", "disconnect", "remap"])
def test_a_service_of_the_node_interface_is_noise_on_a_node_of_ours_alone(base: str):
    service = (SERVER, "/a", f"/a/{base}", SET_PARAMETERS)
    assert is_noise_endpoint(*service, ours=True)
    assert not is_noise_endpoint(*service, ours=False)


def server(name: str, type_: str, node: str = "/a") -> ObservedEndpoint:
    return ObservedEndpoint(kind=SERVER, node=node, name=name, type=type_)


def test_a_node_is_ours_by_two_services_that_nobody_else_has_together():
    ours = [server("/a/get_configuration", TRIGGER), server("/a/map_to", SET_PARAMETERS)]
    assert our_nodes(ours) == {"/a"}
    assert our_nodes(ours[:1]) == our_nodes(ours[1:]) == frozenset()
    assert our_nodes([ours[0], server("/a/map_to", TRIGGER)]) == frozenset()
    assert our_nodes([ours[0], server("/b/map_to", SET_PARAMETERS, "/a")]) == frozenset()


@pytest.mark.parametrize(
    ("kind", "name", "expected"),
    [
        (SERVER, "/dock/_action/send_goal", (ACTION_SERVER, "/dock")),
        (PUB, "/ns/dock/_action/feedback", (ACTION_SERVER, "/ns/dock")),
        (PUB, "/a/_action/dock/_action/feedback", (ACTION_SERVER, "/a/_action/dock")),
        (CLIENT, "/dock/_action/get_result", (ACTION_CLIENT, "/dock")),
        (SUB, "/dock/_action/status", (ACTION_CLIENT, "/dock")),
        (SUB, "/dock/_action/send_goal", None),
        (SERVER, "/dock/_action/else", None),
        (SERVER, "/_action/send_goal", None),
        (SERVER, "/dock/send_goal", None),
    ],
)
def test_a_hidden_name_tells_which_action_it_is_part_of(kind, name, expected):
    assert action_part(kind, name) == expected


def test_the_five_parts_of_an_action_server_fold_into_one_endpoint():
    other = ObservedEndpoint(kind=PUB, node="/base", name="/odom", type="nav_msgs/msg/Odometry")
    assert fold_actions([*parts(), other]) == (
        other,
        ObservedEndpoint(kind=ACTION_SERVER, node="/base", name="/dock", type="robot/action/Dock"),
    )


def test_an_action_has_the_hashes_of_its_goal_result_and_feedback():
    told = {"send_goal": "g1 g2", "get_result": "r1 r2", "feedback": "f", "status": "s"}
    some = [
        replace(part, type_hash=told.get(part.name.rpartition("/")[2], "c1 c2")) for part in parts()
    ]
    (action,) = fold_actions(some)
    assert action.type_hash == "g1 g2 r1 r2 f"
    unseen = [replace(some[0], type_hash=None), *some[1:]]
    assert fold_actions(unseen)[0].type_hash is None
    unannounced = [replace(some[0], type_hash=""), *some[1:]]
    assert fold_actions(unannounced)[0].type_hash == ""


def test_an_action_is_found_by_the_guid_and_address_of_its_goal_service():
    goals, *others = parts()
    (action,) = fold_actions([replace(goals, gid="0a", address="10.0.0.1"), *others])
    assert (action.gid, action.address) == ("0a", "10.0.0.1")


@pytest.mark.parametrize("missing", range(5))
def test_an_incomplete_action_stays_in_parts(missing: int):
    some = [part for index, part in enumerate(parts()) if index != missing]
    assert fold_actions(some) == tuple(some)


def test_parts_of_two_nodes_do_not_make_one_action():
    mixed = [*parts("/one")[:3], *parts("/two")[3:]]
    assert sorted(fold_actions(mixed), key=str) == sorted(mixed, key=str)


def test_parts_of_another_type_make_no_action_and_stay_beside_one() -> None:
    some = parts()
    wrong = [replace(each, type="std_msgs/msg/String") for each in some[-2:]]
    assert fold_actions([*some[:-2], *wrong]) == (*some[:-2], *wrong)
    goal = replace(some[0], type="z/action/Z_SendGoal")
    for more in (wrong, [goal], [replace(some[-1]) for _ in range(3)]):
        action, *left = fold_actions([*some, *more])
        assert (action.type, left) == ("robot/action/Dock", more)


def test_parts_of_an_action_client_that_is_there_already_are_no_second_one():
    known = ObservedEndpoint(kind=ACTION_CLIENT, node="/ui", name="/dock", type="robot/action/Dock")
    of_client = [replace(each, node="/ui", kind=each.kind.other_end) for each in parts()]
    assert fold_actions([known, *of_client, *parts()]) == (known, *fold_actions(parts()))
    assert fold_actions([*of_client, *of_client]) == (known,)
    assert fold_actions([*parts(), *parts()]) == 2 * fold_actions(parts())


def test_observers_notice_each_other_by_topics_that_are_nobody_elses():
    topic = "/_lifecycle/patrol/robot/alive"
    of_ours = is_noise_endpoint(
        PUB, "/_lifecycle_observer_1", topic, "std_msgs/msg/Empty", ours=False
    )
    of_others = is_noise_endpoint(PUB, "/rviz2", topic, "std_msgs/msg/Empty", ours=False)
    assert (of_ours, of_others) == (True, False)


# --- declared names


def names_declared() -> DeclaredNames:
    """Return them, collected within the test: mutants do not reach what a module holds."""
    return DeclaredNames.of(
        planned(
            node("one", publisher("b"), subscription("a"), endpoint(SERVER, "ask", TRIGGER, None)),
            node(
                "two", endpoint(ACTION_CLIENT, "dock", "robot/action/Dock", None), namespace="/ns"
            ),
        )
    )


@pytest.mark.parametrize(
    ("kinds", "names"),
    [
        ((PUB, SUB), ("/a", "/b")),
        ((SERVER, CLIENT), ("/ask",)),
        ((ACTION_SERVER, ACTION_CLIENT), ("/ns/dock",)),
    ],
)
def test_declared_names_are_known_by_the_kinds_that_meet_under_them(kinds, names) -> None:
    for kind in kinds:
        assert names_declared().of_kind(kind) == names
        assert all(names_declared().has(kind, name) for name in names)
        assert not names_declared().has(kind, "/other")


@pytest.mark.parametrize(
    ("kind", "name", "fed"),
    [
        (PUB, "/a", True),
        (PUB, "/ask", False),
        (SUB, "/a", False),
        (SERVER, "/ask", True),
        (CLIENT, "/ask", False),
        (ACTION_SERVER, "/ns/dock", True),
        (ACTION_CLIENT, "/ns/dock", False),
        (PUB, "/ns/dock/_action/feedback", True),
        (SUB, "/ns/dock/_action/feedback", False),
        (PUB, "/ns/lift/_action/feedback", False),
        (SERVER, "/ns/two/get_state", True),
        (SERVER, "/ns/two/map_to", True),
        (PUB, "/one/transition_event", True),
        (PUB, "/one/get_state", False),
        (SERVER, "/three/get_state", False),
        (PUB, "/rosout", False),
    ],
)
def test_who_offers_a_declared_name_or_a_declared_nodes_own_feeds_the_system(
    kind: EndpointKind, name: str, fed: bool
) -> None:
    assert names_declared().fed_by(kind, name) is fed


def test_what_feeds_the_system_is_left_in_although_it_looks_like_a_client_library() -> None:
    def event(node: str) -> ObservedEndpoint:
        return ObservedEndpoint(
            kind=PUB, node=node, name=f"{node}/transition_event", type=TRANSITION
        )

    own, other = event("/one"), event("/three")
    asked = server("/one/get_parameters", GET_PARAMETERS, "/one")
    names = names_declared()
    assert not any(names.keeps(each, each.node, ours=False) for each in (own, other, asked))
    assert names.keeps(replace(own, node="/rviz2"), "/rviz2", ours=False)


@pytest.mark.parametrize(
    ("name", "patterns", "pattern"),
    [
        ("/far/rviz2", ("rviz2",), "rviz2"),
        ("/far/rviz2", ("/rviz2",), ""),
        ("/far/rviz2", ("/far/*", "rviz2"), "/far/*"),
        ("/far/panel_1", ("panel_?",), "panel_?"),
        ("/far/panel_12", ("panel_?",), ""),
        ("/far/panelx1", ("panel.1",), ""),
        ("/_lifecycle_observer_1", ("_*",), "_lifecycle_*"),
    ],
)
def test_a_tool_is_tolerated_by_the_first_pattern_of_its_name(name, patterns, pattern) -> None:
    assert tolerating_pattern(name, patterns) == pattern
