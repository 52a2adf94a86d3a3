"""Asking and driving nodes of other processes through their services."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from typing import Any, TypeVar

import pytest
import rclpy
from lifecycle_msgs.srv import ChangeState, GetState
from managed_node import ManagedNode
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import State, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

from lifecycle.codec import to_json
from lifecycle.middleware.rcl.graph import GraphObserver
from lifecycle.middleware.services.clients import NodeClients
from lifecycle.middleware.services.service_calls import ServiceUnansweredError
from tests.builders import configuration

InvalidHandle = rclpy_implementation.InvalidHandle
T = TypeVar("T")
Serve = Callable[..., None]
WaitUntil = Callable[..., None]

BOUND_S = 30.0
CONFIGURATION = configuration("/n")


@pytest.fixture
def observer(domain_id: int) -> Iterator[GraphObserver]:
    with GraphObserver(domain_id) as observer:
        yield observer


@pytest.fixture
def clients(observer: GraphObserver) -> Iterator[NodeClients]:
    clients = NodeClients(observer)
    yield clients
    clients.destroy()


@pytest.fixture
def serve(context: rclpy.Context) -> Iterator[Serve]:
    """Spin nodes in a thread of their own until the test ends; they go with it."""
    served: list[Node] = []
    executor = SingleThreadedExecutor(context=context)
    thread = threading.Thread(target=executor.spin)

    def add(*nodes: Node) -> None:
        served.extend(nodes)
        for node in nodes:
            executor.add_node(node)
        if not thread.is_alive():
            thread.start()

    yield add
    executor.shutdown()
    if thread.is_alive():
        thread.join()
    for node in served:
        node.destroy_node()


def run(awaitable: Awaitable[T]) -> T:
    async def bounded() -> T:
        return await asyncio.wait_for(awaitable, 2 * BOUND_S)

    return asyncio.run(bounded())


class Slow(ManagedNode):
    """A managed node that takes its time and fails on request."""

    result = TransitionCallbackReturn.SUCCESS
    takes_s = 0.0
    released: threading.Event | None = None

    def on_configure(self, state: State) -> TransitionCallbackReturn:
        time.sleep(self.takes_s)
        assert self.released is None or self.released.wait(BOUND_S)
        return self.result


@pytest.fixture
def slow(context: rclpy.Context, serve: Serve) -> Slow:
    node = Slow("slow", context=context, enable_rosout=False)
    serve(node)
    return node


def test_a_transition_that_fails_is_told_apart_from_one_that_succeeds(
    clients: NodeClients, slow: Slow
) -> None:
    slow.result = TransitionCallbackReturn.FAILURE
    assert run(clients.change_state("/slow", "configure", timeout_s=BOUND_S)) is False


@pytest.fixture
def soon_read_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without an answer the state is looked at earlier than by default."""
    monkeypatch.setattr("lifecycle.middleware.services.clients._REREAD_S", 0.2)


@pytest.mark.usefixtures("soon_read_again")
def test_a_slow_transition_is_waited_for(clients: NodeClients, slow: Slow) -> None:
    slow.takes_s = 0.5
    assert run(clients.change_state("/slow", "configure", timeout_s=BOUND_S)) is True


@pytest.mark.usefixtures("soon_read_again")
def test_a_transition_that_takes_too_long_names_the_service_and_the_time(
    clients: NodeClients, slow: Slow
) -> None:
    # Found and matched; what is measured is the transition alone.
    assert run(clients.change_state("/slow", "configure", timeout_s=BOUND_S))
    assert run(clients.change_state("/slow", "cleanup", timeout_s=BOUND_S))
    slow.released = threading.Event()
    with pytest.raises(ServiceUnansweredError) as unanswered:
        run(clients.change_state("/slow", "configure", timeout_s=0.5))
    slow.released.set()
    assert str(unanswered.value) == (
        "cannot call service '/slow/change_state': it did not answer within 0.5 s"
    )
    assert unanswered.value.found


@pytest.mark.usefixtures("soon_read_again")
def test_a_lost_reply_to_change_state_is_made_good_by_the_state(
    clients: NodeClients, slow: Slow, monkeypatch: pytest.MonkeyPatch
) -> None:
    call = clients._calls.call

    async def lose_reply(service: str, type_: type[Any], *rest: Any, **options: Any) -> Any:
        response = await call(service, type_, *rest, **options)
        if type_ is ChangeState:
            await asyncio.sleep(30)
        return response

    monkeypatch.setattr(clients._calls, "call", lose_reply)
    assert run(clients.change_state("/slow", "configure", timeout_s=BOUND_S)) is True


def test_a_service_that_nobody_offers_is_said_to_be_missing(clients: NodeClients) -> None:
    with pytest.raises(ServiceUnansweredError) as unanswered:
        run(clients.get_state("/nobody", timeout_s=0.3))
    assert str(unanswered.value) == (
        "cannot call service '/nobody/get_state': nobody offers it within 0.3 s"
    )
    assert not unanswered.value.found


def test_a_server_that_cannot_be_matched_does_not_hide_the_one_that_answers(
    clients: NodeClients, slow: Slow, make_node: Callable[..., Node]
) -> None:
    # Its replies would be BEST_EFFORT, which our reader does not take; rmw then never calls the
    # client ready. A process that died while it was discovered looks the same for ever.
    unmatched = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    for type_, name in ((GetState, "get_state"), (ChangeState, "change_state")):
        make_node(f"other_{name}").create_service(
            type_, f"/slow/{name}", lambda _, response: response, qos_profile=unmatched
        )
    assert run(clients.get_state("/slow", timeout_s=BOUND_S)) == "unconfigured"
    assert run(clients.change_state("/slow", "configure", timeout_s=BOUND_S)) is True
    assert not any(each.service_is_ready() for each in clients._calls._clients.values())


def test_a_request_that_may_be_repeated_is_until_it_is_answered(
    clients: NodeClients,
    make_node: Callable[..., Node],
    serve: Serve,
    observer: GraphObserver,
    wait_until: WaitUntil,
) -> None:
    node = make_node("n")
    asked: list[float] = []

    def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        asked.append(time.monotonic())
        if len(asked) == 1:
            time.sleep(0.6)  # hung at first: the second and third request queue up behind it
        response.success, response.message = True, to_json(CONFIGURATION).decode()
        return response

    node.create_service(Trigger, "~/get_configuration", answer)
    serve(node)

    wait_until(lambda: observer.offers("/n", "/n/get_configuration"))
    assert run(clients.get_configuration("/n", timeout_s=BOUND_S)) == CONFIGURATION
    assert not [each for each in clients._calls._clients.values() if each._pending_requests]
    wait_until(lambda: len(asked) > 1)


def test_a_node_without_the_interface_has_no_configuration(
    clients: NodeClients, slow: Slow, observer: GraphObserver, wait_until: WaitUntil
) -> None:
    wait_until(lambda: observer.offers("/slow", "/slow/get_state"))
    assert run(clients.get_configuration("/slow")) is None


def test_a_transition_is_told_until_the_node_is_forgotten(
    clients: NodeClients, slow: Slow, observer: GraphObserver, wait_until: WaitUntil
) -> None:
    told: list[None] = []
    clients.on_transition("/slow", lambda: told.append(None))
    # Matched on both sides, or the news could go past us.
    wait_until(lambda: observer.node.count_publishers("/slow/transition_event"))
    wait_until(lambda: slow.count_subscribers("/slow/transition_event"))
    assert run(clients.change_state("/slow", "configure", timeout_s=BOUND_S))
    wait_until(lambda: len(told) == 2)  # configuring, inactive
    clients.forget("/slow")
    assert run(clients.change_state("/slow", "activate", timeout_s=BOUND_S))
    assert len(told) == 2


def test_destroying_ends_the_thread(observer: GraphObserver) -> None:
    clients = NodeClients(observer)
    clients.destroy()
    clients.destroy()
    assert not [each for each in threading.enumerate() if each.name == "service-calls"]


def test_a_question_to_a_node_that_is_forgotten_meanwhile_is_unanswered(
    clients: NodeClients,
) -> None:
    async def ask() -> None:
        asking = asyncio.ensure_future(clients.get_state("/absent", timeout_s=0.2))
        await asyncio.sleep(0)
        clients.forget("/absent")
        await asking

    with pytest.raises(ServiceUnansweredError):
        asyncio.run(ask())


def test_a_question_to_a_node_that_comes_outlives_one_of_its_name_that_is_seen_to_leave(
    clients: NodeClients, context: rclpy.Context, serve: Serve
) -> None:
    """The graph shows that a process ended after its successor was asked: seen of a container."""

    async def ask() -> str:
        asking = asyncio.ensure_future(clients.get_state("/served", timeout_s=BOUND_S))
        await asyncio.sleep(0)
        clients.forget("/served")
        await asyncio.sleep(0)
        serve(ManagedNode("served", context=context))
        return await asking

    assert run(ask()) == "unconfigured"


MANAGED = """
import rclpy
from rclpy.lifecycle import LifecycleNode
rclpy.init()
rclpy.spin(LifecycleNode("twice"))
"""


def test_a_request_that_may_not_be_repeated_waits_for_the_successor_of_a_killed_process(
    clients: NodeClients, observer: GraphObserver, domain_id: int, wait_until: WaitUntil
) -> None:
    """Discovery shows the killed one until its lease ends; nobody answers what that is sent."""

    def start() -> subprocess.Popen[bytes]:
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain_id)}
        return subprocess.Popen([sys.executable, "-c", MANAGED], env=environment)

    async def ask() -> bool:
        asking = clients.change_state("/twice", "configure", timeout_s=BOUND_S)
        task = asyncio.ensure_future(asking)
        await asyncio.sleep(0.5)
        processes.append(start())
        return await task

    processes = [start()]
    try:
        assert run(clients.get_state("/twice", timeout_s=BOUND_S)) == "unconfigured"
        assert run(clients.change_state("/twice", "configure", timeout_s=BOUND_S))
        processes[0].kill()
        processes[0].wait()
        observer.ended(processes[0].pid, nodes=["/twice"], reported=())
        assert observer.node.count_services("/twice/change_state") == 1
        assert run(ask()) is True
        assert run(clients.get_state("/twice", timeout_s=BOUND_S)) == "inactive"
    finally:
        for each in processes:
            each.kill()
            each.wait()


def test_a_question_that_waits_ends_with_the_clients(clients: NodeClients) -> None:
    async def ask() -> None:
        asking = asyncio.ensure_future(clients.get_state("/absent", timeout_s=BOUND_S))
        await asyncio.sleep(0)
        clients.destroy()
        await asyncio.wait_for(asking, 1.0)

    with pytest.raises(ServiceUnansweredError):
        asyncio.run(ask())
