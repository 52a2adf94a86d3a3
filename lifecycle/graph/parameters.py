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
        """Take each change of a named parameter as a reason to look again.

        Args:
            named: by full node name; without any, nothing is subscribed to.
        """
        # Looks at a part of the system go on beside those at all of it.
        self._named.update(named)
        if named:
            self._clients.on_parameters(self._arrived)

    async def follow(self, nodes: Collection[str], *, reporting: Collection[str]) -> bool:
        """Read the named parameters of nodes from now on.

        Waits for those that were never read, no longer than a node may take to answer.

        Args:
            nodes: full names, which have been listened for.
            reporting: nodes that report their parameters themselves now; they are not read.

        Returns:
            Whether it has waited, so that what was seen before may be so no more.
        """
        for name in reporting:
            self.forget(name)
        for name in nodes:
            names = self._named[name]
            known = self._nodes.get(name)
            if known is None or known.names != names:
                self.forget(name)
                known = self._nodes[name] = _Node(name, names, self._clients, self._wake)
            known.look()
        first = [each.first for each in self._nodes.values() if not each.first.done()]
        if first:
            await asyncio.wait(first)
        return bool(first)

    @property
    def latest(self) -> tuple[NodeParameters, ...]:
        """What was read last of every node that is followed."""
        return tuple(each.latest for each in self._nodes.values() if each.latest is not None)

    def forget(self, node: str) -> None:
        """Drop what is known of a node that left."""
        known = self._nodes.pop(node, None)
        if known is not None:
            known.close()

    def close(self) -> None:
        """Stop reading."""
        for name in tuple(self._nodes):
            self.forget(name)

    def reread(self, node: str | None = None) -> bool:
        """Have the next `follow` wait for readings that begin now; None for all nodes.

        A node need not publish that its parameters changed, and its transitions may change them.

        Returns:
            Whether any is read.
        """
        nodes = [each for name, each in self._nodes.items() if node in (None, name)]
        for each in nodes:
            each.reread()
        return bool(nodes)

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


class _Node:
    """The parameters of one node, read again and again by a task."""

    def __init__(
        self, name: str, names: Names, clients: NodeClients, wake: Callable[[], None]
    ) -> None:
        self.names = names
        self.latest: NodeParameters | None = None
        self.due = asyncio.Event()
        self.first: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._wanted = 0
        self._name = name
        self._clients = clients
        self._wake = wake
        self._task = asyncio.ensure_future(self._follow())

    def look(self) -> None:
        """Read at once if the services have come that were missing."""
        missing = self.latest is not None and self.latest.error == SERVES_NONE
        if missing and self._clients.serves_parameters(self._name):
            self.due.set()

    def reread(self) -> None:
        """Read at once, and have who follows wait for it."""
        self._wanted += 1
        if self.first.done():
            self.first = asyncio.get_running_loop().create_future()
        self.due.set()

    def close(self) -> None:
        self._task.cancel()
        if not self.first.done():
            self.first.set_result(None)

    async def _follow(self) -> None:
        pause_s, unanswered, notified = AGAIN_S, 0, True
        while True:
            self.due.clear()
            wanted = self._wanted
            found = await self._read()
            unanswered = unanswered + 1 if found.error == _NO_ANSWER else 0
            # A node that is busy for a moment, and of which no event says that it has changed,
            # is what it was.
            is_busy = unanswered == 1 and not notified
            if found != self.latest and not is_busy:
                is_first, self.latest = self.latest is None, found
                if not is_first:
                    self._wake()
            if not self.first.done() and self._wanted == wanted:
                self.first.set_result(None)
            notified = await set_within(self.due, pause_s)
            pause_s = AGAIN_S if notified else min(2 * pause_s, AGAIN_AT_MOST_S)
            await asyncio.sleep(_BETWEEN_S)

    async def _read(self) -> NodeParameters:
        if self._clients.serves_parameters(self._name) is None:
            found = await self._ask(UNSHOWN_S)
            if found is not None:
                return NodeParameters(node=self._name, parameters=found)
        if not self._clients.serves_parameters(self._name):
            return NodeParameters(node=self._name, error=SERVES_NONE)
        found = await self._ask(ANSWER_S)
        error = _NO_ANSWER if found is None else ""
        return NodeParameters(node=self._name, parameters=found, error=error)

    async def _ask(self, limit_s: float) -> tuple[ParameterReport, ...] | None:
        reading = self._clients.report_parameters(self._name, self.names, timeout_s=limit_s)
        asking = asyncio.ensure_future(reading)
        try:
            await asyncio.wait({asking}, timeout=limit_s)  # not wait_for, see set_within
            return asking.result() if asking.done() else None
        except MiddlewareError as error:
            _logger.info("parameters of %s unknown: %s", self._name, error)
        except Exception:
            # What a foreign node answers must not end the reading of its parameters.
            _logger.exception("parameters of %s unknown", self._name)
        finally:
            asking.cancel()
        return None
