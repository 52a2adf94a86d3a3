"""Waiting until discovery shows a node, or no longer does.

Owns: `Sightings`. Looked at again whenever anything changes, and never otherwise.
"""

from __future__ import annotations

import asyncio

from lifecycle.supervisor.gate.verification_loop import Changes
from lifecycle.supervisor.nodes.observer_participant import ObserverParticipant
from lifecycle.supervisor.nodes.system import System

_LEASE_S = 21.0
"""Fast DDS forgets a participant that left without a word after 20 s, by default."""


class Sightings:
    """Who is in the graph of one system, as an event to wait for."""

    def __init__(
        self, system: System, observer_participant: ObserverParticipant, changes: Changes
    ) -> None:
        self._system = system
        self._observer_participant = observer_participant
        self._changes = changes

    async def appears(self, name: str) -> None:
        """Wait until discovery shows a node of this name; the caller sets the limit."""
        while True:
            count = self._changes.count
            if await self._is_there(name):
                return
            await self._changes.beyond(count, None)

    async def vanishes(self, name: str) -> None:
        """Wait until discovery shows no node of this name, or its lease must have run out."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + _LEASE_S
        while (left_s := deadline - loop.time()) > 0:
            count = self._changes.count
            if not await self._is_there(name):
                return
            await self._changes.beyond(count, left_s)

    async def _is_there(self, name: str) -> bool:
        observation = await self._observer_participant.observe(self._system.plan)
        return any(each.full_name == name for each in observation.nodes)
