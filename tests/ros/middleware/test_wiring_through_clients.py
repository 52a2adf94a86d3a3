"""A node that is wired from outside: the calls of `NodeClients` against a real LifecycleNode."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable, Iterator

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String

from lifecycle import LifecycleNode, on_message
from lifecycle.errors import MiddlewareError
from lifecycle.middleware.rcl.graph import GraphObserver
from lifecycle.middleware.services.clients import NodeClients
from lifecycle.middleware.services.service_calls import ServiceUnansweredError
from lifecycle.verify.observation import EndpointReport, NodeConfiguration

WaitUntil = Callable[..., None]

BOUND_S = 30.0
UDP = "udpv4://127.0.0.1"


class It(LifecycleNode):
    """Hears and speaks."""

    def __init__(self, context: rclpy.Context) -> None:
        super().__init__("it", context=context, enable_rosout=False)
        self.declare_publisher("out", String)
        self.declare_subscription("in", String)
        self.heard: list[str] = []

    @on_message("in")
    def receive(self, message: String) -> None:
        """Keep what was heard."""
        self.heard.append(message.data)


@pytest.fixture
def clients(domain_id: int) -> Iterator[NodeClients]:
    with GraphObserver(domain_id) as observer:
        clients = NodeClients(observer)
        yield clients
        clients.destroy()


@pytest.fixture
def it(context: rclpy.Context, clients: NodeClients) -> Iterator[It]:
    """The node, active and spun in a thread of its own."""
    node = It(context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    try:
        for transition in ("configure", "connect", "activate"):
            assert run(clients.change_state("/it", transition, timeout_s=BOUND_S))
        yield node
    finally:
        executor.shutdown()
        thread.join()
        node.destroy_node()


def run(*awaitables: Awaitable[object]) -> object:
    """Await one after the other, and return what the last one gave."""

    async def bounded() -> object:
        last: object = None
        for each in awaitables:
            last = await asyncio.wait_for(each, BOUND_S)
        return last

    return asyncio.run(bounded())


def configuration(clients: NodeClients) -> NodeConfiguration:
    found = run(clients.get_configuration("/it", timeout_s=BOUND_S))
    assert isinstance(found, NodeConfiguration)
    return found


def endpoint(clients: NodeClients, name: str) -> EndpointReport:
    return next(each for each in configuration(clients).endpoints if each.name == name)


def test_a_connection_is_made_carries_an_endpoint_and_is_unmade(
    clients: NodeClients, it: It
) -> None:
    run(
        clients.wire("/it", "connect_to", "net", [UDP], timeout_s=BOUND_S),
        clients.wire("/it", "connect_to", "both", [UDP, "shm://"], timeout_s=BOUND_S),
        clients.wire("/it", "map_to", "publishers/out", "net", timeout_s=BOUND_S),
    )
    assert [(each.name, each.urls, each.mappings) for each in configuration(clients).connections][
        1:
    ] == [("net", (UDP,), ("publishers/out",)), ("both", (UDP, "shm://"), ())]
    assert endpoint(clients, "in").connection == ""
    run(clients.wire("/it", "disconnect", "net", timeout_s=BOUND_S))
    assert [each.name for each in configuration(clients).connections] == ["", "both"]
    assert endpoint(clients, "out").mapped is False
    run(clients.wire("/it", "map_to", "out", "", timeout_s=BOUND_S))
    out = endpoint(clients, "out")
    assert (out.connection, out.mapped) == ("", True)


def test_a_renamed_subscription_hears_what_is_said_under_its_new_name(
    clients: NodeClients, it: It, make_node: Callable[..., Node], wait_until: WaitUntil
) -> None:
    run(clients.wire("/it", "remap", "in", "/there", timeout_s=BOUND_S))
    assert endpoint(clients, "in").resolved == "/there"
    sender = make_node("sender").create_publisher(String, "/there", 10)
    wait_until(sender.get_subscription_count)
    sender.publish(String(data="hello"))
    wait_until(lambda: it.heard == ["hello"])
    run(clients.wire("/it", "remap", "in", "", timeout_s=BOUND_S))
    assert endpoint(clients, "in").resolved == "/in"


def test_what_the_node_refuses_is_raised_with_its_reason(clients: NodeClients, it: It) -> None:
    with pytest.raises(MiddlewareError) as refused:
        run(clients.wire("/it", "map_to", "out", "nowhere", timeout_s=BOUND_S))
    reason = "cannot find connection 'nowhere' of /it; connected: none but its own participant, ''"
    assert str(refused.value) == f"cannot map_to 'out' of '/it': it says {reason!r}"
    assert run(clients.get_state("/it", timeout_s=BOUND_S)) == "active"


def test_a_node_without_the_interface_is_told_from_one_that_refuses(
    clients: NodeClients, make_node: Callable[..., Node]
) -> None:
    make_node("plain")
    with pytest.raises(ServiceUnansweredError) as unanswered:
        run(clients.wire("/plain", "map_to", "out", "net", timeout_s=0.5))
    assert "/plain/map_to" in str(unanswered.value)
