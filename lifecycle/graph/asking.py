"""Asking nodes for their configuration and their state, with a node that somebody else spins.

Owns: the clients of `~/get_configuration` and `~/get_state`, and how often a question is repeated:
a service is matched a moment after discovery shows it, and rmw_fastrtps drops a reply that comes
before the client's reader is matched. Only while a question is open is anything looked at again.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import Any

from lifecycle_msgs.srv import GetState
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.client import Client
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from lifecycle.graph.scheduler import Remove, Scheduler
from lifecycle.verify.observation import ConfigurationError, NodeConfiguration, decode_configuration

_logger = logging.getLogger(__name__)

PATIENCE_S = 3.0
"""A question that is not answered within so long is given up."""

_FIRST_S = 0.02
_LONGEST_S = 0.5


class Asker:
    """Asks nodes; to be used in the scheduler. `close` it before the node is destroyed.

    Args:
        node: spun by an executor, in any other thread than the scheduler's.
        scheduler: where answers are given.
    """

    def __init__(self, node: Node, scheduler: Scheduler) -> None:
        self._node = node
        self._scheduler = scheduler
        self._group = ReentrantCallbackGroup()
        self._clients: dict[str, dict[type[Any], Client]] = {}
        self._closed = False

    def get_configuration(
        self, node: str, done: Callable[[NodeConfiguration | None], None]
    ) -> None:
        """Call `done` with the configuration of `node`; None if it was not to be had."""

        def read(response: Any) -> None:
            done(None if response is None else _configuration(node, response))

        client = self._client(node, Trigger, "get_configuration")
        self._ask(client, Trigger.Request(), read)

    def get_state(self, node: str, done: Callable[[str | None], None]) -> None:
        """Call `done` with the label of a managed node's state; None if it was not to be had."""

        def read(response: Any) -> None:
            done(None if response is None else str(response.current_state.label))

        self._ask(self._client(node, GetState, "get_state"), GetState.Request(), read)

    def forget(self, node: str) -> None:
        """Drop the clients of a node that left."""
        for client in self._clients.pop(node, {}).values():
            self._node.destroy_client(client)

    def close(self) -> None:
        """Drop every client; open questions stay unanswered. Again is harmless."""
        self._closed = True
        for node in tuple(self._clients):
            self.forget(node)

    def _client(self, node: str, type_: type[Any], service: str) -> Client | None:
        if self._closed:
            return None
        clients = self._clients.setdefault(node, {})
        if type_ not in clients:
            clients[type_] = self._node.create_client(
                type_, f"{node}/{service}", callback_group=self._group
            )
        return clients[type_]

    def _ask(self, client: Client | None, request: Any, done: Callable[[Any], None]) -> None:
        if client is None:
            done(None)
            return
        _Question(self._scheduler, client, request, done).go_on(_FIRST_S)


class _Question:
    """One request, sent until it is answered or nobody waits any more."""

    def __init__(
        self, scheduler: Scheduler, client: Client, request: Any, done: Callable[[Any], None]
    ) -> None:
        self._scheduler = scheduler
        self._client = client
        self._request = request
        self._done: Callable[[Any], None] | None = done
        self._deadline_s = scheduler.now_s() + PATIENCE_S
        self._sent: list[Future] = []
        self._cancel: Remove | None = None

    def go_on(self, pause_s: float) -> None:
        """Send if the service is there, and look again after a pause."""
        if self._done is None:
            return
        now_s = self._scheduler.now_s()
        try:
            if now_s >= self._deadline_s:
                self._end(None)
                return
            if self._client.service_is_ready():
                self._sent.append(self._client.call_async(self._request))
                self._sent[-1].add_done_callback(self._arrived)
                pause_s = max(pause_s, 5 * _FIRST_S)
        except Exception as error:  # noqa: BLE001 - rclpy raises its own kinds for a client that was destroyed
            _logger.debug("cannot ask %s: %s", self._client.srv_name, error)
            self._end(None)
            return
        self._cancel = self._scheduler.call_at(
            now_s + pause_s, functools.partial(self.go_on, min(2 * pause_s, _LONGEST_S))
        )

    def _arrived(self, pending: Future) -> None:
        # In the executor's thread.
        if not pending.cancelled() and pending.exception() is None:
            self._scheduler.post(functools.partial(self._end, pending.result()))

    def _end(self, response: Any) -> None:
        if self._done is None:
            return
        done, self._done = self._done, None
        if self._cancel is not None:
            self._cancel()
        for pending in self._sent:
            self._client.remove_pending_request(pending)
        done(response)


def _configuration(node: str, response: Any) -> NodeConfiguration | None:
    if not response.success:
        _logger.info("%s could not give its configuration: %s", node, response.message)
        return None
    try:
        return decode_configuration(response.message, node)
    except ConfigurationError as error:
        _logger.warning("cannot read the configuration of %s: %s", node, error)
        return None
