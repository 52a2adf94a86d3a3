"""Services that a node under `lifecycle up` offers once a client asks, on real DDS."""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.task import Future
from type_description_interfaces.srv import GetTypeDescription

from lifecycle.errors import ExitCode
from lifecycle.middleware import GraphObserver, NodeClients
from lifecycle.node import SERVED_ON_DEMAND, Operation
from tests.ros.supervisor.running import BOUND_S, pair, up

INTERFACE = {*SERVED_ON_DEMAND[Operation.SERVE_INTERFACE]}
PARAMETERS = {*SERVED_ON_DEMAND[Operation.SERVE_PARAMETERS]}

TYPES = {*SERVED_ON_DEMAND[Operation.SERVE_TYPE_DESCRIPTIONS]}


def offered(graph: GraphObserver, node: str, *services: str) -> set[str]:
    """Wait until a node is seen to offer these; return all that it offers."""
    deadline_s = time.monotonic() + BOUND_S
    wanted = {f"{node}/{each}" for each in services or ("map_to", "get_state")}
    while not wanted <= (seen := graph.services_of(node)):
        assert time.monotonic() < deadline_s, seen
        time.sleep(0.01)
    return {each.removeprefix(f"{node}/") for each in seen}


def test_a_node_offers_all_of_the_node_interface_once_a_client_asks(
    tmp_path: Path, fresh_domain: int
) -> None:
    with up(pair(tmp_path, fresh_domain), runtime=tmp_path) as run:
        run.until("system", reached="active")
        with GraphObserver(fresh_domain) as graph:
            assert not INTERFACE & offered(graph, "/talker")
            assert "get_configuration" in offered(graph, "/talker")
            clients = NodeClients(graph)
            asyncio.run(clients.remap("/talker", "publishers/chatter", "", timeout_s=5.0))
            clients.destroy()
            assert not {"remap", *PARAMETERS, *TYPES} & offered(graph, "/listener")
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK
        assert run.verdict["findings"] == []
        run.assert_nothing_left()


class Asker:
    """A node of somebody else's that asks as `ros2 param get` and its like do."""

    def __init__(self, context: rclpy.Context) -> None:
        self.node = Node("asker", context=context, start_parameter_services=False)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)

    def value_of(self, node: str, name: str) -> object:
        client = AsyncParameterClient(self.node, node)
        assert client.wait_for_services(BOUND_S)
        (value,) = self._answer(client.get_parameters([name])).values
        return parameter_value_to_python(value)

    def call(self, type_: Any, service: str, request: Any) -> Any:
        client = self.node.create_client(type_, service)
        assert client.wait_for_service(BOUND_S)
        return self._answer(client.call_async(request))

    def _answer(self, future: Future) -> Any:
        self.executor.spin_until_future_complete(future, timeout_sec=BOUND_S)
        return future.result()


@pytest.fixture
def asker(fresh_domain: int) -> Iterator[Asker]:
    context = rclpy.Context()
    context.init(domain_id=fresh_domain)
    asker = Asker(context)
    yield asker
    asker.executor.shutdown()
    asker.node.destroy_node()
    context.try_shutdown()
    context.destroy()


_OPEN = {"policy": {"undeclared_nodes": "open"}}  # for who asks

_EDIT = {
    **_OPEN,
    "nodes/talker/run/python": "tests.ros.supervisor.systems:Parameterised",
    "nodes/third": {
        "run": {"python": "tests.ros.supervisor.systems:Listener"},
        "interface": {
            "parameters": {"rate": {"type": "int", "default_value": 3}},
            "subscriptions": [{"name": "chatter", "type": "std_msgs/msg/String"}],
        },
    },
}


def test_a_node_that_declares_no_parameter_serves_its_own_once_a_client_asks(
    tmp_path: Path, fresh_domain: int, asker: Asker
) -> None:
    with up(pair(tmp_path, fresh_domain, edit=_EDIT), runtime=tmp_path) as run:
        run.until("system", reached="active")
        with GraphObserver(fresh_domain) as graph:
            offered(graph, "/talker", *PARAMETERS)
            offered(graph, "/third", *PARAMETERS)
            assert not PARAMETERS & offered(graph, "/listener")
            assert asker.value_of("/listener", "use_sim_time") is False
            assert offered(graph, "/listener") >= PARAMETERS
            assert not offered(graph, "/listener") & {*INTERFACE, *TYPES}
        assert (asker.value_of("/talker", "rate"), asker.value_of("/third", "rate")) == (7, 3)
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK
        assert run.verdict["findings"] == []
        run.assert_nothing_left()


def test_a_node_describes_its_types_once_a_client_asks(
    tmp_path: Path, fresh_domain: int, asker: Asker
) -> None:
    with up(pair(tmp_path, fresh_domain, edit=_OPEN), runtime=tmp_path) as run:
        run.until("system", reached="active")
        with GraphObserver(fresh_domain) as graph:
            assert not TYPES & offered(graph, "/talker")
            (publisher,) = asker.node.get_publishers_info_by_topic("/chatter")
            request = GetTypeDescription.Request(
                type_name="std_msgs/msg/String", type_hash=str(publisher.topic_type_hash)
            )
            answer = asker.call(GetTypeDescription, "/talker/get_type_description", request)
            assert answer.successful, answer.failure_reason
            assert answer.type_description.type_description.type_name == "std_msgs/msg/String"
            assert offered(graph, "/talker") >= TYPES
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK
        assert run.verdict["findings"] == []
