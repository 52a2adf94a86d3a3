"""Which nodes are silent: stopped, hung, or out of reach; and which do not answer.

Owns: `SilenceMonitor`, which turns what is noticed of processes and machines into events, findings
and the status of nodes. It neither waits nor asks: the kernel says that a process was stopped or
that an executor hangs (middleware/process/busy_sign.py), DDS that a machine is lost. A process
that ended is not silent but dead: shell/processes.py. And `Answering`: nodes that are not in our
hosts are asked once they are up, and every few seconds from then on, one request at a time; the
gate waits for the first answers. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import enum
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import TYPE_CHECKING

import msgspec
from msgspec.structs import replace

from lifecycle.errors import MiddlewareError
from lifecycle.graph.loop import ended
from lifecycle.manifest.model import RunKind
from lifecycle.supervisor.core.state import Level
from lifecycle.supervisor.run.events import (
    Emitter,
    NodeAlive,
    NodeJoined,
    NodeLeft,
    NodeSilent,
    Notice,
)
from lifecycle.verify.observation import Observation
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import NOT_ANSWERING, SILENT_NODE
from lifecycle.verify.tool_filter import is_hidden_node, tolerating_pattern
from lifecycle.verify.verdict import Finding, Verdict

if TYPE_CHECKING:
    from lifecycle.middleware.services.clients import NodeClients
    from lifecycle.supervisor.nodes.system import NodeRun, System
    from lifecycle.supervisor.processes.process import ManagedProcess


class Cause(enum.Enum):
    """Why nothing can be expected of a node; a node may have several at once."""

    STOPPED = "stopped"
    HUNG = "hung"
    LOST = "lost"
    REPORTED = "told"


class _Silence(msgspec.Struct):
    since_s: float
    causes: dict[Cause, str]


class SilenceMonitor:
    """Knows the silent nodes of a system.

    Args:
        emit: where events go.
        is_there: whether a node has started, and is in the graph as far as that is known.
    """

    def __init__(self, emit: Emitter, is_there: Callable[[str], bool] = lambda _: True) -> None:
        self._emit = emit
        self._is_there = is_there
        self._listeners: list[Callable[[], None]] = []
        self._silent: dict[str, _Silence] = {}
        self._unanswering: dict[str, Finding] = {}

    @property
    def silent(self) -> Mapping[str, str]:
        """Fully qualified names of the silent nodes, and why each is."""
        return {name: _why(silence) for name, silence in self._silent.items()}

    def causes(self, cause: Cause) -> Mapping[str, str]:
        """Return the nodes that are silent because of `cause`, and its details."""
        return {
            name: silence.causes[cause]
            for name, silence in self._silent.items()
            if cause in silence.causes
        }

    def is_out_of_reach(self, node: str) -> bool:
        """Whether asking the node for anything is in vain; one that hangs may come back in time."""
        silence = self._silent.get(node)
        return silence is not None and bool({Cause.STOPPED, Cause.LOST} & silence.causes.keys())

    def note(self, nodes: Iterable[str], cause: Cause, why: str) -> None:
        """Note why nodes are silent, half a sentence; empty once that cause of it is gone.

        A node without another cause is alive then.
        """
        now_s, is_news = self._emit.elapsed_s, False
        for name in nodes:
            silence = self._silent.get(name)
            if bool(why) is (silence is not None and cause in silence.causes):
                continue
            is_news = True
            if silence is None:
                silence = self._silent[name] = _Silence(now_s, {cause: why})
                self._emit(NodeSilent(node=name, cause=cause.value, message=_message(name, why)))
            if why:
                silence.causes[cause] = why
                continue
            del silence.causes[cause]
            if not silence.causes:
                del self._silent[name]
                silent_s, there = now_s - silence.since_s, self._is_there(name)
                self._emit(NodeAlive(node=name, silent_s=silent_s, there=there))
        if is_news:
            self._tell()

    def unanswered(self, node: str, after_s: float) -> None:
        """Note that a node that is in no host of ours has answered no request for so long."""
        if node not in self._unanswering:
            found = self._unanswering[node] = not_answering(node, after_s)
            self._emit(Notice(message=found.message))
            self._tell()

    @property
    def unanswering(self) -> Collection[str]:
        """Names of the nodes that have answered no request."""
        return self._unanswering.keys()

    def answered(self, node: str) -> None:
        """Note that it answers, or is not asked any more."""
        if self._unanswering.pop(node, None) is not None:
            self._emit(Notice(message=f"{node!r} answers again"))
            self._tell()

    def forget(self, nodes: Iterable[str]) -> None:
        """Drop what is known of nodes whose process ended."""
        for name in nodes:
            self._silent.pop(name, None)
            self._unanswering.pop(name, None)

    def watch_over(self, process: ManagedProcess, nodes: Iterable[str]) -> Callable[[bool], None]:
        """Follow a process that is about to be spawned.

        Returns:
            What its control channel calls when its executor hangs, or came back.
        """
        names = tuple(nodes)

        def stopped(is_stopped: bool) -> None:
            why = f"its process {process.name!r} (pid {process.pid}) was stopped by a signal"
            self.note(names, Cause.STOPPED, why if is_stopped else "")

        def hung(is_hung: bool) -> None:
            hangs = ""
            if is_hung:
                assert process.channel is not None
                assert process.channel.sign is not None
                sign = process.channel.sign
                what = f" {sign.what}" if sign.what else ""
                at = process.where()
                hangs = (
                    f"a callback{what} in its process {process.name!r} (pid {process.pid}) has "
                    f"been running for more than {sign.limit_s:g} s{at and f', in {at}'}"
                )
            self.note(names, Cause.HUNG, hangs)

        process.on_stop = stopped
        process.ended.add_done_callback(lambda _: self.forget(names))
        return hung

    def listen(self, listener: Callable[[], None]) -> None:
        """Have `listener` called whenever a node fell silent or came back."""
        self._listeners.append(listener)

    def _tell(self) -> None:
        for listener in self._listeners:
            listener()

    def findings(self) -> tuple[Finding, ...]:
        """Return one finding for each silent node, and one if we receive nothing ourselves."""
        return tuple(
            SILENT_NODE.finding(
                outcome=Outcome.VIOLATED,
                subject=name,
                expected="alive",
                observed=", ".join(cause.value for cause in silence.causes),
                message=_message(name, _why(silence)),
                node=name,
            )
            for name, silence in sorted(self._silent.items())
        ) + tuple(
            found for name, found in sorted(self._unanswering.items()) if name not in self._silent
        )

    def by_now(self, verdict: Verdict) -> Verdict:
        """Return a verdict that says for how long silent nodes have been so by now."""

        def said(finding: Finding) -> Finding:
            silence = self._silent.get(finding.subject)
            if finding.rule != SILENT_NODE.id or silence is None:
                return finding
            silent_s = self._emit.elapsed_s - silence.since_s
            return replace(finding, message=f"{finding.message}; {silent_s:.1f} s by now")

        return replace(verdict, findings=tuple(map(said, verdict.findings)))


def arrivals(before: Collection[str], observation: Observation, emit: Emitter) -> frozenset[str]:
    """Say which nodes joined and left the graph since `before`; return those that are there.

    Hidden nodes, whose names begin with an underscore, are left out, as are tools: the one are
    participants of nodes that are reported anyway, the other are in the verdict.
    """
    names = (each.full_name for each in observation.nodes)
    present = frozenset(
        each for each in names if not is_hidden_node(each) and not tolerating_pattern(each)
    )
    for name in sorted(present - set(before)):
        emit(NodeJoined(node=name))
    for name in sorted(set(before) - present):
        emit(NodeLeft(node=name))
    return present


def _why(silence: _Silence) -> str:
    return ", and ".join(silence.causes.values())


def not_answering(node: str, after_s: float) -> Finding:
    """Return the finding of a node in no host of ours that answered no request for so long."""
    why = f"it has answered no request for {after_s:g} s: it hangs, or nobody spins it"
    return NOT_ANSWERING.finding(
        outcome=Outcome.UNVERIFIABLE,
        subject=node,
        expected="alive",
        observed="no answer",
        message=_message(node, why),
        node=node,
    )


def _message(name: str, why: str) -> str:
    return f"cannot rely on {name!r}: {why}"


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

        Who has not answered in time counts as one that does not. Returns whether any had to be
        waited for: what was seen before is older than the answers.
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
