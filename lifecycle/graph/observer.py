"""One observation out of three sources: discovery, the nodes' services, the control channel.

Owns: what is asked of whom, the configurations that were delivered out of band, and when a change
is worth another look. Event driven: it only looks when asked to and only wakes when something
happened.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
import typing
from collections.abc import Callable, Collection, Iterable
from typing import Protocol

from lifecycle.errors import MiddlewareError
from lifecycle.graph.parameters import Clients as ParameterClients
from lifecycle.graph.parameters import ParameterReadings
from lifecycle.graph.scheduler import set_within
from lifecycle.plan.model import Plan
from lifecycle.verify.noise import NO_NAMES, DeclaredNames, tolerating_pattern
from lifecycle.verify.observation import (
    NodeConfiguration,
    Observation,
    ObservedEndpoint,
    ObservedNode,
)

_logger = logging.getLogger(__name__)
_ASK_S = 1.0
"""A node that answers at all answers within milliseconds."""


class Graph(Protocol):
    """Discovery, see lifecycle.middleware.GraphObserver."""

    def snapshot(
        self, *, declared: Collection[str] = (), names: DeclaredNames = NO_NAMES
    ) -> tuple[tuple[ObservedNode, ...], tuple[ObservedEndpoint, ...]]:
        """Return the nodes and endpoints that discovery shows now."""

    def settling_s(self) -> float:
        """Return for how long the last snapshot may miss somebody who is there; 0 if it cannot."""

    def on_change(self, callback: Callable[[], None]) -> Callable[[], None]:
        """Call `callback` from any thread after each change; return what takes it away."""

    def destroy(self) -> None:
        """Leave the graph."""


class Clients(ParameterClients, Protocol):
    """Nodes' services, see lifecycle.middleware.NodeClients."""

    async def get_state(self, node: str, *, timeout_s: float) -> str:
        """Return the label of the node's state."""

    async def get_configuration(self, node: str, *, timeout_s: float) -> NodeConfiguration | None:
        """Return the node's configuration; None where it has no such interface."""

    def on_transition(self, node: str, callback: Callable[[], None]) -> None:
        """Call `callback` from any thread after each transition of the node, until `forget`."""

    def forget(self, node: str) -> None:
        """Drop what is held for a node that left."""

    def destroy(self) -> None:
        """Drop everything."""


@typing.final
class Observer:
    """The eyes of a supervisor and of `lifecycle verify`.

    Use `Observer.open`, before starting what is to be observed; methods from one asyncio loop.

    Args:
        graph: discovery.
        clients: services of nodes that do not report over a control channel.
        quiet_s: a burst of changes is over when nothing changed for so long, ≥ 0.
        burst_s: a burst is cut off after so long, ≥ quiet_s.
        guests: also ask nodes that are not planned, as far as they have our node interface.
    """

    def __init__(
        self,
        graph: Graph,
        clients: Clients,
        *,
        quiet_s: float = 0.02,
        burst_s: float = 0.1,
        guests: bool = False,
    ) -> None:
        self._graph = graph
        self._clients = clients
        self._quiet_s = quiet_s
        self._burst_s = burst_s
        self._guests = guests
        self._configurations: dict[str, NodeConfiguration] = {}
        self._seen: frozenset[str] = frozenset()
        self._asked: set[str] = set()
        self._checksums: dict[str, str] = {}
        self._parameters = ParameterReadings(clients, self._wake)
        self._changed = asyncio.Event()
        self._changed.set()  # nothing was looked at yet
        self._count = 0
        self._loop: asyncio.AbstractEventLoop | None = None
        self._remove = graph.on_change(self._wake)

    @classmethod
    def open(cls, domain_id: int, *, quiet_s: float = 0.02, burst_s: float = 0.1) -> Observer:
        """Make an observer with a participant of its own in `domain_id` (0–232).

        Raises:
            MiddlewareError: no participant could be made.
        """
        from lifecycle.middleware import GraphObserver, NodeClients

        graph = GraphObserver(domain_id)
        return cls(graph, NodeClients(graph), quiet_s=quiet_s, burst_s=burst_s)

    @property
    def changes(self) -> int:
        """Changes so far, each counted at once: before its burst has passed (`wait_change`)."""
        return self._count

    async def observe(self, plan: Plan) -> Observation:
        """Return what is there now.

        Waits until everybody who was there before us is seen, which takes a moment after `open`:
        an observation that misses a participant would prove nothing about undeclared nodes.

        Planned nodes whose configuration was not put here are asked for their state and their
        configuration; what they do not answer within a second stays unknown. Those that report no
        parameters, and of which some are planned, are asked for these (graph/parameters.py).

        Raises:
            MiddlewareError: the graph can no longer be watched.
        """
        self._bind()
        planned = {node.full_name for node in plan.nodes}
        names = DeclaredNames.of(plan)
        while True:
            self._changed.clear()
            nodes, endpoints = self._graph.snapshot(declared=planned, names=names)
            settling_s = self._graph.settling_s()
            if settling_s <= 0:
                break
            await set_within(self._changed, settling_s)
        self._forget_the_gone(node.full_name for node in nodes)
        present = {node.full_name for node in nodes} - set(self._configurations)
        judged = {
            node.full_name: frozenset(each.name for each in node.expected_parameters)
            for node in plan.nodes
            if node.expected_parameters and node.full_name in present
        }
        self._parameters.listen(judged)
        answers = dict(
            await asyncio.gather(
                *(
                    self._ask(node)
                    for node in nodes
                    if node.full_name in planned and node.full_name not in self._configurations
                )
            )
        )
        if self._guests:
            answers.update(
                await asyncio.gather(
                    *(
                        self._ask_guest(node)
                        for node in nodes
                        if node.managed
                        and node.full_name not in planned
                        and not tolerating_pattern(node.full_name, plan.policy.tolerated_nodes)
                    )
                )
            )
        told = {name: configuration for name, (_, configuration) in answers.items()}
        self._checksums = {name: each.checksum for name, each in told.items() if each is not None}
        configurations = {**self._configurations, **told}
        reporting = {name for name, each in configurations.items() if _reports_parameters(each)}
        if await self._parameters.follow(sorted(judged.keys() - reporting), reporting=reporting):
            return await self.observe(plan)  # each node is waited for once
        return Observation(
            nodes=tuple(
                dataclasses.replace(
                    node, state=_state(node.full_name, answers, self._configurations)
                )
                for node in nodes
            ),
            endpoints=endpoints,
            configurations=tuple(each for each in configurations.values() if each is not None),
            parameters=self._parameters.latest,
        )

    def hear(self, node: str, checksum: str = "") -> None:
        """Take word, from any thread, that a node has changed: it is worth another look.

        Args:
            node: fully qualified; one whose configuration is put here tells us by itself.
            checksum: of its configuration, from a heartbeat: it has changed only if that is new.
        """
        if node in self._configurations or (checksum and self._checksums.get(node) == checksum):
            return
        self._wake()

    async def wait_change(self) -> None:
        """Wait until a burst of changes has passed, if any came since this or `observe` was called.

        Discovery, or a transition of a node that is asked, makes a change; a configuration that
        is put here makes none.
        """
        loop = self._bind()
        await self._changed.wait()
        end = loop.time() + self._burst_s
        while (left_s := end - loop.time()) > 0:
            self._changed.clear()
            if not await set_within(self._changed, min(self._quiet_s, left_s)):
                break
        self._changed.clear()

    def put_configuration(self, configuration: NodeConfiguration) -> None:
        """Give what a node reported over its control channel; it is not asked again.

        It stands until a newer one is put, the node leaves the graph or it is dropped.
        """
        self._configurations[configuration.name] = configuration

    def drop_configuration(self, node: str) -> None:
        """Forget what `node` (fully qualified) reported, because its process ended."""
        self._configurations.pop(node, None)

    def destroy(self) -> None:
        """Leave the graph."""
        self._remove()
        self._parameters.close()
        self._clients.destroy()
        self._graph.destroy()

    def __enter__(self) -> Observer:
        return self

    def __exit__(self, *_: object) -> None:
        self.destroy()

    async def _ask(self, node: ObservedNode) -> tuple[str, _Answer]:
        name = node.full_name
        self._asked.add(name)
        if not node.managed:
            return name, (None, await self._ask_configuration(name))
        self._clients.on_transition(name, self._wake)
        state, configuration = await asyncio.gather(
            self._ask_state(name), self._ask_configuration(name)
        )
        return name, (state, configuration)

    async def _ask_guest(self, node: ObservedNode) -> tuple[str, _Answer]:
        name = node.full_name
        configuration = await self._ask_configuration(name)
        if configuration is None:
            return name, (None, None)
        self._asked.add(name)
        self._clients.on_transition(name, self._wake)
        return name, (configuration.state, configuration)

    async def _ask_state(self, name: str) -> str | None:
        try:
            return await self._clients.get_state(name, timeout_s=_ASK_S)
        except MiddlewareError as error:
            _logger.info("state of %s unknown: %s", name, error)
            return None

    async def _ask_configuration(self, name: str) -> NodeConfiguration | None:
        try:
            return await self._clients.get_configuration(name, timeout_s=_ASK_S)
        except MiddlewareError as error:
            _logger.info("configuration of %s unknown: %s", name, error)
            return None

    def _forget_the_gone(self, names: Iterable[str]) -> None:
        """Drop what is held for nodes that were in the graph and are not any more."""
        present = frozenset(names)
        for name in self._seen - present:
            self._configurations.pop(name, None)
            self._parameters.forget(name)
            if name in self._asked:
                self._asked.discard(name)
                self._clients.forget(name)
        self._seen = present

    def _bind(self) -> asyncio.AbstractEventLoop:
        if self._loop is None:
            self._loop = asyncio.get_running_loop()
        return self._loop

    def _wake(self) -> None:
        # Any thread. Before the first use there is no loop, and nobody who waits.
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
                self._loop.call_soon_threadsafe(self._note)

    def _note(self) -> None:
        self._count += 1
        self._changed.set()


def _reports_parameters(configuration: NodeConfiguration | None) -> bool:
    return configuration is not None and configuration.parameters is not None


_Answer = tuple[str | None, NodeConfiguration | None]


def _state(
    name: str,
    answers: dict[str, _Answer],
    put: dict[str, NodeConfiguration],
) -> str | None:
    if name in put:
        return put[name].state
    return answers[name][0] if name in answers else None
