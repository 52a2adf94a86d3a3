"""Nodes of the plan that another supervisor brings up, on another machine.

Owns: `RemoteNode`, how far such a node is brought up as far as the graph and its own report show,
and `RemoteNodes`, which keeps that up to date. Nothing here is driven: each supervisor activates
its own. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Iterable
from typing import Protocol

from lifecycle.manifest import Condition
from lifecycle.plan import Plan, PlannedNode
from lifecycle.supervisor.nodes.driver import ACTIVE, INACTIVE
from lifecycle.verify import Observation

ASK_AGAIN_S = 0.2
"""A remote node is asked again so long after, because the event that it connected may be missed:
its announcer may not be matched yet."""


class ObservationSource(Protocol):
    """What a supervisor sees of the graph, see lifecycle.graph.Graph."""

    async def observe(self, plan: Plan) -> Observation:
        """Return what the graph holds now, nodes' own reports included."""


class ChangeSource(Protocol):
    """When it is worth looking again, see verification_loop.ChangeCounter."""

    @property
    def count(self) -> int:
        """Changes so far."""

    async def beyond(self, count: int, timeout_s: float | None) -> bool:
        """Wait for a change after `count`."""


class RemoteNode:
    """One node that another supervisor brings up.

    Attributes:
        reached: every condition that holds as of the last look.
        changed: replaced and set when `reached` changes.
    """

    def __init__(self, planned: PlannedNode) -> None:
        self.planned = planned
        self.reached: frozenset[Condition] = frozenset()
        self.changed = asyncio.Event()

    @property
    def name(self) -> str:
        """Fully qualified node name."""
        return self.planned.full_name

    def has_reached(self, condition: Condition) -> bool:
        """Whether the condition holds; for a node that is not managed all follow its start."""
        return condition in self.reached

    def see(self, observation: Observation) -> None:
        """Take what was seen, and notify who waits."""
        reached = frozenset(_conditions(self.planned, observation))
        if reached != self.reached:
            self.reached = reached
            self.changed.set()
            self.changed = asyncio.Event()


class RemoteNodes:
    """Looks at remote nodes while a node may wait for them."""

    def __init__(
        self,
        plan: Plan,
        nodes: Iterable[RemoteNode],
        observer: ObservationSource,
        changes: ChangeSource,
    ) -> None:
        self._nodes = tuple(nodes)
        # Ours report by themselves: only these have to be asked.
        self._plan = dataclasses.replace(plan, nodes=tuple(each.planned for each in self._nodes))
        self._observer = observer
        self._changes = changes

    async def follow(self) -> None:
        """Look at every change, until all have reached everything or this is cancelled."""
        while not all(each.has_reached(Condition.ACTIVE) for each in self._nodes):
            count = self._changes.count
            observation = await self._observer.observe(self._plan)
            for each in self._nodes:
                each.see(observation)
            # One that was not there at all announces itself.
            there = any(each.reached for each in self._nodes)
            await self._changes.beyond(count, ASK_AGAIN_S if there else None)


def _conditions(planned: PlannedNode, observation: Observation) -> Iterable[Condition]:
    name = planned.full_name
    observed = next((each for each in observation.nodes if each.full_name == name), None)
    if observed is None:
        return ()
    if not planned.managed:
        return tuple(Condition)
    report = next((each for each in observation.configurations if each.name == name), None)
    state = observed.state or (report.state if report is not None else "")
    if state == ACTIVE:
        return tuple(Condition)
    if state != INACTIVE:
        return (Condition.STARTED,)
    # A node that is not ours makes its data layer in configure, and has no such report.
    if report is None or report.connected:
        return (Condition.STARTED, Condition.CONFIGURED, Condition.CONNECTED)
    return (Condition.STARTED, Condition.CONFIGURED)
