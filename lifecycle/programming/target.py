"""What a network target is, what it changes, and what can go wrong."""

from __future__ import annotations

import abc
import enum
import importlib
import math
import time
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import msgspec

from lifecycle.errors import ExitCode, LifecycleError, UsageError
from lifecycle.programming import TARGETS
from lifecycle.programming.rules import FlowRule, RuleSet, Treatment

if TYPE_CHECKING:
    from lifecycle.programming.ledger import Ledger, TargetRecord

T = TypeVar("T")
R = TypeVar("R")


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
    """

    target: str
    changes: tuple[FlowChange, ...] = ()
    left_out: tuple[str, ...] = ()

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
        return "\n".join(lines)


class Means:
    """What targets are opened with: the ledger of the system, and how long servers may take.

    Attributes:
        until_s: when all that servers are asked must have been answered, on the clock of
            time.monotonic.
    """

    def __init__(self, ledger: Ledger) -> None:
        self.ledger = ledger
        self.until_s = math.inf

    def begin(self, within_s: float | None) -> None:
        """Give servers so long from now on; None bounds each request only."""
        self.until_s = math.inf if within_s is None else time.monotonic() + within_s

    def left_s(self) -> float:
        """Return the seconds that are left: 0 if none are, infinity if there is no bound."""
        return max(0.0, self.until_s - time.monotonic())


class Target(abc.ABC):
    """A network that can be programmed with flow rules, and everything of ours in it.

    Args:
        settings: what `read` or `restore` returned.

    Attributes:
        kind: name of the target.
        takes: options that it reads.
        hint: how to give what it cannot do without; empty if there is nothing such.
        name: for people: "nft table inet flowqos_teleop".
    """

    kind: ClassVar[str]
    takes: ClassVar[tuple[str, ...]] = ()
    hint: ClassVar[str] = ""
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
    async def plan(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Compare what should be with what is; changes nothing."""

    @abc.abstractmethod
    async def apply(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Make it so, and return what was done; a second time changes nothing.

        Cancelled, what it may have made is in the ledger.
        """

    async def remove(self) -> TargetChanges:
        """Delete everything of ours."""
        return await self.apply(())

    async def renew(self) -> float | None:
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


class Program(msgspec.Struct, frozen=True):
    """The networks that a person asked for, and what flows get in them."""

    targets: tuple[Chosen, ...]
    treatment: Treatment = Treatment()

    @property
    def token_variables(self) -> frozenset[str]:
        """The environment variables that hold tokens."""
        found = (each.target.token_variables(each.settings) for each in self.targets)
        return frozenset[str]().union(*found)


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
    kinds = [target_kind(each) for each in dict.fromkeys(names)]
    taken = {flag for each in kinds for flag in each.takes}
    for flag, value in given.items():
        if value and flag not in taken:
            chosen = ", ".join(each.kind for each in kinds)
            why = f"with {option} {chosen}" if chosen else f"without {option}"
            raise UsageError(f"cannot use --{flag} {why}")
    return tuple(Chosen(each, each.read(given)) for each in kinds)


async def each_done(
    things: Iterable[T], do: Callable[[T], Awaitable[R]]
) -> tuple[list[R], list[tuple[T, LifecycleError]]]:
    """Do it to each, whatever becomes of the others; return what was done, and what failed."""
    done: list[R] = []
    failed: list[tuple[T, LifecycleError]] = []
    for each in things:
        try:
            done.append(await do(each))
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
    """

    def __init__(
        self, message: str, *, status: int = 0, uncertain: bool = False, hint: str = ""
    ) -> None:
        super().__init__(message, hint=hint)
        self.status = status
        self.uncertain = uncertain


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
