"""LifecycleNode: what people subclass.

Owns: the node as its author sees it: how it is constructed, its callbacks, and access to what is
declared. Its further methods are in declarations.py, local_interface.py and gated_factories.py;
what they all do is put together in managed.py.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rclpy.client import Client
from rclpy.context import Context
from rclpy.lifecycle import LifecycleState
from rclpy.logging import LoggingSeverity
from rclpy.task import Future

from lifecycle.manifest.model import EndpointKind
from lifecycle.node.author import parameters
from lifecycle.node.author.declarations import Declarations
from lifecycle.node.author.managed import Managed
from lifecycle.node.author.spec import (
    Mode,
    default_name,
    parse_mode,
    plan_without_manifest,
    ros_arguments,
    take_construction,
)
from lifecycle.node.connections.local_interface import LocalInterface
from lifecycle.node.endpoints.publisher import DeclaredPublisher
from lifecycle.node.lifecycle.gate import Gate
from lifecycle.node.lifecycle.gated_factories import GatedFactories
from lifecycle.node.lifecycle.machine import NodeState

if TYPE_CHECKING:
    from rclpy.action import ActionClient

TransitionCallbackReturn = Any
"""What a callback may return: rclpy's TransitionCallbackReturn, or None for SUCCESS."""


class LifecycleNode(Declarations, LocalInterface, GatedFactories):
    """A ROS 2 managed node whose endpoints are declared, not scattered through its code.

    From outside it is exactly a managed node (`ros2 lifecycle`, launch_ros and nav2 drive it),
    with two more transitions inside *inactive*: `connect` makes the endpoints, `disconnect`
    removes them. Data flows only while the node is active.

    With a manifest that declares a publisher `chatter` and a subscription `echo`:

        class Talker(LifecycleNode):
            def on_configure(self):
                self.chatter = self.publisher("chatter")
                self.count = 0

            @on_timer(period_s=0.5)
            def tick(self):
                self.count += 1
                self.chatter.publish(Int32(data=self.count))

            @on_message("echo")
            def heard(self, message):
                self.get_logger().info(f"heard {message.data}")

    Without a manifest, the same class declares them itself and drives itself up:

        class Talker(LifecycleNode):
            def __init__(self):
                super().__init__("talker", lifecycle="auto")
                self.declare_publisher("chatter", Int32)
                self.declare_subscription("echo", Int32)
            ...

        lifecycle.run(Talker)

    Callbacks `on_configure`, `on_connect`, `on_activate`, `on_deactivate`, `on_disconnect`,
    `on_cleanup`, `on_shutdown` and `on_error` take `(self, state)` or `(self)`, return SUCCESS,
    FAILURE, ERROR or None for SUCCESS, and may be `async def`:

        async def on_activate(self, state):
            answer = await self.client("calibrate").call_async(Trigger.Request())
            return SUCCESS if answer.success else FAILURE

    An exception is logged with its traceback and counts as ERROR. Every callback has a deadline
    (`timeouts:` in the manifest, 10 s by default): an `async def` one is interrupted where it
    awaits; a sync one cannot be, so it is judged when it returns, and a supervisor may end the
    process before that. An exception in a message, service or timer callback ends the process,
    as with any rclpy node; one in an action's handler ends its goal.

    Args:
        node_name: base name; by default the class's name in snake_case. A manifest's name wins.
        lifecycle: "manual" waits for others to drive it; "auto" configures, connects and activates
            itself as soon as it is spun. Under a supervisor or `lifecycle run` theirs wins.
        namespace: as in rclpy; a manifest's wins.
        context: as in rclpy.
        options: further keywords of rclpy.node.Node.

    Attributes:
        lifecycle: the managed half: `lifecycle.state`, `await lifecycle.change("configure")`,
            `lifecycle.get_configuration()`.
    """

    def __init__(
        self,
        node_name: str | None = None,
        *,
        lifecycle: str = "manual",
        namespace: str | None = None,
        context: Context | None = None,
        **options: Any,
    ) -> None:
        mode = parse_mode(lifecycle)
        construction = take_construction()
        planned = construction.spec if construction is not None else None
        name = node_name or default_name(type(self))
        if planned is not None:
            name, namespace = planned.name, planned.namespace
            options["cli_args"] = [*ros_arguments(planned), *(options.get("cli_args") or ())]
            given = options.get("parameter_overrides") or ()
            options["parameter_overrides"] = [*given, *parameters.overrides(planned)]
        if construction is not None:
            context = construction.context or context
            options.setdefault("use_global_arguments", construction.use_global_arguments)
            mode = construction.mode or mode
        super().__init__(name, namespace=namespace, context=context, **options)
        self._gate = Gate()
        spec = planned or plan_without_manifest(
            type(self), name=self.get_name(), namespace=self.get_namespace()
        )
        if spec.log_level:
            self.get_logger().set_level(LoggingSeverity[spec.log_level.upper()])
        supervisor = construction.supervisor if construction is not None else ""
        self.lifecycle: Managed = Managed(self, spec, mode, self._gate, supervisor)
        if construction is None and mode is Mode.AUTO:
            self.lifecycle.bring_up_when_spun()

    @property
    def is_active(self) -> bool:
        """Data may flow."""
        return self.lifecycle.state is NodeState.ACTIVE

    def publisher(self, name: str) -> DeclaredPublisher:
        """Return the declared publisher `name`, from on_configure on.

        Raises:
            UnknownEndpointError: nothing of that name is declared; a KeyError too.
        """
        return self.lifecycle.data_layer.endpoints.publisher(name)

    def client(self, name: str) -> Client:
        """Return the declared service client `name`, from on_connect on.

        In callbacks, `await self.client("reset").call_async(request)`; the blocking `call` would
        wait for the executor that is waiting for it.

        Raises:
            UnknownEndpointError: nothing of that name is declared; a KeyError too.
            LifecycleError: the node is not connected.
        """
        client: Client = self.lifecycle.data_layer.endpoints.client(
            EndpointKind.SERVICE_CLIENT, name
        )
        return client

    def action_client(self, name: str) -> ActionClient:
        """Return the declared action client `name`, from on_connect on; raises as `client`.

        In callbacks, `goal = await self.action_client("dock").send_goal_async(Dock.Goal())`, then
        `await goal.get_result_async()`; the blocking calls raise DeadlockError.
        """
        client: ActionClient = self.lifecycle.data_layer.endpoints.client(
            EndpointKind.ACTION_CLIENT, name
        )
        return client

    def sleep(self, seconds: float) -> Future:
        """Return what is done in `seconds` (> 0) of wall time: `await self.sleep(0.1)`.

        For `async def` callbacks, above all handlers of actions: whatever else the node has to do
        goes on meanwhile, requests to cancel a goal included.
        """
        return self.lifecycle.sleep(seconds)

    def undeclare_parameter(self, name: str) -> None:
        """As rclpy's, which tells nobody; the node's configuration has changed."""
        super().undeclare_parameter(name)
        self.lifecycle.configuration_changes.touch()

    def destroy_node(self) -> None:
        """As rclpy's; participants of its own go with it."""
        self.lifecycle.close()
        super().destroy_node()

    # Callbacks of the author.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read parameters, take resources. Endpoints are declared but do not exist yet."""

    def on_connect(self, state: LifecycleState) -> TransitionCallbackReturn:
        """The data layer is made: endpoints exist, clients can be used, data does not flow."""

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start working; data flows once this has succeeded."""

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop working; data has stopped flowing already."""

    def on_disconnect(self, state: LifecycleState) -> TransitionCallbackReturn:
        """The data layer is about to be removed."""

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give back what on_configure took."""

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """The last call, from any state; endpoints are removed after it."""

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """A callback came to ERROR: SUCCESS says the node is as new, FAILURE finalizes it."""
