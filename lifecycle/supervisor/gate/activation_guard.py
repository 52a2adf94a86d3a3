"""Deactivates managed nodes that others activate while the gate is closed for them.

Owns: `ActivationGuard`: which active nodes were not asked to be, how often they are deactivated
again, and the finding that keeps the gate closed until they are inactive. Nodes in our hosts refuse
by themselves (node/author/managed.py); others obey every client. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from typing import TYPE_CHECKING

from msgspec.structs import replace

from lifecycle.errors import BringUpError
from lifecycle.manifest.model import RunKind
from lifecycle.node.host.control import Operation
from lifecycle.plan.model import Plan
from lifecycle.supervisor.control.protocol import Reach
from lifecycle.supervisor.nodes.driver import ACTIVE
from lifecycle.supervisor.nodes.system import NodeRun, System
from lifecycle.supervisor.run.events import Notice
from lifecycle.supervisor.run.failure import ended
from lifecycle.verify.observation import Observation
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.state import ACTIVATED_AT_CLOSED_GATE
from lifecycle.verify.verdict import Finding

if TYPE_CHECKING:
    from lifecycle.graph.graph import Graph
    from lifecycle.supervisor.gate.verification_loop import ChangeCounter

TRIES = 5
"""A node that is activated again and again is not deactivated for ever: its finding stays."""

BY_ITSELF = "was activated by its own code or another client while the gate is closed"

TO_DO = (
    "leave its activation to the supervisor: remove trigger_activate or change_state from its "
    "code, and end the client that asks for it"
)


class ActivationGuard:
    """Watches over the managed nodes that were brought up, and not asked to activate."""

    def __init__(self, system: System) -> None:
        self._system = system
        self._tries: dict[str, int] = {}
        self._given_up: set[str] = set()
        self._deactivating: dict[str, asyncio.Task[None]] = {}

    def look(self, observation: Observation) -> None:
        """Deactivate at once what is active without the gate having let it through."""
        states = {each.full_name: each.state for each in observation.nodes}
        self._given_up &= {name for name, state in states.items() if state == ACTIVE}
        for node in self._system.nodes.values():
            if node.planned.managed and node.is_let_through:
                self._tries.pop(node.name, None)
                self._given_up.discard(node.name)
            elif states.get(node.name) == ACTIVE and _is_held(node):
                self._deactivate(node)

    @property
    def has_given_up(self) -> bool:
        """Whether a node was activated again more often than it is deactivated."""
        return bool(self._given_up)

    def findings(self) -> tuple[Finding, ...]:
        """Return a finding for each node whose deactivation is not over, or is given up."""
        return tuple(
            ACTIVATED_AT_CLOSED_GATE.on_node(
                Outcome.VIOLATED,
                node.planned,
                expected="inactive",
                observed="activated by its own code or another client",
                message=f"cannot accept node {node.name}: it {BY_ITSELF}; "
                + (
                    f"it was deactivated {TRIES} times; {TO_DO}"
                    if node.name in self._given_up
                    else "it is being deactivated"
                ),
            )
            for node in self._system.nodes.values()
            if node.name in self._deactivating or node.name in self._given_up
        )

    async def follow(self, observer: Graph, changes: ChangeCounter) -> None:
        """Look at every change, for as long as no verdict is made: until this is cancelled."""
        while True:
            count = changes.count
            foreign = _foreign(self._system.plan, self._system.nodes.values())
            if foreign is None:
                return
            self.look(await observer.observe(foreign))
            await changes.beyond(count, None)

    async def close(self) -> None:
        """Stop deactivating: the system is taken down."""
        await ended(*self._deactivating.values())

    def _deactivate(self, node: NodeRun) -> None:
        tries = self._tries.get(node.name, 0)
        if node.name in self._deactivating:
            return
        if tries >= TRIES:
            self._given_up.add(node.name)
            return
        self._tries[node.name] = tries + 1
        text = f"{node.name!r} {BY_ITSELF}: "
        if tries + 1 < TRIES:
            text += "it is deactivated"
        else:
            text += f"it is deactivated for the last time, after {tries} times in vain"
        self._system.emit(Notice(message=text))
        self._deactivating[node.name] = asyncio.ensure_future(self._ask(node))
        # No earlier verdict is valid: holders of a permit ask again.
        self._system.touched.set()

    async def _ask(self, node: NodeRun) -> None:
        limit_s = node.planned.timeouts.deactivate_s
        try:
            condition = await asyncio.wait_for(node.perform(Operation.DEACTIVATE), limit_s)
            node.report(condition.state, connected=condition.connected)
        except asyncio.TimeoutError:
            what = f"cannot deactivate {node.name!r} within {limit_s:g} s"
            self._system.emit(Notice(message=what))
        except BringUpError as error:
            self._system.emit(Notice(message=error.message))
        finally:
            self._deactivating.pop(node.name, None)
            # Judged again: its finding is gone, and where it is active still it is asked again.
            self._system.touched.set()


def _is_held(node: NodeRun) -> bool:
    """Whether we brought a node up, and it waits for the gate."""
    return node.driver is not None and node.reach in (Reach.CONFIGURED, Reach.CONNECTED)


def _foreign(plan: Plan, nodes: Iterable[NodeRun]) -> Plan | None:
    """Return the plan of the managed nodes that are not in our hosts; None without any."""
    found = tuple(
        each.planned
        for each in nodes
        if each.planned.managed
        # Not by its control channel: a process of ours has none before it is started.
        and (each.process is None or each.process.planned.run.kind is not RunKind.PYTHON)
    )
    return replace(plan, nodes=found) if found else None
