"""Which nodes that are not in our hosts do not answer: they hang, or nobody spins them.

Owns: `Answering`, which asks each such node once it is up, and every few seconds from then on, one
request at a time; the gate waits for the first answers. Nodes of our hosts are watched without
asking, see liveliness.py. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from typing import TYPE_CHECKING

from lifecycle.errors import MiddlewareError
from lifecycle.graph.loop import set_within
from lifecycle.manifest.model import RunKind
from lifecycle.supervisor.core.state import Level
from lifecycle.supervisor.nodes.system import NodeRun, System
from lifecycle.supervisor.run.events import Notice
from lifecycle.supervisor.run.failure import ended

if TYPE_CHECKING:
    from lifecycle.middleware.services.clients import NodeClients

EVERY_S = 2.0
"""A node is asked again so long after it answered."""

ANSWER_S = 3.0
"""A callback may take 2 s and is no hang; a second request makes sure, and that no reply was lost.
With EVERY_S a hang is noticed within 8 s."""

TRIES = 2

SHOWN_S = 2.0
"""Discovery has shown the services of a node that is there for so long."""

_LOOK_S = 0.1
"""A node of which discovery shows no service yet is looked at so often, for SHOWN_S."""

_LATELY_S = 2 * EVERY_S
"""What a node answered so long ago at most is what it is now: it is being asked again, or soon."""

_GATE_S = TRIES * ANSWER_S + 1.0
_LEAST_S = 1.0


class Answering:
    """Asks the nodes of others whether they answer, and has the system know who does not."""

    def __init__(self, system: System, clients: NodeClients) -> None:
        self._system = system
        self._clients = clients
        self._said: set[str] = set()
        self._known_s: dict[str, float] = {}  # when it was known last of a node how it is
        self._known = asyncio.Event()
        self._hurry = asyncio.Event()

    async def follow(self) -> None:
        """Ask, until this is cancelled. A node that is down or stopped is not asked."""
        tasks: dict[str, tuple[NodeRun, asyncio.Task[None]]] = {}
        try:
            while True:
                self._hurry.clear()
                now = {each.name: each for each in self._system.nodes.values() if _is_asked(each)}
                for name, (node, task) in tuple(tasks.items()):
                    if now.get(name) is not node or task.done():
                        await ended(task)
                        del tasks[name]
                        self._known_s.pop(name, None)
                        if not node.doing:
                            self._system.liveliness.answered(name)
                new = [each for name, each in now.items() if name not in tasks]
                for index, node in enumerate(new):
                    # Side by side at first, and then in turns.
                    again_s = EVERY_S * (index + 1) / (len(new) + 1)
                    task = asyncio.ensure_future(self._follow(node, again_s))
                    tasks[node.name] = node, task
                await set_within(self._hurry, EVERY_S / 4)
        finally:
            await ended(*(task for _, task in tasks.values()))

    async def asked(self, timeout_s: float) -> bool:
        """Wait, bounded, until it is known of each node that is there whether it answers.

        Args:
            timeout_s: seconds; who has not answered by then counts as one that does not.

        Returns:
            Whether any had to be waited for: what was seen before is older than the answers.
        """
        loop = asyncio.get_running_loop()
        began_s = loop.time()
        limit_s = max(_LEAST_S, min(timeout_s, _GATE_S))
        waited = False
        while unknown := tuple(self._unknown()):
            waited = True
            left_s = began_s + limit_s - loop.time()
            if left_s <= 0:
                for each in unknown:
                    self._system.liveliness.unanswered(each.name, limit_s)
                break
            self._known.clear()
            self._hurry.set()
            await set_within(self._known, min(left_s, _LOOK_S))
        return waited

    def _unknown(self) -> Iterator[NodeRun]:
        """Yield the nodes of which it is not known how they are, and which are to be asked."""
        now_s = asyncio.get_running_loop().time()
        present, liveliness = self._system.present, self._system.liveliness
        for each in self._system.nodes.values():
            if each.is_hosted or each.is_gone or not _is_tried(each):
                continue
            if each.doing and each.core.level is not Level.DOWN:
                continue  # it answers after its transition
            if present is not None and each.name not in present:
                continue
            if liveliness.is_out_of_reach(each.name) or each.name in liveliness.unanswering:
                continue
            known_s = self._known_s.get(each.name)
            if known_s is None or now_s - known_s > _LATELY_S:
                yield each

    async def _follow(self, node: NodeRun, again_s: float) -> None:
        liveliness = self._system.liveliness
        loop = asyncio.get_running_loop()
        unanswered, shown_s, wait_s = 0, loop.time() + SHOWN_S, 0.0
        has_answered = False
        while True:
            await asyncio.sleep(wait_s)
            wait_s = EVERY_S
            if self._system.present is not None and node.name not in self._system.present:
                unanswered, shown_s = 0, loop.time() + SHOWN_S
                liveliness.answered(node.name)
                wait_s = EVERY_S if has_answered else _LOOK_S
                continue
            if liveliness.is_out_of_reach(node.name):
                continue
            answers = await self._ask(node, repeat=not has_answered)
            if answers is None:
                unanswered = 0
                liveliness.answered(node.name)
                if loop.time() < shown_s and not self._serves_nothing(node):
                    wait_s = _LOOK_S
                    continue
                self._know(node)
                self._say_that_it_serves_nothing(node)
            elif answers:
                unanswered = 0
                if not has_answered:
                    has_answered, wait_s = True, again_s
                liveliness.answered(node.name)
                self._know(node)
            else:
                unanswered += 1
                wait_s = 0.0
                if unanswered >= TRIES:
                    liveliness.unanswered(node.name, TRIES * ANSWER_S)
                    self._know(node)
                    wait_s = EVERY_S / 4

    def _know(self, node: NodeRun) -> None:
        self._known_s[node.name] = asyncio.get_running_loop().time()
        self._known.set()

    def _say_that_it_serves_nothing(self, node: NodeRun) -> None:
        if node.name not in self._said:
            self._said.add(node.name)
            what = "~/get_state" if node.planned.managed else "parameters"
            message = f"{node.name!r} serves no {what}: whether it hangs is not seen"
            self._system.emit(Notice(message=message))

    def _serves_nothing(self, node: NodeRun) -> bool:
        """Whether it is certain that a node has nothing that it can be asked by."""
        serves = self._clients.serves_parameters(node.name)
        return not node.planned.managed and serves is False

    async def _ask(self, node: NodeRun, *, repeat: bool) -> bool | None:
        try:
            return await self._clients.answers(
                node.name, managed=node.planned.managed, timeout_s=ANSWER_S, repeat=repeat
            )
        except MiddlewareError:
            return None


def _is_tried(node: NodeRun) -> bool:
    """Whether a node is up, or may be there unseen: a command says nothing of itself."""
    command = node.planned.run.kind is RunKind.COMMAND and not node.planned.managed
    process = node.process
    return node.is_up or (command and process is not None and process.pid != 0)


def _is_asked(node: NodeRun) -> bool:
    """Whether a node is up, and in no host of ours; one in a transition answers after it."""
    return not node.is_hosted and node.core.level is not Level.DOWN and not node.doing
