"""Whether the server of a service or action client is matched, and a callback when that changes.

Owns: what may be taken for a match. rmw_fastrtps counts a client's server only while its request
writer has matched as many readers as its response reader has matched writers, at least one, and the
graph knows as many servers by either (rmw_service_server_is_available.cpp); an action's server is
that for all three services, and a publisher of feedback (rcl_action_server_is_available).
"""

from __future__ import annotations

import threading
import typing
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeAlias

from rclpy.client import Client
from rclpy.exceptions import InvalidHandle
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.utilities import get_rmw_implementation_identifier

from lifecycle.middleware.rcl.graph_changes import on_graph_change

if TYPE_CHECKING:
    from rclpy.action import ActionClient
    from rclpy.node import Node

    AnyClient: TypeAlias = Client | ActionClient

_TELLING = ("rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp")
"""Others answer from the graph alone, or were not looked at."""


def is_server_matched(client: AnyClient) -> bool | None:
    """Return whether a server is matched with a client both ways; None if the RMW cannot say."""
    return _is_ready(client) if get_rmw_implementation_identifier() in _TELLING else None


@typing.final
class ServerWatch:
    """Calls back when the server of a client was matched, or is no longer.

    No event reports that, but each match follows a change of the graph within a moment: it is
    looked at then, for some seconds if need be, and not in between.

    Args:
        node: of the client.
        client: to watch; `stop` before it is destroyed.
        changed: called in a thread of the graph, also by the constructor if a server is matched
            already. It must be quick, and ask again by itself.
    """

    def __init__(self, node: Node, client: AnyClient, changed: Callable[[], None]) -> None:
        self._node = node
        self._client = client
        self._changed = changed
        self._lock = threading.Lock()
        self._matched = False
        self._stop: Callable[[], None] | None = on_graph_change(node, self._look)
        self._look()

    def stop(self) -> None:
        """End it; again is harmless."""
        if self._stop is not None:
            self._stop()
            self._stop = None

    def _look(self) -> bool:
        """Look; return whether a match may follow what is in the graph already."""
        try:
            with self._lock:
                matched = _is_ready(self._client)
                has_changed = matched != self._matched
                self._matched = matched
            if has_changed:
                self._changed()
            return not matched and self._is_offered()
        except (InvalidHandle, rclpy_implementation.RCLError):
            return False  # it was destroyed meanwhile

    def _is_offered(self) -> bool:
        if isinstance(self._client, Client):
            return bool(self._node.count_services(self._client.service_name))
        return bool(self._node.count_services(f"{self._client.action_name}/_action/send_goal"))


def _is_ready(client: AnyClient) -> bool:
    if isinstance(client, Client):
        return bool(client.service_is_ready())
    return bool(client.server_is_ready())
