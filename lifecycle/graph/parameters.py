"""The parameters of nodes that do not report them, read through their parameter services.

Owns: when a node's parameters are read. Once when it is there, again when `/parameter_events` says
that one of them changed, and else rarely: rclpy publishes no event for a parameter that is
undeclared, rclcpp need not publish any, and an event may pass before our subscription is matched.
"""

from __future__ import annotations

import asyncio
import functools
import logging
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING

from lifecycle.errors import MiddlewareError
from lifecycle.graph.loop import set_within
from lifecycle.verify.observation import SERVES_NONE, NodeParameters, ParameterReport

if TYPE_CHECKING:  # it imports rclpy
    from lifecycle.graph.loop import GraphLoop
    from lifecycle.middleware.services.clients import NodeClients

_logger = logging.getLogger(__name__)

ANSWER_S = 3.0
"""A node that spins answers within milliseconds; one that does not may still be on its way."""

UNSHOWN_S = 1.0
"""Discovery shows a node before its services; one whose services are not there then has none."""

AGAIN_S = 1.0
"""Without an event a reading is repeated so long after it, ..."""

AGAIN_AT_MOST_S = 10.0
"""... then twice as long each time, down to this."""

_BETWEEN_S = 0.02
"""At least so long between two readings, however often a parameter changes."""

_NO_ANSWER = f"did not answer its parameter services within {ANSWER_S:g} s"

Names = frozenset[str] | None
"""Of those parameters of a node that are read; None for all that it has."""


class ParameterReadings:
    """The parameters of some nodes, kept as they are. To be used in a graph's loop.

    Args:
        clients: where they are read.
        loop: of the graph.
        wake: called when they are others than before.
    """

    def __init__(self, clients: NodeClients, loop: GraphLoop, wake: Callable[[], None]) -> None:
        self._clients = clients
        self._loop = loop
        self._wake = wake
        self._nodes: dict[str, _Node] = {}
        self._named: dict[str, Names] = {}

    def listen(self, named: Mapping[str, Names]) -> None:
        """Take each change of a parameter that is named, by node, as a reason to look again."""
        # Looks at a part of the system go on beside those at all of it.
        self._named.update(named)
        if named:
            self._clients.on_parameters(self._arrived)

    async def follow(self, nodes: Collection[str], *, reporting: Collection[str]) -> bool:
        """Read the named parameters of nodes (full names) from now on; return whether it waited.

        It waits for those that were never read, no longer than a node may take to answer. Nodes
        that are `reporting` their parameters themselves now are not read.
        """
        for name in reporting:
            self.forget(name)
        for name in nodes:
            node = self._nodes.get(name)
            if node is None or node.names != self._named[name]:
                self.forget(name)
                node = self._nodes[name] = _Node(name, self._named[name])
                self._begin(node)
            missing = node.latest is not None and node.latest.error == SERVES_NONE
            if missing and self._clients.serves_parameters(name):
                node.due.set()  # the services have come
        unread = [each.is_read.wait() for each in self._nodes.values() if not each.is_read.is_set()]
        await asyncio.gather(*unread)
        return bool(unread)

    @property
    def latest(self) -> tuple[NodeParameters, ...]:
        """What was read last of every node that is followed."""
        return tuple(each.latest for each in self._nodes.values() if each.latest is not None)

    def forget(self, node: str) -> None:
        """Drop what is known of a node that left."""
        known = self._nodes.pop(node, None)
        if known is not None:
            known.task.cancel()
            known.is_read.set()

    def close(self) -> None:
        """Stop reading."""
        for name in tuple(self._nodes):
            self.forget(name)

    def reread(self, node: str | None = None) -> bool:
        """Have the next `follow` wait for readings that begin now; return whether any does.

        A node need not publish that its parameters changed, and its transitions may change them.
        """
        nodes = [each for name, each in self._nodes.items() if node in (None, name)]
        for each in nodes:
            each.task.cancel()
            self._begin(each)
        return bool(nodes)

    def _begin(self, node: _Node) -> None:
        node.is_read.clear()
        node.task = asyncio.ensure_future(self._keep(node))

    def _arrived(self, node: str, names: frozenset[str]) -> None:
        # In a thread of DDS.
        named = self._named.get(node, frozenset())
        if named is None or not names.isdisjoint(named):
            self._loop.post(functools.partial(self._changed, node))

    def _changed(self, node: str) -> None:
        known = self._nodes.get(node)
        if known is not None:
            known.due.set()
        else:
            self._wake()  # it reports them itself, and is asked when there is another look

    async def _keep(self, node: _Node) -> None:
        """Read the parameters of a node again and again."""
        pause_s, unanswered, notified = AGAIN_S, 0, True
        while True:
            node.due.clear()
            found = await self._read(node)
            unanswered = unanswered + 1 if found.error == _NO_ANSWER else 0
            # A node that is busy for a moment, and of which no event says that it has changed,
            # is what it was.
            is_busy = unanswered == 1 and not notified
            if found != node.latest and not is_busy:
                is_first, node.latest = node.latest is None, found
                if not is_first:
                    self._wake()
            node.is_read.set()
            notified = await set_within(node.due, pause_s)
            pause_s = AGAIN_S if notified else min(2 * pause_s, AGAIN_AT_MOST_S)
            await asyncio.sleep(_BETWEEN_S)

    async def _read(self, node: _Node) -> NodeParameters:
        found = None
        if (serves := self._clients.serves_parameters(node.name)) is None:
            found = await self._ask(node, UNSHOWN_S)
            serves = found is not None or self._clients.serves_parameters(node.name)
        if not serves:
            return NodeParameters(node=node.name, error=SERVES_NONE)
        if found is None:
            found = await self._ask(node, ANSWER_S)
        error = _NO_ANSWER if found is None else ""
        return NodeParameters(node=node.name, parameters=found, error=error)

    async def _ask(self, node: _Node, limit_s: float) -> tuple[ParameterReport, ...] | None:
        reading = self._clients.report_parameters(node.name, node.names, timeout_s=limit_s)
        asking = asyncio.ensure_future(reading)
        try:
            await asyncio.wait({asking}, timeout=limit_s)  # not wait_for, see set_within
            return asking.result() if asking.done() else None
        except MiddlewareError as error:
            _logger.info("parameters of %s unknown: %s", node.name, error)
        except Exception:
            # What a foreign node answers must not end the reading of its parameters.
            _logger.exception("parameters of %s unknown", node.name)
        finally:
            asking.cancel()
        return None


class _Node:
    """What is known of the parameters of one node, and whether they are to be read again."""

    def __init__(self, name: str, names: Names) -> None:
        self.name = name
        self.names = names
        self.latest: NodeParameters | None = None
        self.task: asyncio.Task[None]
        self.is_read = asyncio.Event()
        self.due = asyncio.Event()
