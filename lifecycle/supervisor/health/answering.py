"""Which nodes that are not in our hosts do not answer: they hang, or nobody spins them.

Owns: `Answering`, which asks each such node once it is up, and every few seconds from then on, one
request at a time; the gate waits for the first answers. Nodes of our hosts are watched without
asking, see liveliness.py. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from lifecycle.errors import MiddlewareError
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
        self._known_s: dict[NodeRun, float] = {}  # when it was known last of a node how it is
        self._tasks: dict[NodeRun, asyncio.Task[None]] = {}

    async def follow(self) -> None:
        """Ask, until this is cancelled. A node that is down or stopped is not asked."""
        liveliness = self._system.liveliness
        try:
            while True:
                nodes = self._reachable()
                for node in [each for each in self._tasks if each not in nodes]:
                    await ended(self._tasks.pop(node))
                    self._known_s.pop(node, None)
                    if not (node.doing or liveliness.is_out_of_reach(node.name)):
                        liveliness.answered(node.name)
                for node in nodes:
                    if self._age_s(node) >= EVERY_S:
                        self._begin(node)
                await asyncio.sleep(EVERY_S / 4)
        finally:
            await ended(*self._tasks.values())

    async def asked(self, timeout_s: float) -> bool:
        """Wait, bounded, until it is known of each node that is there whether it answers.

        Args:
            timeout_s: seconds; who has not answered by then counts as one that does not.

        Returns:
            Whether any had to be waited for: what was seen before is older than the answers.
        """
        loop, liveliness = asyncio.get_running_loop(), self._system.liveliness
        limit_s = max(_LEAST_S, min(timeout_s, _GATE_S))
        until_s = loop.time() + limit_s
        waited = False
        while tasks := {
            self._begin(each): each
            for each in self._reachable()
            if each.name not in liveliness.unanswering and self._age_s(each) > _LATELY_S
        }:
            waited = True
            _, late = await asyncio.wait(tasks, timeout=max(0.0, until_s - loop.time()))
            for each in late:
                liveliness.unanswered(tasks[each].name, limit_s)
        return waited

    def _reachable(self) -> list[NodeRun]:
        """Return the nodes that can be asked now, and are in no host of ours."""
        present, liveliness = self._system.present, self._system.liveliness
        return [
            each
            for each in self._system.nodes.values()
            if _is_up(each)
            and (present is None or each.name in present)
            and not liveliness.is_out_of_reach(each.name)
        ]

    def _age_s(self, node: NodeRun) -> float:
        """Return since how long ago it is known how a node is; infinity if it is not."""
        return asyncio.get_running_loop().time() - self._known_s.get(node, float("-inf"))

    def _begin(self, node: NodeRun) -> asyncio.Task[None]:
        """Have a node asked, by one request at a time."""
        task = self._tasks.get(node)
        if task is None or task.done():
            task = self._tasks[node] = asyncio.ensure_future(self._ask(node))
        return task

    async def _ask(self, node: NodeRun) -> None:
        """Learn whether a node answers; one that shows no service may do so in a moment."""
        loop, liveliness = asyncio.get_running_loop(), self._system.liveliness
        is_new, shown_s = node not in self._known_s, loop.time() + SHOWN_S
        managed = node.planned.managed
        for _ in range(TRIES):
            while (answers := await self._answers(node, repeat=is_new)) is None:
                liveliness.answered(node.name)
                is_sure = not managed and self._clients.serves_parameters(node.name) is False
                if is_sure or not is_new or loop.time() >= shown_s:
                    if node.name not in self._said:
                        self._said.add(node.name)
                        what = "~/get_state" if managed else "parameters"
                        text = f"{node.name!r} serves no {what}: whether it hangs is not seen"
                        self._system.emit(Notice(message=text))
                    break
                await asyncio.sleep(_LOOK_S)
            if answers is not False:
                liveliness.answered(node.name)
                break
        else:
            liveliness.unanswered(node.name, TRIES * ANSWER_S)
        self._known_s[node] = loop.time()

    async def _answers(self, node: NodeRun, *, repeat: bool) -> bool | None:
        try:
            return await self._clients.answers(
                node.name, managed=node.planned.managed, timeout_s=ANSWER_S, repeat=repeat
            )
        except MiddlewareError:
            return None


def _is_up(node: NodeRun) -> bool:
    """Whether a node in no host of ours is up, or may be there unseen; one in a step is not."""
    if node.is_hosted or node.is_gone:
        return False
    if node.core.level is not Level.DOWN:
        return not node.doing
    # A command says nothing of itself.
    command = node.planned.run.kind is RunKind.COMMAND and not node.planned.managed
    return command and node.process is not None and node.process.pid != 0
