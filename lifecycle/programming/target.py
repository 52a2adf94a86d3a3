"""What a network target is, what it changes, how long it is waited for, and what can go wrong."""

from __future__ import annotations

import abc
import asyncio
import contextlib
import enum
import importlib
import math
import threading
import time
from collections.abc import Callable, Coroutine, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import msgspec

from lifecycle.errors import ExitCode, LifecycleError, UsageError
from lifecycle.programming import TARGETS
from lifecycle.programming.rules import FlowRule, RuleSet

if TYPE_CHECKING:
    from lifecycle.programming.ledger import Ledger, TargetRecord

T = TypeVar("T")
R = TypeVar("R")

_TAKEN = {("tc",): ("device", "rate", "guarantee"), ("nef", "camara"): ("config",)}
"""Targets → options that only they take."""


class ChangeKind(enum.Enum):
    """What happens to one flow."""

    CREATE = "create"
    UPDATE = "update"
    DELETE = "delete"
    KEEP = "keep"


_SIGNS = dict(zip(ChangeKind, "+~-=", strict=True))


class FlowChange(msgspec.Struct, frozen=True, kw_only=True):
    """One flow in one target.

    Attributes:
        key: of the FlowRule.
        what: the rule for people, `udp 10.77.0.1:17900 → 10.77.0.2:17910, EF = DSCP 46 …`.
        detail: why, or what came of it: "gone from the server", "granted for 600 s".
    """

    kind: ChangeKind
    key: str
    what: str = ""
    detail: str = ""


class TargetChanges(msgspec.Struct, frozen=True, kw_only=True):
    """What one target has to do, or did.

    Attributes:
        target: for people: "nft table inet flowqos_teleop", "tc on eth0".
        left_out: flows that this target cannot express, each with its reason.
        warnings: what people should know, whole sentences.
    """

    target: str
    changes: tuple[FlowChange, ...] = ()
    left_out: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def pending(self) -> bool:
        """Whether there is anything to do."""
        return any(each.kind is not ChangeKind.KEEP for each in self.changes)

    def render(self, *, done: bool = False) -> str:
        """Return the changes as text, one line per flow; `done` if they were made."""
        kinds = [each.kind for each in self.changes]
        counts = [
            f"{number} {kind.value}d" if done else f"{number} to {kind.value}"
            for kind in ChangeKind
            if kind is not ChangeKind.KEEP and (number := kinds.count(kind))
        ]
        counts.append(f"{kinds.count(ChangeKind.KEEP)} unchanged")
        lines = [f"{self.target}: {', '.join(counts)}"]
        for each in self.changes:
            detail = f" ({each.detail})" if each.detail else ""
            what = f": {each.what}" if each.what else ""
            lines.append(f"  {_SIGNS[each.kind]} {each.key}{what}{detail}")
        lines += [f"  left out: {reason}" for reason in self.left_out]
        lines += [f"  warning: {warning}" for warning in self.warnings]
        return "\n".join(lines)


_CANCEL_CHECK_S = 0.05


class Patience:
    """Bounds all that one programmer asks of servers; without end until `within`.

    One thread works, another cancels.

    Args:
        attempts: at most so many requests.
        first_s: wait before the second, then doubled each time.
        longest_s: longest single wait of our own choice.
        total_s: one request with all its attempts, and all waits between them; a Retry-After beyond
            it is not waited for.

    Attributes:
        cancelled: set while work is to end at once.
    """

    def __init__(
        self,
        *,
        attempts: int = 5,
        first_s: float = 0.5,
        longest_s: float = 8.0,
        total_s: float = 60.0,
    ) -> None:
        self.attempts, self.first_s = attempts, first_s
        self.longest_s, self.total_s = longest_s, total_s
        self._until_s = math.inf
        self.cancelled = threading.Event()

    def now_s(self) -> float:
        """Return seconds since the epoch."""
        return time.time()

    def steady_s(self) -> float:
        """Return seconds since the host was started, on a clock that only goes forward."""
        return time.clock_gettime(time.CLOCK_BOOTTIME)

    def sleep(self, seconds: float) -> None:
        """Wait, or until it is cancelled."""
        self.cancelled.wait(seconds)

    @contextlib.contextmanager
    def within(self, seconds: float | None) -> Iterator[None]:
        """Bound what is done inside, None by nothing; an outer bound holds as well."""
        outer_s = self._until_s
        if seconds is not None:
            self._until_s = min(outer_s, time.monotonic() + seconds)
        try:
            yield
        finally:
            self._until_s = outer_s

    def left_s(self) -> float:
        """Return the seconds that are left: 0 if none are, infinity if there is no bound."""
        return 0.0 if self.cancelled.is_set() else max(0.0, self._until_s - time.monotonic())

    def run(self, work: Coroutine[Any, Any, T], most_s: float) -> T:
        """Run a coroutine to its end, or cancel it after `most_s`, or once there is no time left.

        Raises:
            TimeoutError: there was no time left.
        """
        # Not asyncio.run, which waits for names that are still looked up.
        loop = asyncio.new_event_loop()
        task = loop.create_task(work)
        try:
            with self.within(most_s):
                loop.run_until_complete(self._bounded(task))
            if not task.done():
                raise TimeoutError
            return task.result()
        finally:
            if task.cancel():
                loop.run_until_complete(asyncio.wait([task]))
            loop.run_until_complete(loop.shutdown_asyncgens())  # of an answer that is cut off
            loop.close()

    async def _bounded(self, task: asyncio.Task[Any]) -> None:
        while not task.done() and (left_s := self.left_s()) > 0:
            await asyncio.wait({task}, timeout=min(left_s, _CANCEL_CHECK_S))


class Means(msgspec.Struct, frozen=True):
    """What targets are opened with.

    Attributes:
        ledger: of the system.
        patience: with servers, of all targets together.
    """

    ledger: Ledger
    patience: Patience = msgspec.field(default_factory=Patience)


class Target(abc.ABC):
    """A network that can be programmed with flow rules, and everything of ours in it.

    Args:
        settings: what `read` or `restore` returned.

    Attributes:
        kind: name of the target.
        hint: how to give what it cannot do without; empty if there is nothing such.
        settings_type: of its key in the settings file of servers; None if it is no server.
        name: for people: "nft table inet flowqos_teleop".
    """

    kind: ClassVar[str]
    hint: ClassVar[str] = ""
    settings_type: ClassVar[type[msgspec.Struct] | None] = None
    name: str

    def __init__(self, settings: Any, means: Means) -> None:
        self._settings = settings
        self._ledger = means.ledger

    @classmethod
    def read(cls, given: Mapping[str, Any]) -> Any:  # noqa: ARG003 - most take some
        """Read the values of the options it takes; what is missing, None or empty was not given.

        Raises:
            UsageError: something is missing, or they do not fit together.
        """
        return None

    @classmethod
    @abc.abstractmethod
    def restore(cls, record: TargetRecord) -> Any:
        """Return settings that are good enough to remove what a ledger's record lists.

        The record has to be enough, long after the options are forgotten.

        Raises:
            SettingsError: the settings file is gone, or is of another server now.
        """

    @abc.abstractmethod
    def export(self, rules: RuleSet) -> str:
        """Return what the network would be given, as text, and what is left out of it.

        Raises:
            ValueError: the rates of a device do not fit.
        """

    @classmethod
    def token_variables(cls, settings: Any) -> frozenset[str]:  # noqa: ARG003 - servers have some
        """Return the environment variables that hold tokens."""
        return frozenset()

    @abc.abstractmethod
    def plan(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Compare what should be with what is; changes nothing."""

    @abc.abstractmethod
    def apply(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Make it so, and return what was done; a second time changes nothing."""

    def remove(self) -> TargetChanges:
        """Delete everything of ours."""
        return self.apply(())

    def renew(self) -> float | None:
        """Prolong what would expire; return seconds until the next time, None if never."""
        return None


class Chosen(msgspec.Struct, frozen=True):
    """A network that a person asked for, with what he said of it."""

    target: type[Target]
    settings: Any

    def open(self, means: Means) -> Target:
        """Return the target.

        Raises:
            UsageError: the options or the settings file cannot be used.
        """
        return self.target(self.settings, means)


def target_kind(name: str) -> type[Target]:
    """Return the class of a target.

    Raises:
        UsageError: there is no such target.
    """
    if name not in TARGETS:
        raise UsageError(f"cannot program target {name!r}; use {', '.join(TARGETS)}")
    kind: type[Target] = importlib.import_module(f"{__package__}.{name}").TARGET
    return kind


def read_targets(
    names: Iterable[str], given: Mapping[str, Any], *, option: str = "--target"
) -> tuple[Chosen, ...]:
    """Return the targets that a person asked for, with their options.

    Raises:
        UsageError: they do not fit together.
    """
    chosen = tuple(dict.fromkeys(names))
    for those, flags in _TAKEN.items():
        if not {*those} & {*chosen} and any(given.get(each) for each in flags):
            needs = _either([f"--{each}" for each in flags])
            raise UsageError(f"cannot use {needs} without {option} {_either(those)}")
    kinds = map(target_kind, chosen)
    return tuple(Chosen(each, each.read(given)) for each in kinds)


def _either(words: Sequence[str]) -> str:
    *most, last = words
    return f"{', '.join(most)} or {last}" if most else last


def each_done(
    things: Iterable[T], do: Callable[[T], R]
) -> tuple[list[R], list[tuple[T, LifecycleError]]]:
    """Do it to each, whatever becomes of the others; return what was done, and what failed."""
    done: list[R] = []
    failed: list[tuple[T, LifecycleError]] = []
    for each in things:
        try:
            done.append(do(each))
        except LifecycleError as error:  # noqa: PERF203 - the others go on
            failed.append((each, error))
    return done, failed


class ProgrammingError(LifecycleError):
    """A network refused, or could not be reached or read; or what is there is not ours."""

    exit_code = ExitCode.BRING_UP_FAILED


class SettingsError(UsageError):
    """The settings file of the HTTP targets cannot be read, or what it points to."""


class HttpError(ProgrammingError):
    """An HTTP interface refused or failed.

    Attributes:
        status: HTTP status; 0 if there was no answer.
        uncertain: the request may have taken effect all the same.
        again: it may be asked again.
        after_s: how long the server asks to wait before that; None if it does not say.
    """

    def __init__(
        self,
        message: str,
        *,
        status: int = 0,
        uncertain: bool = False,
        again: bool = False,
        after_s: float | None = None,
        hint: str = "",
    ) -> None:
        super().__init__(message, hint=hint)
        self.status = status
        self.uncertain = uncertain
        self.again = again
        self.after_s = after_s


class PartlyError(ProgrammingError):
    """Some flows or targets could not be programmed; the others are.

    Attributes:
        done: what was done all the same and is there now, as text for people, one per target.
    """

    def __init__(
        self,
        target: str,
        total: int,
        errors: Sequence[tuple[str, LifecycleError]],
        *,
        done: Sequence[str] = (),
    ) -> None:
        lines = "".join(f"\n  {key}{': ' if key else ''}{error}" for key, error in errors)
        made = "\n".join(("\ndone all the same:", *done)) if done else ""
        super().__init__(f"cannot make {len(errors)} of {total} changes to {target}:{lines}{made}")
        self.done = tuple(done)

    def __str__(self) -> str:
        """The message ends with lists, so a hint has a line of its own."""
        return f"{self.message}\n{self.hint}" if self.hint else self.message
