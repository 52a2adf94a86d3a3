"""What a network target is, what it would change or has changed, and what can go wrong.

Owns: `Target`, which plans, applies and removes; its answers and their text; the errors of this
package. Pure.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Sequence
from typing import Protocol

import msgspec

from lifecycle.errors import ExitCode, LifecycleError, UsageError
from lifecycle.programming.rules.rules import FlowRule, asks


class ChangeKind(enum.Enum):
    """What happens to one flow."""

    CREATE = "create"
    UPDATE = "update"
    DELETE = "delete"
    KEEP = "keep"


_SIGNS = {
    ChangeKind.CREATE: "+",
    ChangeKind.UPDATE: "~",
    ChangeKind.DELETE: "-",
    ChangeKind.KEEP: "=",
}


class FlowChange(msgspec.Struct, frozen=True, kw_only=True):
    """One flow in one target.

    Attributes:
        key: of the FlowRule.
        what: the rule for people, `udp 10.77.0.1:17900 → 10.77.0.2:17910, EF = DSCP 46 …`.
        detail: why, or what came of it: "gone from the server", "granted for 600 s".
    """

    kind: ChangeKind
    key: str
    what: str
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

    def of(self, kind: ChangeKind) -> tuple[FlowChange, ...]:
        """Return the changes of one kind."""
        return tuple(each for each in self.changes if each.kind is kind)

    def render(self, *, done: bool = False) -> str:
        """Return the changes as text, one line per flow.

        Args:
            done: they have been made.
        """
        words = ("created", "updated", "deleted") if done else ("create", "update", "delete")
        kinds = (ChangeKind.CREATE, ChangeKind.UPDATE, ChangeKind.DELETE)
        counts = [
            f"{len(found)} {'' if done else 'to '}{word}"
            for word, kind in zip(words, kinds, strict=True)
            if (found := self.of(kind))
        ]
        counts.append(f"{len(self.of(ChangeKind.KEEP))} unchanged")
        lines = [f"{self.target}: {', '.join(counts)}"]
        for each in self.changes:
            detail = f" ({each.detail})" if each.detail else ""
            what = f": {each.what}" if each.what else ""
            lines.append(f"  {_SIGNS[each.kind]} {each.key}{what}{detail}")
        lines += [f"  left out: {reason}" for reason in self.left_out]
        lines += [f"  warning: {warning}" for warning in self.warnings]
        return "\n".join(lines)


class Target(Protocol):
    """A network that can be programmed with flow rules, and everything of ours in it.

    A target touches only what its ledger or a mark of its own says is ours.
    """

    @property
    def name(self) -> str:
        """For people: "nft table inet flowqos_teleop"."""
        ...

    def plan(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Compare what should be with what is; changes nothing."""
        ...

    def apply(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Make it so, and return what was done; a second time changes nothing."""
        ...

    def dry_run(self, rules: Sequence[FlowRule]) -> str:
        """Return what would be sent, checked as far as that is possible; changes nothing."""
        ...

    def remove(self) -> TargetChanges:
        """Delete everything of ours."""
        ...

    def renew(self) -> float | None:
        """Prolong what would expire; return seconds until the next time, None if never."""
        ...


def describe_rule(rule: FlowRule) -> str:
    """Return a rule for people: the tuple and what it gets."""
    return f"{rule.describe()}, {asks(rule)}"


def deletions(target: str, entries: Iterable[tuple[str, str]], detail: str = "") -> TargetChanges:
    """Return the removal of (key, what) pairs as changes."""
    return TargetChanges(
        target=target,
        changes=tuple(
            FlowChange(kind=ChangeKind.DELETE, key=key, what=what, detail=detail)
            for key, what in entries
        ),
    )


class ProgrammingError(LifecycleError):
    """A network refused, or could not be reached or read."""

    exit_code = ExitCode.BRING_UP_FAILED


class PrivilegeError(ProgrammingError):
    """A command needs a privilege that this process lacks."""


class MissingFeatureError(ProgrammingError):
    """The kernel or the machine lacks something: a queueing discipline, a classifier, a program."""


class NotOursError(ProgrammingError):
    """An object that is not ours is in the way; it is never touched."""


class SettingsError(UsageError):
    """The settings file of the HTTP targets cannot be read, or what it points to."""


class HttpError(ProgrammingError):
    """An HTTP interface refused or failed.

    Attributes:
        status: HTTP status; 0 if there was no answer.
        uncertain: the request may have taken effect all the same.
    """

    def __init__(
        self,
        message: str,
        *,
        status: int = 0,
        uncertain: bool = False,
        hint: str = "",
    ) -> None:
        super().__init__(message, hint=hint)
        self.status = status
        self.uncertain = uncertain


class PartlyError(ProgrammingError):
    """Some flows or targets could not be programmed; the others are.

    Attributes:
        errors: one per flow or target.
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
        self.errors = tuple(errors)
        self.done = tuple(done)

    def __str__(self) -> str:
        """The message ends with lists, so a hint has a line of its own."""
        return f"{self.message}\n{self.hint}" if self.hint else self.message
