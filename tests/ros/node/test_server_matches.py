"""Whether a declared client's server is matched: as it reports it, and that it tells of changes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from counting import client as action_client
from lifecycle_driver import Driver
from planning import client
from rclpy.action import ActionServer
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

from lifecycle import LifecycleNode

Active = Callable[..., Any]

BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
"""No client of a service asks for less than it needs, so DDS never matches such a server."""


class Silent(LifecycleNode):
    """Does nothing by itself."""


def reported(node: LifecycleNode) -> list[bool | None]:
    return [each.server_matched for each in node.lifecycle.get_configuration().endpoints]


def telling(node: LifecycleNode) -> list[list[bool | None]]:
    """Return what the node will have told of its clients."""
    told: list[list[bool | None]] = []
    node.lifecycle.configuration_changes.listen(
        lambda now: told.append([each.server_matched for each in now.endpoints])
    )
    return told


def serve(node: Node, **options: Any) -> Any:
    return node.create_service(Trigger, "/ask", lambda _, response: response, **options)


def test_a_client_tells_when_its_server_is_matched_and_when_it_is_not_any_more(
    driver: Driver, active: Active
) -> None:
    node = active(Silent, client("ask"))
    assert reported(node) == [False]
    told = telling(node)
    server = serve(driver.node)
    driver.spin_until(lambda: told[-1:] == [[True]])
    assert reported(node) == [True]
    driver.node.destroy_service(server)
    driver.spin_until(lambda: told[-1:] == [[False]])


def test_a_server_in_the_graph_that_dds_does_not_match_is_not_taken_for_one_that_is(
    driver: Driver, active: Active
) -> None:
    node = active(Silent, client("ask"))
    serve(driver.node, qos_profile=BEST_EFFORT)
    driver.spin_until(lambda: node.count_services("/ask") == 1)
    driver.settle()
    assert reported(node) == [False]


def test_an_action_client_tells_of_its_server_too(driver: Driver, active: Active) -> None:
    node = active(Silent, action_client())
    assert reported(node) == [False]
    told = telling(node)
    server = ActionServer(driver.node, Fibonacci, "/count", lambda _: Fibonacci.Result())
    driver.spin_until(lambda: told[-1:] == [[True]])
    server.destroy()
    driver.spin_until(lambda: told[-1:] == [[False]])


def test_a_client_on_a_connection_tells_of_matches_there(driver: Driver, active: Active) -> None:
    node = active(Silent, client("ask"), action_client(), to="configure")
    net = node.connect_to("udpv4://127.0.0.1", name="net")
    node.map_to("service_clients/ask", net)
    node.map_to("action_clients/count", net)
    assert driver.set("/it", "connect")
    assert reported(node) == [False, False]
    told = telling(node)
    serve(driver.node)
    driver.spin_until(lambda: told[-1:] == [[True, False]])
    server = ActionServer(driver.node, Fibonacci, "/count", lambda _: Fibonacci.Result())
    driver.spin_until(lambda: told[-1:] == [[True, True]])
    server.destroy()
