"""Failed processes of a running system: their history, when each is started again, its watchdog.

Owns: `RestartSchedule`: it takes failures, asks each process's RestartPolicy, and knows which nodes
are due to be started again. Starting them is gate/sequence.py's, through the gate as for a restart
by hand. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import datetime as dt
import signal
from collections.abc import Collection, Iterable

import msgspec
from msgspec.structs import replace

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import Restart
from lifecycle.supervisor.control.protocol import Failed, ProcessState
from lifecycle.supervisor.health.liveliness import Cause
from lifecycle.supervisor.nodes.bring_up import died
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.policy.restart import RestartPolicy, group_of
from lifecycle.supervisor.processes.process import ManagedProcess, ProcessExit
from lifecycle.supervisor.run.events import (
    Emitter,
    Event,
    GaveUp,
    ProcessChanged,
    Restarted,
    RestartScheduled,
)
from lifecycle.supervisor.run.failure import StepFailedError
from lifecycle.verify.rules.run import GAVE_UP, PROCESS_DIED

_REMEMBERED = 20
"""Failures of one process; a limit on what a report repeats, not on what is counted."""


class GaveUpError(StepFailedError):
    """A process failed too often: the system is taken down. Exit code 7."""

    exit_code = ExitCode.SUPERVISION_GAVE_UP


class _Record(msgspec.Struct):
    """One process over all of its lives.

    Attributes:
        failed: the ManagedProcess of the last failure, whose last words may come a moment later.
        since_s: when it was last away; None while it is as it should be.
    """

    policy: RestartPolicy
    history: list[Failed]
    failed: ManagedProcess | None = None
    since_s: float | None = None


class _Entry(msgspec.Struct, frozen=True):
    """Nodes that are to be started again at a time.

    Attributes:
        process: the one that failed; empty for who was only interrupted on its way.
    """

    process: str
    keys: frozenset[str]
    due_s: float


class RestartSchedule:
    """Knows what is to be started again in one system, and when.

    Args:
        system: whose processes.
        emit: where events go, and whose clock counts.

    Attributes:
        was_up: the system was as far as it is to be; set by who brings it up.
    """

    def __init__(self, system: System, emit: Emitter) -> None:
        self._system = system
        self._emit = emit
        self._records: dict[str, _Record] = {}
        self._entries: list[_Entry] = []
        self._changed = asyncio.Event()
        self._written_off: set[str] = set()
        self._returning: set[str] = set()
        self._watchdogs: dict[str, asyncio.TimerHandle] = {}
        self._barked: dict[str, str] = {}
        self._reported: set[ManagedProcess] = set()
        self._closed = False
        self.was_up = False
        system.liveliness.listen(self._look_at_silent)
        emit.listen(self._on_event)

    # What fails

    def _on_event(self, event: Event) -> None:
        if isinstance(event, ProcessChanged) and event.state is ProcessState.EXITED:
            process = self._system.processes.get(event.process)
            if process is not None and process.pid == event.pid:
                asyncio.get_running_loop().call_soon(self._report, process)

    def _report(self, process: ManagedProcess) -> None:
        """Report a death at once, also while something else is being taken down or started.

        A step on one of its nodes says more about it, and is left to do so.
        """
        nodes = [self._system.nodes[key] for key in process.planned.nodes]
        if self._closed or not process.died or any(each.doing for each in nodes):
            return
        failure = died(process, nodes[0] if len(nodes) == 1 else None)
        if self.covers(failure):
            self._reported.add(process)
            for each in failure.every:
                self._emit(each.event(ends_run=False))

    def covers(self, failure: StepFailedError) -> bool:
        """Whether all that failed is to be started again as far as the manifest says."""
        causes = [each for each in failure.every if each.process not in self._written_off]
        return bool(causes) and all(self._taken_by(each) is not None for each in causes)

    def write_off(self, process: str) -> None:
        """Note that a process stays dead, and that the run goes on without it."""
        self._written_off.add(process)

    def take(self, failure: StepFailedError) -> frozenset[str]:
        """Take a failure that is covered; return the keys of the nodes that go down for it.

        Raises:
            GaveUpError: one of the processes has failed too often.
        """
        now_s = self._emit.elapsed_s
        down: set[str] = set()
        for cause in failure.every:
            process = self._taken_by(cause)
            if process is None or any(each.process == process.name for each in self._entries):
                continue
            record = self._record(process)
            record.history.append(self._failed(cause, process, now_s))
            del record.history[:-_REMEMBERED]
            record.failed = process
            record.since_s = now_s if record.since_s is None else record.since_s
            due_s = record.policy.failed(now_s, was_up=self.was_up)
            if process in self._reported:
                self._reported.discard(process)
            else:
                self._emit(cause.event(ends_run=False))
            if due_s is None:
                raise self._gave_up(process.name, record, failure)
            keys = frozenset(
                group_of((each.planned for each in self._system.nodes.values()), process.name)
            )
            self._add(_Entry(process.name, keys, due_s))
            down |= keys
        return frozenset(down)

    def announce(self, keys: Collection[str]) -> None:
        """Report, once they are down, when the failed among these nodes are started again."""
        now_s = self._emit.elapsed_s
        for entry in self._entries:
            if entry.process and entry.keys <= set(keys):
                record = self._records[entry.process]
                last = self._last(record)
                assert last is not None
                self._emit(
                    RestartScheduled(
                        process=entry.process,
                        nodes=self._names(entry.keys),
                        reason=last.message,
                        stderr=last.stderr,
                        restarts=record.policy.restarts,
                        in_s=max(0.0, entry.due_s - now_s),
                    )
                )

    def again(self, keys: Iterable[str]) -> None:
        """Have nodes started again at once that were interrupted on their way, and did not fail."""
        if found := frozenset(keys):
            self._add(_Entry("", found, self._emit.elapsed_s))

    # What comes again

    @property
    def down(self) -> frozenset[str]:
        """Full names of the nodes that are down until they are started again."""
        return frozenset(self._names({key for entry in self._entries for key in entry.keys}))

    @property
    def away(self) -> frozenset[str]:
        """Full names of the nodes that are down, or were started again and are not through yet."""
        return self.down | frozenset(self._names(self._returning))

    async def due(self) -> None:
        """Return once there is something to begin; never while there is nothing."""
        while not self._ready():
            now_s = self._emit.elapsed_s
            waits = [each.due_s - now_s for each in self._entries if each.due_s > now_s]
            changed = self._changed
            try:
                await asyncio.wait_for(changed.wait(), max(0.001, min(waits)) if waits else None)
            except asyncio.TimeoutError:
                continue

    def begin(self) -> tuple[str, ...]:
        """Return the keys of the nodes that are to be started again now.

        A node that goes down with several processes comes again with the last of them.
        """
        now_s = self._emit.elapsed_s
        keys = self._ready()
        left: list[_Entry] = []
        failed = set[str]()
        for entry in self._entries:
            own = {key for key in keys if self._system.nodes[key].planned.process == entry.process}
            begins = bool(own & entry.keys) and entry.due_s <= now_s
            if begins:
                failed.add(entry.process)
            if entry.keys - keys:
                process = "" if begins else entry.process
                left.append(replace(entry, process=process, keys=entry.keys - keys))
        begun = {self._system.nodes[key].process for key in keys}
        for again in (each for each in begun if each is not None):
            policy = self._record(again).policy
            policy.started(now_s, after_failure=again.name in failed)
        self._entries = left
        self._returning |= keys
        return tuple(key for key in self._system.nodes if key in keys)

    def gone_with(self, keys: Collection[str]) -> frozenset[str]:
        """Return the keys of the nodes that went down with these, and wait for nothing else."""
        names = {self._system.nodes[key].planned.process for key in keys}
        own = {key for each in self._entries if each.process in names for key in each.keys}
        others = {key for each in self._entries if each.process not in names for key in each.keys}
        return frozenset(own - others)

    def by_hand(self, keys: Collection[str]) -> None:
        """Note that a person starts nodes again: whose process is among them begins anew."""
        self._entries = [
            replace(entry, keys=entry.keys - set(keys))
            for entry in self._entries
            if entry.keys - set(keys)
        ]
        for name in {self._system.nodes[key].planned.process for key in keys}:
            if (record := self._records.get(name)) is not None:
                record.policy.reset(self._emit.elapsed_s)
                record.since_s = None
        self._returning -= set(keys)

    def wait_at_gate(self, keys: Iterable[str]) -> None:
        """Have nodes activated with those that come again, as soon as their gate allows it."""
        self._returning |= set(keys)

    def returned(self, keys: Collection[str]) -> None:
        """Note that nodes are as far again as they should be."""
        now_s = self._emit.elapsed_s
        waiting = {key for entry in self._entries for key in entry.keys}
        for name, record in self._records.items():
            own = [key for key, each in self._system.nodes.items() if each.planned.process == name]
            if record.since_s is None or not set(own) & set(keys) or waiting & set(own):
                continue
            self._emit(
                Restarted(
                    process=name,
                    nodes=self._names(own),
                    restarts=record.policy.restarts,
                    took_s=now_s - record.since_s,
                )
            )
            record.since_s = None
        self._returning -= set(keys)

    @property
    def returning(self) -> frozenset[str]:
        """Full names of the nodes that were started again and wait for their gate."""
        return frozenset(self._names(self._returning)) - self.down

    # What is known

    def restarts(self, process: str) -> int:
        """Return how often a process was started again."""
        record = self._records.get(process)
        return 0 if record is None else record.policy.restarts

    def last_failure(self, process: str) -> Failed | None:
        """Return the last failure of a process; None if there was none."""
        record = self._records.get(process)
        return None if record is None else self._last(record)

    def next_try_s(self, process: str) -> float | None:
        """Return in how many seconds a process is started again; None if that is not planned."""
        keys = {key for key, each in self._system.nodes.items() if each.planned.process == process}
        due = [each.due_s for each in self._entries if each.keys & keys]
        return max(0.0, max(due) - self._emit.elapsed_s) if due else None

    def summary(self) -> str:
        """Say in one line what was started again; empty if nothing was."""
        counts = [
            f"{name!r} {each.policy.restarts} time{'s' * (each.policy.restarts != 1)}"
            for name, each in self._records.items()
            if each.policy.restarts
        ]
        return f"restarted: {', '.join(counts)}" if counts else ""

    def close(self) -> None:
        """Begin nothing any more."""
        self._closed = True
        self._entries = []
        for each in self._watchdogs.values():
            each.cancel()
        self._watchdogs.clear()

    def _taken_by(self, cause: StepFailedError) -> ManagedProcess | None:
        """Return the process that a failure is of, if that is to be started again after it.

        A component that cannot be loaded, or fails in a step, is its container's failure.
        """
        process = self._system.processes.get(cause.process)
        if process is None:
            node = self._system.node_named(cause.subject)
            if node is not None and node.planned.run.component:
                node = self._system.nodes.get(node.planned.run.container)
            process = None if node is None else node.process
        if process is None or not process.planned.nodes:
            return None
        died = cause.rule == PROCESS_DIED and process.ended.done()
        status = process.ended.result().status if died else None
        return process if self._record(process).policy.takes(exit_status=status) else None

    def _record(self, process: ManagedProcess) -> _Record:
        how = self._system.nodes[process.planned.nodes[0]].planned.supervision
        record = self._records.get(process.name)
        if record is None or record.policy.how != how:
            policy = RestartPolicy(how, process.started_s)
            history = [] if record is None else record.history
            record = self._records[process.name] = _Record(policy, history)
        return record

    def _failed(self, cause: StepFailedError, process: ManagedProcess, now_s: float) -> Failed:
        end = process.ended.result() if process.ended.done() else ProcessExit()
        message = cause.message
        if barked := self._barked.pop(process.name, ""):
            message = f"{message}: {barked}"
        return Failed(
            rule=cause.rule.id,
            subject=cause.subject,
            message=message,
            exit_status=end.status,
            signal=end.signal_name,
            elapsed_s=now_s,
            at=dt.datetime.now(dt.timezone.utc).isoformat(timespec="milliseconds"),
        )

    @staticmethod
    def _last(record: _Record) -> Failed | None:
        if not record.history:
            return None
        stderr = "" if record.failed is None else record.failed.last_stderr
        return msgspec.structs.replace(record.history[-1], stderr=stderr)

    def _gave_up(self, name: str, record: _Record, failure: StepFailedError) -> GaveUpError:
        how = record.policy.how
        history = record.history[-how.start_limit_burst :]
        each_time = "; ".join(f"at {each.elapsed_s:.1f} s, {each.message}" for each in history)
        last = record.history[-1]
        burst = how.start_limit_burst
        within = f"within {how.start_limit_interval_sec:g} s" if self.was_up else "during bring-up"
        message = (
            f"cannot keep {name!r} running: it was started {burst} time{'s' * (burst != 1)} "
            f"{within} (start_limit_burst, start_limit_interval_sec) and failed again: {each_time}"
        )
        self._emit(
            GaveUp(process=name, restarts=record.policy.restarts, history=tuple(record.history))
        )
        error = GaveUpError(
            message, rule=GAVE_UP, subject=last.subject, process=name, log=failure.log
        )
        error.gone = failure.gone
        return error

    def _add(self, entry: _Entry) -> None:
        self._entries.append(entry)
        self._changed.set()
        self._changed = asyncio.Event()

    def _ready(self) -> frozenset[str]:
        now_s = self._emit.elapsed_s
        due = {key for each in self._entries if each.due_s <= now_s for key in each.keys}
        later = {key for each in self._entries if each.due_s > now_s for key in each.keys}
        return frozenset(due - later)

    def _names(self, keys: Collection[str]) -> tuple[str, ...]:
        return tuple(each.name for key, each in self._system.nodes.items() if key in keys)

    # Watchdog

    def _look_at_silent(self) -> None:
        """Have processes ended that are stopped or hang for too long."""
        causes = (Cause.HUNG, Cause.STOPPED)
        silent = {
            name: why
            for cause in causes
            for name, why in self._system.liveliness.causes(cause).items()
        }
        hung: dict[str, tuple[ManagedProcess, str, float]] = {}
        for name, why in silent.items():
            node = self._system.node_named(name)
            if node is None or node.process is None:
                continue
            how = node.planned.supervision
            if how.restart is not Restart.NO and how.watchdog_sec:
                hung[node.process.name] = (node.process, why, how.watchdog_sec)
        for name in self._watchdogs.keys() - hung.keys():
            self._watchdogs.pop(name).cancel()
        for name, (process, why, limit_s) in hung.items():
            if name not in self._watchdogs:
                loop = asyncio.get_running_loop()
                self._watchdogs[name] = loop.call_later(limit_s, self._bark, process, why, limit_s)

    def _bark(self, process: ManagedProcess, why: str, limit_s: float) -> None:
        self._watchdogs.pop(process.name, None)
        if process.child is None or process.state is not ProcessState.RUNNING:
            return
        self._barked[process.name] = f"its watchdog ended it after {limit_s:g} s, because {why}"
        process.child.signal(signal.SIGKILL)
