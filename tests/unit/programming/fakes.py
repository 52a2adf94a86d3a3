"""A target and a tool that remember what was asked of them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import Any

from lifecycle.programming.host import Output
from lifecycle.programming.rules import FlowRule
from lifecycle.programming.target import ChangeKind, FlowChange, ProgrammingError, TargetChanges


class FakeTarget:
    """Holds rules as a network would."""

    def __init__(self, name: str = "fake") -> None:
        self.name = name
        self.rules: tuple[FlowRule, ...] = ()
        self.applied = 0
        self.fails = ""
        self.due_s: float | None = None

    async def plan(self, rules: Sequence[FlowRule]) -> TargetChanges:
        before = {each.key: each for each in self.rules}
        changes = []
        for each in rules:
            old = before.pop(each.key, None)
            kind = ChangeKind.CREATE if old is None else ChangeKind.UPDATE
            kind = ChangeKind.KEEP if old == each else kind
            changes.append(FlowChange(kind=kind, key=each.key, what=each.describe()))
        changes += [FlowChange(kind=ChangeKind.DELETE, key=key, what="") for key in before]
        return TargetChanges(target=self.name, changes=tuple(changes))

    async def apply(self, rules: Sequence[FlowRule]) -> TargetChanges:
        self.applied += 1
        if self.fails:
            raise ProgrammingError(self.fails)
        changes, self.rules = await self.plan(rules), tuple(rules)
        return changes

    async def remove(self) -> TargetChanges:
        return await self.apply(())

    async def renew(self) -> float | None:
        return self.due_s


class Waited:
    """A target, a programmer or a ledger whose coroutines are waited for."""

    def __init__(self, real: Any) -> None:
        self.real = real

    def __getattr__(self, name: str) -> Any:
        found = getattr(self.real, name)
        if not callable(found):
            return found

        def call(*args: Any, **given: Any) -> Any:
            done = found(*args, **given)
            return asyncio.run(done) if asyncio.iscoroutine(done) else done

        return call


class FakeTool:
    """Answers command lines; what is not answered succeeds silently.

    Attributes:
        answers: (words that begin a command line, what it leaves).
        lines: every command line, joined by spaces.
    """

    def __init__(self, *answers: tuple[str, Output | Callable[[], Output]]) -> None:
        self.answers = dict(answers)
        self.lines: list[str] = []

    async def run(self, argv: Sequence[str], *, stdin: str = "") -> Output:
        line = " ".join(argv)
        self.lines.append(line)
        for begins, answer in self.answers.items():
            if line.startswith(begins):
                return answer() if callable(answer) else answer
        return printed("")


def printed(stdout: str) -> Output:
    """What a program that succeeded leaves."""
    return Output((), 0, stdout, "")


def failed(stderr: str) -> Output:
    """What a program that failed leaves."""
    return Output((), 1, "", stderr)
