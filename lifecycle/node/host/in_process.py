"""Run one node of a plan inside a test's own process, with a peer to exchange messages with."""

from __future__ import annotations

import concurrent.futures
import functools
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, ShutdownException
from rclpy.node import Node

from lifecycle.errors import BringUpError, UsageError
from lifecycle.manifest.model import EndpointKind, RunKind
from lifecycle.middleware.fastdds.factory import initialised
from lifecycle.middleware.fastdds.profiles import ParticipantSettings
from lifecycle.middleware.rcl.conversions import import_interface, to_rclpy
from lifecycle.node.callbacks import CallbackOutcome, Result
from lifecycle.node.host.adoption import Adoption, maker_of
from lifecycle.node.host.foreign import ForeignNode
from lifecycle.node.host.loop import NodeLoop
from lifecycle.plan.model import PlannedNode

WAIT_S = 10.0
"""For a message, an answer or a log line; it ends with what is waited for."""

_WAYS = {
    "unconfigured": (),
    "inactive": ("configure", "connect"),
    "active": ("configure", "connect", "activate"),
}
_ROSOUT = "/rosout"


class NodeInProcess:
    """A node of a manifest in this process, spun by a thread until `close`.

    Any class or function of `run: {python: …}`: of rclpy.lifecycle too, or a plain node, which has
    no states. Nothing is supervised or verified; one callback runs at a time. Its methods may be
    called from any thread but that one, and the next one raises what a callback of the node raised.

    Args:
        planned: a node that is a Python class, or made by a function.
        domain_id: 0–232.
        group: what else the same class or function makes.

    Attributes:
        node: the user's own object.
        peer: an ordinary rclpy node beside it, spun by the same thread.
    """

    def __init__(
        self, planned: PlannedNode, *, domain_id: int, group: Sequence[PlannedNode] = ()
    ) -> None:
        if planned.run.kind is not RunKind.PYTHON:
            raise UsageError(
                f"cannot run {planned.full_name} in this process: it is no Python class",
                hint="bring the system up instead: the fixture lifecycle_system",
            )
        folder = str(Path(planned.at.file).absolute().parent)
        maker = maker_of(planned, (folder,))
        self._planned = planned
        self._error: BaseException | None = None
        self._received: dict[str, list[Any]] = {}
        self._publishers: dict[str, Any] = {}
        self._clients: dict[str, Any] = {}
        self._logs: list[Any] = []
        self._closed = False
        settings = ParticipantSettings.of(planned)
        self._context = initialised(settings, domain_id, context=Context())
        self._loop = NodeLoop(self._context)
        adoption = Adoption(self._context, self._loop)
        try:
            self._all = adoption.make(planned, group or (planned,), maker)
        except BaseException:
            self._loop.close()
            self._context.try_shutdown()
            raise
        finally:
            adoption.unfollow()
        (self._hosted,) = (each for each in self._all if each.spec.key == planned.key)
        self.node: Any = self._hosted.node
        self.peer = Node("lifecycle_test_peer", context=self._context, enable_rosout=False)
        self._make_peers()
        for each in self._all:
            self._loop.add(each)
        self._loop.spin(self.peer)
        self._thread = threading.Thread(target=self._spin, name=planned.full_name, daemon=True)
        self._thread.start()

    def _make_peers(self) -> None:
        from rcl_interfaces.msg import Log
        from rclpy.qos import DurabilityPolicy, QoSProfile

        rosout = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.peer.create_subscription(Log, _ROSOUT, self._logs.append, rosout)
        for each in self._planned.endpoints:
            qos = to_rclpy(each.qos)
            if each.kind is EndpointKind.PUBLISHER:
                taken: list[Any] = []
                self._received[each.name] = taken
                self.peer.create_subscription(
                    import_interface(each.type), each.resolved, taken.append, qos
                )
            elif each.kind is EndpointKind.SUBSCRIPTION:
                self._publishers[each.name] = self.peer.create_publisher(
                    import_interface(each.type), each.resolved, qos
                )
            elif each.kind is EndpointKind.SERVICE_SERVER:
                self._clients[each.name] = self.peer.create_client(
                    import_interface(each.type), each.resolved
                )

    def _spin(self) -> None:
        try:
            while True:
                self._loop.turn()
        except (ShutdownException, ExternalShutdownException):
            pass
        except BaseException as error:  # noqa: BLE001 - raised in the test's thread
            self._error = error

    @property
    def state(self) -> str:
        """lifecycle_msgs/State label; empty of a plain node."""
        return self._hosted.reported.label

    @property
    def logs(self) -> tuple[str, ...]:
        """What the node has logged so far, all levels that it publishes on /rosout."""
        name = self.node.get_logger().name
        return tuple(each.msg for each in tuple(self._logs) if each.name == name)

    def bring_to(self, state: str) -> None:
        """Bring an unconfigured node to "inactive" (connected) or "active", matched with its peer.

        Raises:
            UsageError: no such state; a plain node has "active" alone, which is to be matched.
            BringUpError: a transition failed, or took longer than its deadline.
        """
        if state not in _WAYS:
            raise UsageError(f"cannot bring a node to {state!r}; allowed: {', '.join(_WAYS)}")
        if state != "active" and not self._planned.managed:
            raise UsageError(
                f"cannot bring {self._planned.full_name} to {state!r}: a plain node has no states",
                hint="say to='active', or leave it out",
            )
        for transition in _WAYS[state] if self._planned.managed else ():
            self.change(transition)
        if _WAYS[state]:
            self._wait(self._is_matched, "cannot match every endpoint with the test's peer")

    def _is_matched(self) -> bool:
        return (
            all(each.get_subscription_count() for each in self._publishers.values())
            and all(
                self.peer.count_publishers(each.resolved)
                for each in self._planned.endpoints
                if each.kind is EndpointKind.PUBLISHER
            )
            and all(each.service_is_ready() for each in self._clients.values())
        )

    def change(self, transition: str) -> None:
        """Run a transition of the node, `deactivate` for one.

        Raises:
            BringUpError: a callback returned FAILURE or ERROR, raised, or took too long.
            LifecycleError: it is not allowed in this state, or there is none of this name.
        """
        if not self._planned.managed:
            raise UsageError(
                f"cannot {transition} {self._planned.full_name}: a plain node has no states"
            )
        change = functools.partial(self._hosted.change_for_supervisor, transition)
        result: Result = self.run(change, self._limit_s)
        if result.outcome is not CallbackOutcome.SUCCESS:
            raise BringUpError(f"cannot {transition} {self._planned.full_name}: {result.error}")

    @property
    def _limit_s(self) -> float:
        limits = self._planned.timeouts
        return limits.configure_s + limits.connect_s + limits.activate_s + WAIT_S

    def run(self, function: Callable[[], Any], timeout_s: float = WAIT_S) -> Any:
        """Call a function, sync or async, in the thread that spins the node; return its result.

        Raises TimeoutError after `timeout_s` seconds, as all methods do that have it.
        """
        future: concurrent.futures.Future[Any] = concurrent.futures.Future()

        async def call() -> None:
            try:
                result = function()
                if hasattr(result, "__await__"):
                    result = await result
            except Exception as raised:  # noqa: BLE001 - raised for who called
                future.set_exception(raised)
            else:
                future.set_result(result)

        self._loop.call_soon(call)
        self._wait(future.done, f"cannot finish {function!r}", timeout_s)
        return future.result()

    def publish(self, subscription: str, message: Any) -> None:
        """Send a message to a declared subscription, by its declared name."""
        self._declared(self._publishers, subscription, "subscription").publish(message)

    def received(self, publisher: str, timeout_s: float = WAIT_S) -> Any:
        """Return the next message, in order, that the node published; by the declared name."""
        taken: list[Any] = self._declared(self._received, publisher, "publisher")
        self._wait(lambda: taken, f"cannot receive a message of {publisher!r}", timeout_s)
        return taken.pop(0)

    def call(self, service: str, request: Any, timeout_s: float = WAIT_S) -> Any:
        """Call a declared service server, by its declared name; return the response."""
        client = self._declared(self._clients, service, "service server")
        future = client.call_async(request)
        self._wait(future.done, f"cannot get an answer of {service!r}", timeout_s)
        return future.result()

    def wait_for_log(self, text: str, timeout_s: float = WAIT_S) -> str:
        """Return the first line that the node logged with `text` in it."""
        self._wait(
            lambda: any(text in each for each in self.logs),
            f"cannot find {text!r} in what was logged",
            timeout_s,
        )
        return next(each for each in self.logs if text in each)

    def _declared(self, known: dict[str, Any], name: str, what: str) -> Any:
        if name not in known:
            declared = ", ".join(known) or "none"
            raise UsageError(
                f"cannot find {what} {name!r} of {self._planned.full_name}; declared: {declared}"
            )
        return known[name]

    def _wait(self, holds: Callable[[], object], what: str, timeout_s: float = WAIT_S) -> None:
        deadline = time.monotonic() + timeout_s
        while True:
            if self._error is not None:
                error, self._error = self._error, None
                self._closed = True
                raise error
            if holds():
                return
            if time.monotonic() >= deadline:
                raise TimeoutError(f"{what} within {timeout_s:g} s")
            time.sleep(_LOOK_S)

    def close(self) -> None:
        """Shut the node down and leave the graph; raises what a callback raised meanwhile."""
        try:
            if not self._closed:
                self._closed = True
                for hosted in self._all:
                    self.run(functools.partial(hosted.shut_down, "the test is over"), self._limit_s)
        finally:
            self._loop.close()
            self._thread.join(WAIT_S)
            for hosted in self._all:
                if isinstance(hosted, ForeignNode):
                    hosted.close()
            nodes = (self.peer, *self._loop.nodes)
            for each in nodes:
                each.destroy_node()
            for hosted in self._all:
                if isinstance(hosted, ForeignNode):
                    hosted.destroyed()
            for context in dict.fromkeys([self._context, *(each.context for each in nodes)]):
                context.try_shutdown()
                context.destroy()


_LOOK_S = 0.005
