"""Which nodes that are not in our hosts do not answer: they hang, or nobody spins them.

Owns: `Answering`, which asks each such node every few seconds, one request at a time. Nodes of our
hosts are watched without asking, see liveliness.py. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from lifecycle.errors import MiddlewareError
from lifecycle.manifest import RunKind
from lifecycle.supervisor.control.protocol import Reach
from lifecycle.supervisor.nodes.system import NodeRun, System
from lifecycle.supervisor.run.events import Notice
from lifecycle.supervisor.run.failure import ended

if TYPE_CHECKING:
    from lifecycle.supervisor.nodes.observer_participant import ObserverParticipant

EVERY_S = 2.0
"""A node is asked again so long after it answered."""

ANSWER_S = 3.0
"""A callback may take 2 s and is no hang; a second request makes sure, and that no reply was lost.
With EVERY_S a hang is noticed within 8 s."""

TRIES = 2

SHOWN_S = 5.0
"""Discovery has shown the services of a node that is there for so long."""


class Answering:
    """Asks the nodes of others whether they answer, and has the system know who does not."""

    def __init__(self, system: System, asking: ObserverParticipant) -> None:
        self._system = system
        self._asking = asking
        self._said: set[str] = set()

    async def follow(self) -> None:
        """Ask, until this is cancelled. A node that is down or stopped is not asked."""
        tasks: dict[str, tuple[NodeRun, asyncio.Task[None]]] = {}
        try:
            while True:
                now = {each.name: each for each in self._system.nodes.values() if _is_asked(each)}
                for name, (node, task) in tuple(tasks.items()):
                    if now.get(name) is not node or task.done():
                        await ended(task)
                        del tasks[name]
                        self._system.liveliness.answered(name)
                new = [each for name, each in now.items() if name not in tasks]
                for index, node in enumerate(new):
                    wait_s = EVERY_S * (index + 1) / (len(new) + 1)
                    task = asyncio.ensure_future(self._follow(node, wait_s))
                    tasks[node.name] = node, task
                await asyncio.sleep(EVERY_S / 4)
        finally:
            await ended(*(task for _, task in tasks.values()))

    async def _follow(self, node: NodeRun, wait_s: float) -> None:
        liveliness = self._system.liveliness
        unanswered, unserved_s = 0, 0.0
        while True:
            await asyncio.sleep(wait_s)
            wait_s = EVERY_S
            if self._system.present is not None and node.name not in self._system.present:
                unanswered = 0
                liveliness.answered(node.name)
                continue
            if liveliness.is_out_of_reach(node.name):
                continue
            answers = await self._ask(node)
            if answers is None:
                unanswered, unserved_s = 0, unserved_s + EVERY_S
                liveliness.answered(node.name)
                if unserved_s >= SHOWN_S and node.name not in self._said:
                    self._said.add(node.name)
                    what = "~/get_state" if node.planned.managed else "parameters"
                    message = f"{node.name!r} serves no {what}: whether it hangs is not seen"
                    self._system.emit(Notice(message=message))
                continue
            unserved_s = 0.0
            if answers:
                unanswered = 0
                liveliness.answered(node.name)
                continue
            unanswered += 1
            wait_s = 0.0
            if unanswered >= TRIES:
                liveliness.unanswered(node.name, TRIES * ANSWER_S)
                wait_s = EVERY_S / 4

    async def _ask(self, node: NodeRun) -> bool | None:
        try:
            return await self._asking.answers(node.planned, timeout_s=ANSWER_S)
        except MiddlewareError:
            return None


def _is_asked(node: NodeRun) -> bool:
    """Whether a node is up, and in no host of ours; one in a transition answers after it."""
    if node.process is not None and node.process.planned.run.kind is RunKind.PYTHON:
        return False
    return node.reach not in (Reach.WAITING, Reach.STOPPED) and not node.doing
