"""LifecycleNode as its author and its neighbours see it, on real DDS."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import rclpy
from builtin_interfaces.msg import Time
from hearing import Hearing
from lifecycle_driver import Driver
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from msgspec.structs import replace
from planning import AT, built_with, client, planned, publisher, server, subscription
from rcl_interfaces.msg import ParameterEvent
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import Trigger

from lifecycle import ERROR, FAILURE, LifecycleNode, on_message, on_service, on_timer
from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import ParameterDeclaration
from lifecycle.manifest.qos import Durability, QosProfile
from lifecycle.middleware.rcl.conversions import to_rclpy
from lifecycle.node.endpoint import UnknownEndpointError
from lifecycle.node.machine import NodeState
from lifecycle.plan.model import PlannedNode

Build = Callable[..., Any]


@pytest.fixture
def build(driver: Driver, context: rclpy.Context) -> Build:
    """Construct a class from a plan and spin it."""

    def build(node_class: type[LifecycleNode], spec: PlannedNode) -> LifecycleNode:
        with built_with(spec, context):
            node = node_class()
        driver.add(node)
        return node

    return build


class Chatty(LifecycleNode):
    """One of each; writes down what it receives."""

    def __init__(self) -> None:
        super().__init__("a_name_that_the_plan_overrules")
        self.heard: list[str] = []
        self.ticks = 0

    @on_message("in")
    def receive(self, message: String) -> None:
        self.heard.append(message.data)

    @on_service("reset")
    def reset(self, request: Trigger.Request, response: Trigger.Response) -> None:
        response.message = "done"

    @on_timer(period_s=0.01)
    def tick(self) -> None:
        self.ticks += 1


CHATTY = planned("chatty", publisher("out"), subscription("in"), server("reset"), client("other"))


@pytest.fixture
def chatty(build: Build) -> Chatty:
    node: Chatty = build(Chatty, CHATTY)
    return node


def up(driver: Driver, *labels: str, node: str = "/chatty") -> None:
    for label in labels:
        assert driver.set(node, label)


def test_the_plans_name_wins_over_the_constructors(chatty: Chatty) -> None:
    assert chatty.get_fully_qualified_name() == "/chatty"


def test_endpoints_exist_from_connect_until_disconnect(driver: Driver, chatty: Chatty) -> None:
    def counts() -> tuple[int, int]:
        return driver.node.count_publishers("/out"), driver.node.count_subscribers("/in")

    up(driver, "configure")
    assert counts() == (0, 0)
    up(driver, "connect")
    assert counts() == (1, 1)
    up(driver, "disconnect")
    assert counts() == (0, 0)
    up(driver, "activate")
    assert counts() == (1, 1)
    up(driver, "deactivate")
    assert counts() == (1, 1)
    up(driver, "cleanup")
    assert counts() == (0, 0)
    up(driver, "configure", "connect", "shutdown")
    assert counts() == (0, 0)


def test_what_is_published_flows_only_while_active(driver: Driver, chatty: Chatty) -> None:
    received: list[str] = []
    driver.node.create_subscription(String, "/out", lambda m: received.append(m.data), 10)
    up(driver, "configure")
    out = chatty.publisher("out")
    out.publish(String(data="configured"))
    up(driver, "connect")
    out.publish(String(data="connected"))
    driver.spin_until(lambda: out.get_subscription_count() == 1)
    up(driver, "activate")
    out.publish(String(data="active"))
    up(driver, "deactivate")
    out.publish(String(data="inactive"))
    up(driver, "activate")
    out.publish(String(data="active again"))
    driver.spin_until(lambda: "active again" in received)
    assert received == ["active", "active again"]


def test_messages_are_received_only_while_active(driver: Driver, chatty: Chatty) -> None:
    sender = driver.node.create_publisher(String, "/in", 10)
    up(driver, "configure", "connect")
    driver.spin_until(lambda: sender.get_subscription_count() == 1)
    sender.publish(String(data="early"))
    driver.settle()
    up(driver, "activate")
    sender.publish(String(data="now"))
    driver.spin_until(lambda: chatty.heard)
    up(driver, "deactivate")
    sender.publish(String(data="late"))
    driver.settle()
    up(driver, "activate")
    sender.publish(String(data="again"))
    driver.spin_until(lambda: "again" in chatty.heard)
    assert chatty.heard == ["now", "again"]


def test_timers_run_only_while_active(driver: Driver, chatty: Chatty) -> None:
    up(driver, "configure", "connect")
    timers = [timer for timer in chatty.timers if not timer.is_canceled()]
    assert timers == []
    up(driver, "activate")
    driver.spin_until(lambda: chatty.ticks >= 3)
    up(driver, "deactivate")
    assert [timer for timer in chatty.timers if not timer.is_canceled()] == []
    up(driver, "cleanup")
    assert list(chatty.timers) == []


def test_what_the_author_makes_with_rclpys_factories_is_gated_too(
    driver: Driver, build: Build
) -> None:
    class Own(LifecycleNode):
        def on_configure(self) -> None:
            self.heard: list[String] = []
            self.ticks = 0
            self.out = self.create_publisher(String, "own", 10)
            self.create_subscription(String, "own", self.heard.append, 10)
            self.create_timer(0.01, self.tick)

        def tick(self) -> None:
            self.ticks += 1

    node = build(Own, planned("own"))
    up(driver, "configure", node="/own")
    node.out.publish(String(data="inactive"))
    up(driver, "activate", node="/own")
    node.out.publish(String(data="active"))
    driver.spin_until(lambda: node.heard and node.ticks)
    assert [message.data for message in node.heard] == ["active"]


def test_timers_go_by_simulated_time(driver: Driver, chatty: Chatty) -> None:
    simulated = driver.node.create_publisher(Clock, "/clock", 1)
    chatty.set_parameters([Parameter("use_sim_time", value=True)])
    up(driver, "configure", "activate")
    driver.spin_until(simulated.get_subscription_count)
    for second in (1, 2):
        simulated.publish(Clock(clock=Time(sec=second)))
        driver.spin_until(lambda second=second: chatty.ticks == second)


def test_parameter_events_are_not_gated(driver: Driver, chatty: Chatty) -> None:
    events: list[ParameterEvent] = []
    driver.node.create_subscription(ParameterEvent, "/parameter_events", events.append, 10)
    # Declared by rclpy, before it is configured.
    driver.spin_until(
        lambda: (
            chatty.set_parameters([Parameter("use_sim_time", value=False)])
            and any(event.node == "/chatty" for event in events)
        )
    )
    assert driver.state("/chatty") == (1, "unconfigured")


def test_a_declared_service_answers_and_may_return_nothing(driver: Driver, chatty: Chatty) -> None:
    up(driver, "configure", "connect")
    assert driver.call(Trigger, "/reset", Trigger.Request()).message == "done"


def test_an_unknown_endpoint_is_a_key_error_that_lists_what_is_declared(
    driver: Driver, chatty: Chatty
) -> None:
    up(driver, "configure", "connect")
    with pytest.raises(UnknownEndpointError) as unknown:
        chatty.publisher("outt")
    assert str(unknown.value) == (
        "cannot find endpoint 'publishers/outt' of /chatty; did you mean 'publishers/out'? "
        "declared: 'publishers/out', 'subscriptions/in', 'service_servers/reset', "
        "'service_clients/other'"
    )
    with pytest.raises(KeyError):
        chatty.client("nothing")


def test_a_client_before_connect_is_an_error_that_says_when(driver: Driver, chatty: Chatty) -> None:
    up(driver, "configure")
    with pytest.raises(LifecycleError) as error:
        chatty.client("other")
    assert str(error.value) == (
        "cannot use service client 'other': /chatty is not connected; endpoints exist from "
        "connect until disconnect"
    )


@pytest.mark.parametrize(
    ("spec", "error"),
    [
        (
            planned("chatty", subscription("in")),
            (
                "cannot use handler Chatty.reset: @on_service('reset') names no service server "
                "that /chatty declares; declared: none"
            ),
        ),
        (
            replace(CHATTY, endpoints=(*CHATTY.endpoints, subscription("inn"))),
            (
                "cannot serve subscription 'inn' of /chatty: no method of Chatty is decorated with "
                "@on_message('inn')"
            ),
        ),
        (
            replace(CHATTY, endpoints=(*CHATTY.endpoints, publisher("x", "std_msgs/msg/Strong"))),
            (
                "publisher 'x': cannot find interface type 'std_msgs/msg/Strong': package "
                "'std_msgs' has no msg 'Strong'; did you mean std_msgs/msg/String?"
            ),
        ),
    ],
)
def test_a_node_that_does_not_fit_its_interface_fails_to_configure(
    driver: Driver, build: Build, spec: PlannedNode, error: str
) -> None:
    node = build(Chatty, spec)
    assert driver.run(node.lifecycle.change, "configure").error == error
    assert driver.state("/chatty") == (1, "unconfigured")


class Server(Node):
    """Another node, whose service a callback waits for."""

    def __init__(self, context: rclpy.Context) -> None:
        super().__init__("server", context=context, enable_rosout=False)
        self.create_service(Trigger, "/other", self._answer)

    def _answer(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        return response


def test_callbacks_may_await_another_nodes_service_in_the_same_executor(
    driver: Driver, build: Build, context: rclpy.Context
) -> None:
    class Asking(LifecycleNode):
        answers: list[str]

        async def on_configure(self) -> None:
            self.answers = []
            await self.ask(self.create_client(Trigger, "/other"), "on_configure")

        async def on_activate(self) -> None:
            await self.ask(self.client("other"), "on_activate")

        @on_message("in")
        async def hear(self, message: String) -> None:
            await self.ask(self.client("other"), message.data)

        async def ask(self, of: Any, what: str) -> None:
            assert (await of.call_async(Trigger.Request())).success
            self.answers.append(what)

    node = build(Asking, planned("asking", client("other"), subscription("in")))
    other = Server(context)
    driver.executor.add_node(other)
    driver.spin_until(lambda: driver.node.count_services("/other") == 1)
    sender = driver.node.create_publisher(String, "/in", 10)
    up(driver, "configure", "activate", node="/asking")
    driver.spin_until(lambda: sender.get_subscription_count() == 1)
    sender.publish(String(data="message"))
    driver.spin_until(lambda: "message" in node.answers)
    assert node.answers == ["on_configure", "on_activate", "message"]
    driver.executor.remove_node(other)
    other.destroy_node()


def test_a_latched_sample_that_came_before_activation_is_received_at_activation(
    driver: Driver, build: Build
) -> None:
    latched = QosProfile(depth=1, durability=Durability.TRANSIENT_LOCAL)
    node = build(Hearing, planned("it", subscription("in", qos=latched)))
    driver.node.create_publisher(String, "/in", to_rclpy(latched)).publish(String(data="map"))
    up(driver, "configure", "connect", node="/it")
    driver.spin_until(lambda: driver.node.count_subscribers("/in") == 1)
    driver.settle()
    assert node.heard == []
    up(driver, "activate", node="/it")
    driver.spin_until(lambda: node.heard == ["map"])


def test_a_request_while_a_transition_runs_is_refused_and_the_state_can_be_read(
    driver: Driver, build: Build
) -> None:
    class Held(LifecycleNode):
        async def on_configure(self) -> object:
            return await self.go_on

    node = build(Held, planned("waiting"))
    node.go_on = Future()
    request = ChangeState.Request(transition=Transition(id=1))
    first = driver.start(ChangeState, "/waiting/change_state", request)
    driver.spin_until(lambda: driver.state("/waiting") == (10, "configuring"))
    assert driver.change("/waiting", label="shutdown") is False
    assert not first.done()
    node.go_on.set_result(FAILURE)
    driver.spin_until(first.done)
    assert first.result().success is False
    assert driver.state("/waiting") == (1, "unconfigured")


def test_activate_from_disconnected_that_fails_to_connect_stays_disconnected(
    driver: Driver, build: Build
) -> None:
    class Refusing(LifecycleNode):
        def on_connect(self) -> object:
            return FAILURE

    node = build(Refusing, planned("refusing", publisher("out")))
    up(driver, "configure", node="/refusing")
    assert driver.change("/refusing", label="activate") is False
    assert node.lifecycle.state is NodeState.INACTIVE_DISCONNECTED
    assert driver.node.count_publishers("/out") == 0


def test_an_error_in_connect_takes_the_data_layer_down(driver: Driver, build: Build) -> None:
    class Broken(LifecycleNode):
        def on_connect(self) -> object:
            return ERROR

    build(Broken, planned("broken", publisher("out")))
    up(driver, "configure", node="/broken")
    assert driver.change("/broken", label="connect") is False
    assert driver.state("/broken") == (1, "unconfigured")
    assert driver.node.count_publishers("/out") == 0


PARAMETERS = (
    ParameterDeclaration(name="rate_hz", type="double", default=15.0, at=AT),
    ParameterDeclaration(name="width", type="int", default=320, read_only=True, at=AT),
    ParameterDeclaration(name="gains", type="double_array", at=AT),
    ParameterDeclaration(name="mask", type="byte_array", default=(1, 255), at=AT),
)


def test_parameters_are_declared_with_the_plans_values(driver: Driver, build: Build) -> None:
    spec = planned(
        "it",
        declared_parameters=PARAMETERS,
        parameters=(("rate_hz", 30), ("gains", (1, 2.5))),
    )
    node = build(LifecycleNode, spec)
    up(driver, "configure", node="/it")
    values = {p.name: node.get_parameter(p.name).value for p in PARAMETERS}
    assert values["rate_hz"] == 30.0
    assert isinstance(values["rate_hz"], float)
    assert values["width"] == 320
    assert list(values["gains"]) == [1.0, 2.5]
    assert values["mask"] == [b"\x01", b"\xff"]
    (changed,) = node.set_parameters([Parameter("width", value=640)])
    assert not changed.successful
    up(driver, "cleanup", "configure", node="/it")


def test_a_parameter_of_the_wrong_type_fails_to_configure(driver: Driver, build: Build) -> None:
    spec = planned("it", declared_parameters=PARAMETERS, parameters=(("width", "wide"),))
    node = build(LifecycleNode, spec)
    result = driver.run(node.lifecycle.change, "configure")
    assert result.error.startswith(
        "test.lifecycle.yaml:7:5: cannot declare parameter 'width' as int: "
    )
    assert driver.state("/it") == (1, "unconfigured")


def test_a_node_without_a_manifest_declares_in_code_and_drives_itself(
    driver: Driver, context: rclpy.Context
) -> None:
    class Alone(LifecycleNode):
        def __init__(self) -> None:
            super().__init__("alone", lifecycle="auto", namespace="/here", context=context)
            self.declare_publisher("out", String)
            self.declare_subscription("out", String, 10)
            self.declare_service("reset", Trigger)
            self.declare_client("reset", Trigger)
            self.heard: list[String] = []

        @on_timer(period_s=0.01)
        def speak(self) -> None:
            self.publisher("out").publish(String(data="hello"))

        @on_message("out")
        def hear(self, message: String) -> None:
            self.heard.append(message)

        @on_service("reset")
        def reset(self, request: Trigger.Request, response: Trigger.Response) -> None: ...

    node = Alone()
    driver.add(node)
    driver.spin_until(lambda: node.heard)
    assert node.is_active
    assert driver.node.count_publishers("/here/out") == 1


def test_a_mode_that_does_not_exist_is_refused(context: rclpy.Context) -> None:
    with pytest.raises(LifecycleError) as error:
        LifecycleNode("it", lifecycle="automatic", context=context)
    assert str(error.value) == ("cannot use lifecycle='automatic'; allowed: 'manual', 'auto'")


def test_remaps_of_the_plan_reach_declared_and_own_endpoints(driver: Driver, build: Build) -> None:
    class Both(LifecycleNode):
        def on_configure(self) -> None:
            self.create_publisher(String, "own", 10)

    spec = planned("both", publisher("out"), remap=(("out", "/there"), ("own", "elsewhere")))
    build(Both, spec)
    up(driver, "configure", "connect", node="/both")
    assert driver.node.count_publishers("/there") == 1
    assert driver.node.count_publishers("/elsewhere") == 1
