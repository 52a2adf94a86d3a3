"""Hidden nodes: which declared node a participant's own node belongs to.

Owns: that question, answered by the plan, by what nodes report of their connections, and else by
the name, and what a hidden node is. Pure.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable

from lifecycle.manifest.model import TOLERATED_NODES
from lifecycle.plan.model import PlannedNode
from lifecycle.plan.participants import owner_of
from lifecycle.verify.noise import tolerating_pattern
from lifecycle.verify.observation import NodeConfiguration


class Owners:
    """Knows whose every hidden node is.

    Args:
        nodes: of the plan.
        reported: what nodes say of themselves; only planned ones count.
        tolerated: patterns of names of tools, whose nodes belong to nobody by name alone.
    """

    def __init__(
        self,
        nodes: Iterable[PlannedNode],
        reported: Iterable[NodeConfiguration],
        tolerated: Collection[str] = TOLERATED_NODES,
    ) -> None:
        # A pattern that is not of hidden nodes, like `*`, says nothing of these.
        self._tools = [each for each in tolerated if each.rpartition("/")[2].startswith("_")]
        self._owners: dict[str, str] = {}
        self._planned: set[str] = set()
        for node in nodes:
            self._planned.add(node.full_name)
            for each in node.participants:
                self._owners[_beside(node.full_name, each.name)] = node.full_name
        for configuration in reported:
            if configuration.name not in self._planned:
                continue
            for connection in configuration.connections:
                if connection.node_name:
                    hidden = _beside(configuration.name, connection.node_name)
                    self._owners[hidden] = configuration.name

    def of(self, hidden: str) -> str:
        """Return the full name of the planned node that owns `hidden`; empty if none does."""
        owner = self._owners.get(hidden) or owner_of(hidden)
        return owner if owner in self._planned else self._by_name(hidden)

    def _by_name(self, hidden: str) -> str:
        """Return whose a hidden node is by its name alone, `_camera_net` beside `camera`.

        What is connected while the system runs is in the graph before its node's report says so.
        """
        namespace, _, base = hidden.rpartition("/")
        if tolerating_pattern(hidden, self._tools):
            return ""  # `_ros2cli_4711` is no participant of a node `ros2cli`
        return max(
            (
                name
                for name in self._planned
                if name.rpartition("/")[0] == namespace
                and base.startswith(f"_{name.rpartition('/')[2]}_")
            ),
            key=len,
            default="",
        )


def is_hidden_node(full_name: str) -> bool:
    """Whether a node is hidden by the convention of ROS 2: its name begins with an underscore."""
    return full_name.rpartition("/")[2].startswith("_")


def _beside(full_name: str, base: str) -> str:
    """Return the full name of a node in the namespace of another."""
    return f"{full_name.rpartition('/')[0]}/{base}"
