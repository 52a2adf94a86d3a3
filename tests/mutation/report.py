"""Say what `make mutate` found: the score, and every mutant that survived and is not justified.

A mutant is one small change of the code that judges. It is killed when a test fails with it. One
that no test needs to notice is listed in justified/ beside this file, with the reason; one that
changes words for people alone does not count.

Usage: python -m tests.mutation.report [--at-least PERCENT]
Exit code 1 if the score is lower, or a survivor is not justified.
"""

from __future__ import annotations

import argparse
import ast
import collections
import contextlib
import dataclasses
import difflib
import functools
import json
import re
import sys
import textwrap
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import yaml

_ROOT = Path(__file__).parents[2]
_KILLED = (1, 3)
"""mutmut's exit codes: a test failed, or could not be collected."""

_TIMED_OUT = (24, 36, 152, 255, -24)
"""Killed too, if the mutant waits for ever; on a busy machine one may only have been slow."""

_SURVIVED = (0, 33)
"""Every test passed; no test reaches the function. All other codes decide nothing."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Mutant:
    """One change.

    Attributes:
        module: the mutated module, which holds all its mutants.
        key: mutmut's name of it, for `mutmut show`.
        place: `lifecycle.verify.judge._blocks`, `lifecycle.supervisor.core.gate.is_open`.
        exit_code: what mutmut noted; None if it was not tried.
    """

    module: Path
    key: str
    place: str
    exit_code: int | None

    @property
    def killed(self) -> bool:
        """Whether a test noticed."""
        return self.exit_code in (*_KILLED, *_TIMED_OUT)

    @property
    def survived(self) -> bool:
        """Whether all tests passed; what was broken off is neither killed nor survived."""
        return self.exit_code in _SURVIVED

    @property
    def outcome(self) -> str:
        """What became of it, in a word."""
        if self.killed:
            return "timed out" if self.exit_code in _TIMED_OUT else "killed"
        return "survived" if self.survived else f"undecided ({self.exit_code})"

    @property
    def texts(self) -> tuple[str, str]:
        """The function before and after the change, both under its name before."""
        functions = _functions(self.module)
        name = self.key.rpartition(".")[2]
        original = re.sub(r"_\d+$", "_orig", name)
        return functions[original], functions[name].replace(name, original)

    def change(self) -> str:
        """Return the lines that it removes and adds, each with `-` or `+`, stripped."""
        before, after = self.texts
        lines = difflib.unified_diff(before.splitlines(), after.splitlines(), n=0, lineterm="")
        changed = [line for line in lines if not line.startswith(("---", "+++", "@@"))]
        return "\n".join(f"{line[0]} {line[1:].strip()}" for line in changed)

    @property
    def is_wording(self) -> bool:
        """Whether it changes words for people alone: a text with a blank in it decides nothing."""
        before, after = map(_without_words, self.texts)
        return before == after

    def reasons(self, allowed: Mapping[str, Sequence[str]]) -> list[str]:
        """Return which entries of `justified` are of the lines that it adds, or else removes."""
        change = self.change().splitlines()
        for sign in "+-":
            lines = " ".join(line[1:] for line in change if line.startswith(sign)).split()
            if lines:
                return [each for each in allowed.get(self.place, ()) if each in " ".join(lines)]
        return []


def _without_words(function: str) -> str:
    """Return a function's syntax tree as text, without the texts that have a blank in them."""
    tree = ast.parse(textwrap.dedent(function))
    for each in ast.walk(tree):
        if isinstance(each, ast.Constant) and isinstance(each.value, str) and " " in each.value:
            each.value = ""
    return ast.dump(tree)


@functools.cache
def _functions(module: Path) -> dict[str, str]:
    """Return the text of every function of a mutated module, by name."""
    source = module.read_text(encoding="utf-8")
    lines = source.splitlines()
    return {
        each.name: "\n".join(lines[each.lineno - 1 : each.end_lineno])
        for each in ast.walk(ast.parse(source))
        if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef)
    }


def mutants() -> Iterator[Mutant]:
    """Yield every mutant, tried or not."""
    for meta in sorted((_ROOT / "mutants").rglob("*.meta")):
        for key, exit_code in _results(meta).items():
            place = re.sub(r"__mutmut_\d+$", "", key)
            place = re.sub(r"\.xǁ(\w+?)ǁ", r".\1.", place).replace(".x_", ".")
            yield Mutant(module=meta.with_suffix(""), key=key, place=place, exit_code=exit_code)


def _results(meta: Path) -> dict[str, int | None]:
    """Read what mutmut noted of a module; while it runs it writes the file in place."""
    for _ in range(20):
        with contextlib.suppress(json.JSONDecodeError):
            results: dict[str, int | None] = json.loads(meta.read_text("utf-8"))["exit_code_by_key"]
            return results
        time.sleep(0.1)
    print(f"skipped: {meta} is being written; ask again once mutmut has ended")
    return {}


def justified() -> dict[str, list[str]]:
    """Return what may survive: for each place the texts that a changed line may contain."""
    allowed: dict[str, list[str]] = collections.defaultdict(list)
    for path in sorted((Path(__file__).parent / "justified").glob("*.yaml")):
        for entry in yaml.safe_load(path.read_text("utf-8")):
            for change in entry["changes"]:
                allowed[entry["place"]].append(" ".join(change.split()))
    return allowed


def main() -> int:
    """Print the report."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--at-least", type=float, default=0.0, metavar="PERCENT")
    options = parser.parse_args()
    allowed = justified()
    needed: set[tuple[str, str]] = set()
    unsure: set[str] = set()
    modules: dict[str, collections.Counter[str]] = {}
    left = 0
    for mutant in mutants():
        name = ".".join(mutant.module.relative_to(_ROOT / "mutants").with_suffix("").parts)
        counts = modules.setdefault(name, collections.Counter())
        if mutant.exit_code is None:
            counts["not tried"] += 1
            unsure.add(mutant.place)
            continue
        if not mutant.killed and mutant.is_wording:
            counts["wording"] += 1
            continue
        counts["tried"] += 1
        if mutant.killed:
            counts["killed"] += 1
            counts["timed out"] += mutant.outcome == "timed out"
            continue
        reasons = mutant.reasons(allowed)
        if reasons and mutant.survived:
            needed |= {(mutant.place, each) for each in reasons}
            counts["justified"] += 1
        else:
            left += 1
            print(f"{mutant.outcome}: {mutant.key}\n{mutant.change()}\n")
    for place, reasons in allowed.items():
        for each in reasons:
            if place not in unsure and (place, each) not in needed:
                print(f"justified for nothing: {place}: {each}")
    total = sum(modules.values(), collections.Counter())
    if not total["tried"]:
        print("nothing was tried: run `make mutate` first")
        return 1
    for name, counts in (*sorted(modules.items()), ("all", total)):
        if counts["tried"]:
            print(
                f"{name}: {counts['killed'] / counts['tried']:.1%} of {counts['tried']} killed,"
                f" {counts['timed out']} of them by time; {counts['justified']} justified,"
                f" {counts['wording']} of wording survived and do not count"
                + (f"; {counts['not tried']} not tried" if counts["not tried"] else "")
            )
    score = 100 * total["killed"] / total["tried"]
    print(f"score: {score:.1f} %, {left} not justified")
    return int(bool(left) or score < options.at_least)


if __name__ == "__main__":
    sys.exit(main())
