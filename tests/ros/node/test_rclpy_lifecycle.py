"""Every promise of rclpy.lifecycle.LifecycleNode, kept by rclpy's class and by ours alike."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable, Iterator
from typing import Any

import lifecycle_msgs.msg
import lifecycle_msgs.srv
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode as RclpyNode
from rclpy.lifecycle import (
    LifecycleState,
    ManagedEntity,
    SimpleManagedEntity,
    TransitionCallbackReturn,
)
from std_msgs.msg import String

from lifecycle import LifecycleNode
from lifecycle.middleware import RCLError

SUCCESS, FAILURE, ERROR = (
    TransitionCallbackReturn.SUCCESS,
    TransitionCallbackReturn.FAILURE,
    TransitionCallbackReturn.ERROR,
)
SERVICES = (
    *("change_state", "get_state", "get_available_states"),
    *("get_available_transitions", "get_transition_graph"),
)
Make = Callable[..., Any]


@pytest.fixture(params=[RclpyNode, LifecycleNode], ids=["rclpy", "ours"])
def base(request: pytest.FixtureRequest) -> type[Any]:
    found: type[Any] = request.param
    return found


@pytest.fixture
def make(context: rclpy.Context, base: type[Any]) -> Iterator[Make]:
    """Construct a node of a class that derives from `base`, or of `base` itself."""
    nodes: list[Any] = []

    def make(methods: dict[str, Any] | None = None, **options: Any) -> Any:
        options.setdefault("enable_communication_interface", False)
        node = type("Its", (base,), methods or {})("it", context=context, **options)
        nodes.append(node)
        return node

    yield make
    for node in nodes:
        node.destroy_node()
        # rclpy's state machine holds the C++ node, and with it the participant.
        vars(node).clear()
    gc.collect()  # a node that could not be constructed


def state(node: Any) -> str:
    label: str = node._state_machine.current_state[1]
    return label


def test_without_a_communication_interface_it_has_no_service(make: Make) -> None:
    node = make()
    assert [each for each in SERVICES if hasattr(node, f"_service_{each}")] == []
    assert [getattr(node._state_machine, f"service_{each}") for each in SERVICES] == [None] * 5
    assert not [each for each, _ in node.get_service_names_and_types() if "state" in each]
    with pytest.raises(TypeError):
        make(enable_communication_interface="asd")
    served = make(enable_communication_interface=True)
    for each in SERVICES:
        assert getattr(served, f"_service_{each}").service_name == f"/it/{each}"
        assert getattr(served._state_machine, f"service_{each}") is not None


def test_transitions_are_triggered_by_call(make: Make) -> None:
    node = make()
    for _ in range(3):
        assert (node.trigger_configure(), state(node)) == (SUCCESS, "inactive")
        assert (node.trigger_activate(), state(node)) == (SUCCESS, "active")
        assert (node.trigger_deactivate(), state(node)) == (SUCCESS, "inactive")
        assert (node.trigger_cleanup(), state(node)) == (SUCCESS, "unconfigured")
    for refused in (node.trigger_activate, node.trigger_deactivate, node.trigger_cleanup):
        with pytest.raises(RCLError):
            refused()
        assert state(node) == "unconfigured"


@pytest.mark.parametrize("before", [(), ("configure",), ("configure", "activate")])
def test_it_is_shut_down_once_from_every_state(make: Make, before: tuple[str, ...]) -> None:
    node = make()
    for each in before:
        getattr(node, f"trigger_{each}")()
    assert (node.trigger_shutdown(), state(node)) == (SUCCESS, "finalized")
    with pytest.raises(RCLError):
        node.trigger_shutdown()


@pytest.mark.parametrize(
    ("configured", "handled", "ends"),
    [
        (FAILURE, SUCCESS, "unconfigured"),
        (ERROR, SUCCESS, "unconfigured"),
        (ERROR, FAILURE, "finalized"),
        (ERROR, ERROR, "finalized"),
        (OSError("no such camera"), SUCCESS, "unconfigured"),
    ],
)
def test_what_callbacks_return_or_raise_decides(
    make: Make, configured: Any, handled: Any, ends: str
) -> None:
    previous: list[Any] = []

    def on_configure(self: Any, state: LifecycleState) -> Any:
        previous.append(state)
        if isinstance(configured, OSError):
            raise configured
        return configured

    node = make({"on_configure": on_configure, "on_error": lambda self, state: handled})
    returned = node.trigger_configure()
    assert returned == (ERROR if isinstance(configured, OSError) else configured)
    assert (state(node), previous) == (ends, [LifecycleState(label="unconfigured", state_id=1)])


class Part(ManagedEntity):
    """Notes its callbacks, and returns what it was given for one of them."""

    def __init__(self, name: str, noted: list[str], **returns: Any) -> None:
        self._name, self._noted, self._returns = name, noted, returns

    def __getattribute__(self, name: str) -> Any:
        if not name.startswith("on_"):
            return super().__getattribute__(name)

        def callback(state: LifecycleState) -> Any:
            self._noted.append(f"{self._name}: {name} from {state.label}")
            return self._returns.get(name, SUCCESS)

        return callback


def test_managed_entities_follow_the_default_callbacks(make: Make) -> None:
    node, noted = make(), []
    node.add_managed_entity(Part("part", noted))
    for each in ("configure", "activate", "deactivate", "cleanup", "shutdown"):
        assert getattr(node, f"trigger_{each}")() == SUCCESS
    assert noted == [
        "part: on_configure from unconfigured",
        "part: on_activate from inactive",
        "part: on_deactivate from active",
        "part: on_cleanup from inactive",
        "part: on_shutdown from unconfigured",
    ]
    with pytest.raises(TypeError):
        node.add_managed_entity("no entity")


@pytest.mark.parametrize("wrong", [FAILURE, ERROR, None])
def test_an_entity_that_does_not_succeed_ends_the_transition(make: Make, wrong: Any) -> None:
    node, noted = make(), []
    node.add_managed_entity(Part("part", noted, on_configure=wrong))
    # None is no TransitionCallbackReturn: a TypeError, and so an ERROR.
    assert node.trigger_configure() == (ERROR if wrong is None else wrong)
    assert state(node) == "unconfigured"
    assert len(noted) == (1 if wrong is FAILURE else 2)  # on_error follows an ERROR


def test_an_override_has_them_called_by_super(make: Make, base: type[Any]) -> None:
    noted: list[str] = []

    def on_configure(self: Any, state: LifecycleState) -> Any:
        noted.append("own")
        return base.on_configure(self, state)

    node = make({"on_configure": on_configure, "on_activate": lambda self, state: SUCCESS})
    node.add_managed_entity(Part("part", noted))
    node.trigger_configure()
    node.trigger_activate()
    assert noted == ["own", "part: on_configure from unconfigured"]


def test_a_node_may_be_an_entity_of_another(make: Make) -> None:
    outer, inner = make(), make()
    assert isinstance(inner, ManagedEntity)
    outer.add_managed_entity(inner)
    assert outer.trigger_configure() == SUCCESS


def test_a_lifecycle_publisher_publishes_while_it_is_activated(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr(
        rclpy.publisher.Publisher, "publish", lambda _, msg: said.append(getattr(msg, "data", None))
    )

    def on_activate(self: Any, state: LifecycleState) -> Any:
        self.words.publish(String(data="not yet"))
        returned = super(type(self), self).on_activate(state)
        self.words.publish(String(data="activating"))
        return returned

    node = make({"on_activate": on_activate})
    node.words = node.create_lifecycle_publisher(String, "words", 10)
    node.words.publish(String(data="unconfigured"))
    node.trigger_configure()
    node.words.publish(String(data="inactive"))
    assert not node.words.is_activated
    node.trigger_activate()
    assert node.words.is_activated
    node.words.publish(String(data="active"))
    node.trigger_deactivate()
    node.words.publish(String(data="deactivated"))
    ours = ("unconfigured", "inactive", "not yet", "activating", "active", "deactivated")
    assert [each for each in said if each in ours] == ["activating", "active"]
    assert node.destroy_lifecycle_publisher(node.words)
    with pytest.raises(TypeError):
        node.create_lifecycle_publisher(String, "words", 10, publisher_class=object)


def test_an_entity_of_the_user_s_is_gated_by_a_decorator(make: Make) -> None:
    class Motor(SimpleManagedEntity):
        turned = 0

        @SimpleManagedEntity.when_enabled
        def turn(self) -> None:
            self.turned += 1

    node, motor = make(), Motor()
    node.add_managed_entity(motor)
    node.trigger_configure()
    motor.turn()
    node.trigger_activate()
    motor.turn()
    assert (motor.turned, motor.is_activated) == (1, True)


def test_the_state_machine_shows_states_and_transitions(make: Make) -> None:
    machine = make()._state_machine
    assert machine.initialized
    assert (1, "unconfigured") in machine.available_states
    assert len(machine.available_states) == 11
    assert [each[1] for each in machine.available_transitions] == ["configure", "shutdown"]
    labels = {each[1] for each in machine.transition_graph}
    # Ours has two more, and no other.
    assert labels - {"connect", "disconnect"} == {
        *("configure", "activate", "cleanup", "shutdown", "deactivate"),
        *("transition_error", "transition_failure", "transition_success"),
    }


def test_the_services_answer_while_it_is_spun(
    make: Make, context: rclpy.Context, base: type[Any]
) -> None:
    node = make(enable_communication_interface=True)
    asking = rclpy.create_node("asking", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    executor.add_node(asking)
    srv = lifecycle_msgs.srv
    types = {"change_state": srv.ChangeState, "get_state": srv.GetState}
    types["get_available_states"] = srv.GetAvailableStates
    clients = {
        each: asking.create_client(types.get(each, srv.GetAvailableTransitions), f"/it/{each}")
        for each in SERVICES
    }
    assert all(each.wait_for_service(10.0) for each in clients.values())
    thread = threading.Thread(target=executor.spin)
    thread.start()
    try:

        def ask(name: str, **fields: Any) -> Any:
            return clients[name].call(clients[name].srv_type.Request(**fields))

        assert ask("get_state").current_state.label == "unconfigured"
        by_id = lifecycle_msgs.msg.Transition(id=1)
        assert ask("change_state", transition=by_id).success
        assert ask("get_state").current_state.label == "inactive"
        by_label = lifecycle_msgs.msg.Transition(label="activate")
        assert ask("change_state", transition=by_label).success
        unknown = lifecycle_msgs.msg.Transition(label="fly")
        assert not ask("change_state", transition=unknown).success
        assert len(ask("get_available_states").available_states) == 11
        offered = ask("get_available_transitions").available_transitions
        assert [each.transition.label for each in offered] == ["deactivate", "shutdown"]
        assert len(ask("get_transition_graph").available_transitions) >= 8
    finally:
        executor.shutdown()
        thread.join()
        asking.destroy_node()


def test_an_async_callback_of_ours_may_be_triggered_too(context: rclpy.Context) -> None:
    class Its(LifecycleNode):
        async def on_configure(self) -> None:
            await self.sleep(0.01)

    node = Its("it", context=context)
    try:
        assert node.trigger_configure() is SUCCESS
        node.trigger_cleanup()
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        inside = executor.create_task(node.trigger_configure)
        executor.spin_until_future_complete(inside, timeout_sec=10)
        assert (inside.result(), state(node)) == (ERROR, "unconfigured")
        thread = threading.Thread(target=executor.spin)
        thread.start()
        assert (node.trigger_configure(), state(node)) == (SUCCESS, "inactive")
        executor.shutdown()
        thread.join()
    finally:
        node.destroy_node()
