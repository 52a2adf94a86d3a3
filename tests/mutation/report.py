"""Say what `make mutate` found: the score, and every mutant that survived and is not justified.

A mutant is one small change of the code that judges. It is killed when a test fails with it. One
that no test needs to notice is listed in justified/ beside this file, with the reason.

Usage: python -m tests.mutation.report [--at-least PERCENT]
Exit code 1 if the score is lower, or a survivor is not justified.
"""

from __future__ import annotations

import argparse
import ast
import collections
import dataclasses
import difflib
import functools
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import yaml

_ROOT = Path(__file__).parents[2]
_SURVIVED = (0, 33)
"""mutmut's exit codes: every test passed; no test reaches the function."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Mutant:
    """One change.

    Attributes:
        module: the mutated module, which holds all its mutants.
        key: mutmut's name of it, for `mutmut show`.
        place: `lifecycle.verify.judge._blocks`, `lifecycle.supervisor.gate.Gate.judge`.
        survived: no test noticed.
    """

    module: Path
    key: str
    place: str
    survived: bool

    def change(self) -> str:
        """Return the lines that it removes and adds, each with `-` or `+`, stripped."""
        functions = _functions(self.module)
        name = self.key.rpartition(".")[2]
        before = functions[re.sub(r"_\d+$", "_orig", name)]
        after = functions[name].replace(name, re.sub(r"_\d+$", "_orig", name))
        lines = difflib.unified_diff(before.splitlines(), after.splitlines(), n=0, lineterm="")
        changed = [line for line in lines if not line.startswith(("---", "+++", "@@"))]
        return "\n".join(f"{line[0]} {line[1:].strip()}" for line in changed)


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
    """Yield every mutant that was tried in the last run."""
    for meta in sorted((_ROOT / "mutants").rglob("*.meta")):
        results = json.loads(meta.read_text(encoding="utf-8"))["exit_code_by_key"]
        for key, exit_code in results.items():
            if exit_code is not None:
                place = re.sub(r"__mutmut_\d+$", "", key)
                place = re.sub(r"\.xǁ(\w+?)ǁ", r".\1.", place).replace(".x_", ".")
                module = meta.with_suffix("")
                yield Mutant(module=module, key=key, place=place, survived=exit_code in _SURVIVED)


def justified() -> dict[str, list[str]]:
    """Return what may survive: for each place the texts that a change's added lines may contain."""
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
    tried: collections.Counter[str] = collections.Counter()
    killed: collections.Counter[str] = collections.Counter()
    excused: collections.Counter[str] = collections.Counter()
    left: list[tuple[Mutant, str]] = []
    for mutant in mutants():
        room = ".".join(mutant.place.split(".")[: 3 if "supervisor" in mutant.place else 2])
        tried[room] += 1
        if not mutant.survived:
            killed[room] += 1
            continue
        change = mutant.change()
        added = " ".join(line[1:].strip() for line in change.splitlines() if line.startswith("+"))
        if any(each in " ".join(added.split()) for each in allowed[mutant.place]):
            excused[room] += 1
        else:
            left.append((mutant, change))
    for mutant, change in left:
        print(f"survived: {mutant.key}\n{change}\n")
    for room in sorted(tried):
        print(
            f"{room}: {killed[room]} of {tried[room]} killed ({killed[room] / tried[room]:.1%}),"
            f" {excused[room]} justified"
        )
    if not tried:
        print("nothing was tried: run `mutmut run` first")
        return 1
    score = 100 * sum(killed.values()) / sum(tried.values())
    print(
        f"score: {score:.1f} % of {sum(tried.values())} mutants killed, {len(left)} not justified"
    )
    return int(bool(left) or score < options.at_least)


if __name__ == "__main__":
    sys.exit(main())
