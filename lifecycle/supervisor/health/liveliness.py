"""Which nodes are silent: stopped, hung, or out of reach.

Owns: `SilenceMonitor`, which turns what is noticed of processes and machines into events, findings
and the status of nodes. Nothing here waits or asks: the kernel says that a process was stopped or
that an executor hangs (middleware/process/busy_sign.py), DDS that a machine is lost. A process
that ended is not silent but dead: shell/processes.py. Must not import rclpy.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import TYPE_CHECKING

import msgspec
from msgspec.structs import replace

from lifecycle.middleware.process.busy_sign import Overdue
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
    from lifecycle.supervisor.processes.process import ManagedProcess


class Cause(enum.Enum):
    """Why nothing can be expected of a node; a node may have several at once."""

    STOPPED = "stopped"
    HUNG = "hung"
    UNSERVED = "unserved"
    LOST = "lost"
    REPORTED = "told"


class _Silence(msgspec.Struct):
    since_s: float
    causes: dict[Cause, str]
    hangs_since_s: float = 0.0


class SilenceMonitor:
    """Knows the silent nodes of a system.

    Args:
        emit: where events go.
        changed: called whenever a node fell silent or came back: time to judge again.
        is_there: whether a node has started, and is in the graph as far as that is known.
    """

    def __init__(
        self,
        emit: Emitter,
        changed: Callable[[], None],
        is_there: Callable[[str], bool] = lambda _: True,
    ) -> None:
        self._emit = emit
        self._is_there = is_there
        self._listeners = [changed]
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

    def fell_silent(
        self, nodes: Iterable[str], cause: Cause, detail: str, *, busy_s: float = 0.0
    ) -> None:
        """Note that nodes are silent.

        Args:
            nodes: their names.
            cause: why.
            detail: half a sentence.
            busy_s: seconds for which a callback of theirs has been running.
        """
        news = False
        for name in nodes:
            silence = self._silent.get(name)
            if silence is None:
                silence = self._silent[name] = _Silence(self._emit.elapsed_s, {cause: detail})
                self._emit(NodeSilent(node=name, cause=cause.value, message=_message(name, detail)))
                news = True
            elif cause not in silence.causes:
                silence.causes[cause] = detail
                news = True
            else:
                continue
            if cause is Cause.HUNG:
                silence.hangs_since_s = self._emit.elapsed_s - busy_s
        if news:
            self._tell()

    def came_back(self, nodes: Iterable[str], cause: Cause) -> None:
        """Note that a cause is gone; a node without another one is alive."""
        news = False
        for name in nodes:
            silence = self._silent.get(name)
            if silence is None or silence.causes.pop(cause, None) is None:
                continue
            news = True
            if not silence.causes:
                del self._silent[name]
                silent_s = self._emit.elapsed_s - silence.since_s
                there = self._is_there(name)
                self._emit(NodeAlive(node=name, silent_s=silent_s, there=there))
        if news:
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

    def watch_over(
        self, process: ManagedProcess, nodes: Iterable[str]
    ) -> Callable[[Overdue | None], None]:
        """Follow a process that is about to be spawned.

        Returns:
            What its control channel calls when its executor is busy for too long, or came back.
        """
        names = tuple(nodes)

        def stopped(is_stopped: bool) -> None:
            if is_stopped:
                detail = f"its process {process.name!r} (pid {process.pid}) was stopped by a signal"
                self.fell_silent(names, Cause.STOPPED, detail)
            else:
                self.came_back(names, Cause.STOPPED)

        def hung(why: Overdue | None) -> None:
            where = f"its process {process.name!r} (pid {process.pid})"
            if why is Overdue.HANGS:
                assert process.channel is not None
                assert process.channel.sign is not None
                sign = process.channel.sign
                limit_s, busy_s = sign.limit_s, sign.busy_s
                what = f" {sign.what}" if sign.what else ""
                at = process.where()
                detail = (
                    f"a callback{what} in {where} has been running for more than {limit_s:g} s"
                    f"{at and f', in {at}'}"
                )
                self.fell_silent(names, Cause.HUNG, detail, busy_s=busy_s)
            elif why is Overdue.UNSERVED:
                detail = f"{where} gets no processor for its callback: the machine is overloaded"
                self.fell_silent(names, Cause.UNSERVED, detail)
            if why is not Overdue.HANGS:
                self.came_back(names, Cause.HUNG)
            if why is not Overdue.UNSERVED:
                self.came_back(names, Cause.UNSERVED)

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
        """Return a verdict that says for how long nodes have hung by now."""
        found = []
        for each in verdict.findings:
            silence = self._silent.get(each.subject)
            if each.rule == SILENT_NODE.id and silence and Cause.HUNG in silence.causes:
                busy_s = self._emit.elapsed_s - silence.hangs_since_s
                message = f"{_message(each.subject, _why(silence))}; {busy_s:.1f} s by now"
                each = replace(each, message=message)  # noqa: PLW2901
            found.append(each)
        return replace(verdict, findings=tuple(found))


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
