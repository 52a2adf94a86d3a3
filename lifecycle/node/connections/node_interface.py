"""The node interface: connect_to, map_to, disconnect, remap, alias, and when they are allowed.

Owns: the one implementation behind the local API, the ROS services and the control channel. See
*Topological Discovery and Communication Negotiation*, "Node Interface".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rclpy.task import Future

from lifecycle.errors import LifecycleError
from lifecycle.node.connections.connections import Connection
from lifecycle.node.connections.data_layer import DataLayer
from lifecycle.node.lifecycle.machine import NodeState
from lifecycle.plan.model import ParticipantConnections

CONFIGURED = frozenset(
    {
        NodeState.CONFIGURING,  # in on_configure everything is declared already
        NodeState.INACTIVE_DISCONNECTED,
        NodeState.CONNECTING,
        NodeState.INACTIVE_CONNECTED,
        NodeState.ACTIVATING_DISCONNECTED,
        NodeState.ACTIVATING_CONNECTED,
        NodeState.ACTIVE,
        NodeState.DEACTIVATING,
    }
)
"""Where endpoints are declared and nobody is taking them away."""


class NotConfiguredError(LifecycleError):
    """The node interface was used in a state in which nothing is declared."""


class NodeInterface:
    """What may be asked of one node's data layer.

    Args:
        node: fully qualified name, for messages.
        data_layer: does it.
        state: of the node, now.
    """

    def __init__(self, node: str, data_layer: DataLayer, state: Callable[[], NodeState]) -> None:
        self._node = node
        self._data_layer = data_layer
        self._state = state

    def connect_to(self, name: str, how: ParticipantConnections) -> Connection:
        """Make a connection; an empty name lets one be made up.

        Raises:
            ConnectError: it cannot be made; nothing is left.
            NotConfiguredError: not in this state.
        """
        where = ", ".join(how.urls) or repr(name)
        self._refuse_unconfigured(f"connect {self._node} to {where}")
        return self._data_layer.connect_to(name or self._data_layer.connections.free_name(), how)

    def map_to(self, endpoint: str, connection: Connection | str) -> Future:
        """Map an endpoint onto a connection, or hand it over; see `DataLayer.map_to`."""
        self._refuse_unconfigured(f"map {endpoint!r} of {self._node}")
        return self._data_layer.map_to(endpoint, connection)

    def disconnect(self, connection: Connection | str) -> None:
        """Unmake a connection and the mappings onto it; see `DataLayer.disconnect_from`."""
        name = connection if isinstance(connection, str) else connection.name
        self._refuse_unconfigured(f"disconnect {self._node} from {name!r}")
        self._data_layer.disconnect_from(connection)

    def remap(self, endpoint: str, name: str) -> None:
        """Give an endpoint another topic or service name; see `DataLayer.remap`."""
        self._refuse_unconfigured(f"remap {endpoint!r} of {self._node}")
        self._data_layer.remap(endpoint, name)

    def alias(self, endpoint: str, names: Sequence[str]) -> None:
        """Give an endpoint these further names and no others; see `DataLayer.alias`."""
        self._refuse_unconfigured(f"alias {endpoint!r} of {self._node}")
        self._data_layer.alias(endpoint, names)

    def _refuse_unconfigured(self, what: str) -> None:
        state = self._state()
        if state not in CONFIGURED:
            raise NotConfiguredError(
                f"cannot {what}: it is {state.value!r}",
                hint="endpoints are declared from configure until cleanup; configure it first",
            )
