"""What an action is called in the graph, as rcl resolves it for a running node.

Owns: the rule that rcl of ROS 2 Jazzy remaps an action's hidden topics and services one by one and
never the action, so that its name is what is left of theirs. `manifest.names.resolve` is the same
without ROS.
"""

from __future__ import annotations

from rclpy.node import Node

from lifecycle.manifest.names import action_of, hidden_names


def resolve_action_name(node: Node, name: str) -> str:
    """Return the fully qualified name of an action of `node`, after its remapping rules.

    Args:
        node: with its namespace and rules.
        name: relative, absolute or private.

    Raises:
        NameNotLegalError: the rules give its hidden names different actions.
    """
    resolved = {}
    for hidden, kind in hidden_names(name):
        resolve = node.resolve_topic_name if kind.is_topic else node.resolve_service_name
        resolved[hidden] = str(resolve(hidden))
    return action_of(name, resolved)
