"""A component container as rclcpp_components has it, of rclpy nodes: `container.py [NAME] [mute]`.

A mute one does not answer requests to load and unload, like a server that does not know its
client's reader yet. Prints `loaded NAME [EXTRA:=VALUE]…` and `unloaded NAME`, and ends where it is
asked to load `demo/Fatal`.
"""

from __future__ import annotations

import gc
import os
import sys
from typing import Any

import rclpy
from composition_interfaces.srv import ListNodes, LoadNode, UnloadNode, fields_of, respond
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import String


class Talker(Node):
    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.declare_parameter("rate", 1.0)
        self.declare_parameter("word", "")
        self.create_publisher(String, "words", 5)


class Hearer(LifecycleNode):
    def on_configure(self, state: object) -> TransitionCallbackReturn:
        self._subscription = self.create_subscription(String, "words", lambda _: None, 5)
        return TransitionCallbackReturn.SUCCESS


PLUGINS = {"Talker": Talker, "Hearer": Hearer}


class Container(Node):
    def __init__(self, name: str, executor: SingleThreadedExecutor, *, mute: bool) -> None:
        super().__init__(name)
        self._runs = executor
        self._nodes: dict[int, Node] = {}
        self._loaded = 0
        # A node that was destroyed and its service of type descriptions are in a cycle: the service
        # stays until that is collected, which its executor allows once it has gone on.
        self.create_timer(0.1, gc.collect)
        self.create_service(ListNodes, "~/_container/list_nodes", self._list)
        changing = (
            self.create_service(LoadNode, "~/_container/load_node", self._load),
            self.create_service(UnloadNode, "~/_container/unload_node", self._unload),
        )
        if mute:
            for each in changing:
                each.send_response = lambda *_: None

    def _load(self, request: Any, response: Any) -> Any:
        asked = fields_of(request)
        if asked["plugin_name"] == "Fatal":
            os._exit(3)
        if asked["package_name"] != "demo" or asked["plugin_name"] not in PLUGINS:
            why = f"no plugin {asked['plugin_name']}"
            return respond(response, success=False, error_message=why, unique_id=0)
        rules = [word for rule in asked["remap_rules"] for word in ("-r", rule)]
        node: Any = PLUGINS[asked["plugin_name"]](
            asked["node_name"],
            namespace=asked["node_namespace"],
            cli_args=["--ros-args", *rules] if rules else None,
            parameter_overrides=[Parameter.from_parameter_msg(e) for e in asked["parameters"]],
        )
        self._loaded += 1  # an id is of one component for good
        self._nodes[self._loaded] = node
        self._runs.add_node(node)
        extra = [f"{name}:={value}" for name, value in asked["extra_arguments"].items()]
        print(" ".join(["loaded", node.get_fully_qualified_name(), *extra]), flush=True)
        return respond(response, success=True, error_message="", unique_id=self._loaded)

    def _list(self, request: Any, response: Any) -> Any:
        names = [each.get_fully_qualified_name() for each in self._nodes.values()]
        return respond(response, full_node_names=names, unique_ids=[*self._nodes])

    def _unload(self, request: Any, response: Any) -> Any:
        node = self._nodes.pop(fields_of(request)["unique_id"])
        name = node.get_fully_qualified_name()
        self._runs.remove_node(node)
        node.destroy_node()
        print(f"unloaded {name}", flush=True)
        return respond(response, success=True, error_message="", unique_id=0)


def main() -> None:
    rclpy.init(args=sys.argv)
    executor = SingleThreadedExecutor()
    words = rclpy.utilities.remove_ros_args(sys.argv)[1:]
    names = [each for each in words if each != "mute"] or ["container"]
    executor.add_node(Container(*names, executor, mute="mute" in words))
    print("ready", flush=True)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
