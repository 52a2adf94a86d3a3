"""Does one thing that the ros2 command does, over plain rclpy: `client.py WORDS`.

    nodes [NODE…]              full names, one a line; those given are waited for
    topics [TOPIC…]            name and types, one a line; likewise
    services [SERVICE…]        likewise
    state NODE                 label of its lifecycle state
    change NODE TRANSITION     `done` or `refused`
    params NODE                names
    get NODE PARAMETER         value
    set NODE PARAMETER VALUE   `done`, or the reason why not
    echo TOPIC                 the first std_msgs/String

It is called as the ros2 command's node is, hidden, and waits for what it asks for.
"""

from __future__ import annotations

import os
import sys
import time
from typing import Any

import rclpy
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from std_msgs.msg import String

TRANSITIONS = {"configure": 1, "cleanup": 2, "activate": 3, "deactivate": 4}
WAIT_S = 20.0


def call(node: Node, type_: type, name: str, **fields: Any) -> Any:
    """Call a service and return the response."""
    client = node.create_client(type_, name)
    if not client.wait_for_service(WAIT_S):
        sys.exit(f"no service {name}")
    future = client.call_async(type_.Request(**fields))
    rclpy.spin_until_future_complete(node, future, timeout_sec=WAIT_S)
    if not future.done():
        sys.exit(f"no answer of {name}")
    return future.result()


def graph(node: Node, what: str) -> list[str]:
    if what == "nodes":
        found = node.get_node_names_and_namespaces()
        return [f"{space.rstrip('/')}/{name}" for name, space in found]
    names = {"topics": node.get_topic_names_and_types, "services": node.get_service_names_and_types}
    return [f"{name} {' '.join(types)}" for name, types in names[what]()]


def graph_with(node: Node, what: str, *wanted: str) -> list[str]:
    """Look around until these names are seen."""
    end = time.monotonic() + WAIT_S
    while time.monotonic() < end:
        found = graph(node, what)
        if set(wanted) <= {each.split()[0] for each in found}:
            return found
        time.sleep(0.1)
    sys.exit(f"{what} are {found}")


def echo(node: Node, topic: str) -> list[str]:
    got: list[str] = []
    node.create_subscription(String, topic, lambda message: got.append(message.data), 10)
    end = time.monotonic() + WAIT_S
    while not got and time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.1)
    return got[:1]


def ask(node: Node, verb: str, *words: str) -> list[str]:
    """Return the lines to print."""
    if verb in ("nodes", "topics", "services"):
        return graph_with(node, verb, *words)
    if verb == "echo":
        return echo(node, *words)
    of, *rest = words
    if verb == "state":
        return [call(node, GetState, f"{of}/get_state").current_state.label]
    if verb == "change":
        request = ChangeState.Request()
        request.transition.id = TRANSITIONS[rest[0]]
        answer = call(node, ChangeState, f"{of}/change_state", transition=request.transition)
        return ["done" if answer.success else "refused"]
    if verb == "params":
        return list(call(node, ListParameters, f"{of}/list_parameters").result.names)
    if verb == "get":
        answer = call(node, GetParameters, f"{of}/get_parameters", names=rest)
        return [str(parameter_value_to_python(each)) for each in answer.values]
    value = Parameter(rest[0], value=int(rest[1]) if rest[1].isdigit() else rest[1])
    parameters = [value.to_parameter_msg()]
    answer = call(node, SetParameters, f"{of}/set_parameters", parameters=parameters)
    return ["done" if each.successful else each.reason for each in answer.results]


def main() -> None:
    rclpy.init()
    node = Node(f"_ros2cli_{os.getpid()}", start_parameter_services=False, enable_rosout=False)
    try:
        for line in ask(node, *sys.argv[1:]):
            print(line)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
