"""What the reducer promises in every story; and that each promise would be missed.

Stories are told by world.py: a system at random, carried out in any order, while things break and
people order. `MUTANTS` breaks the reducer in one place each: the promise that it breaks is noticed.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lifecycle.supervisor.core
from tests.unit.supervisor.core.world import Core, World

PROMISES = {
    "gate": "no activate request without a verdict of that very mark that allows it",
    "withheld": "none while paused, ending, withheld or outside the mode; none stays active so",
    "order": "dependents go down first, and come up last",
    "ends": "every run ends",
    "processes": "every process that was started is ended once, and what it left is swept",
    "up": "after faults stop, everything that is wanted comes up or is given up",
    "violations": "a violation longer than its grace is in the exit code",
    "answers": "one answer to each order",
}

SOURCES = Path(lifecycle.supervisor.core.__file__).parent

MUTANTS = [
    ("gate", "gate.py", "is_latest(run) and not", "not"),
    ("gate", "gate.py", "run.judged.waits and allows(run)", "run.judged.waits"),
    ("gate", "gate.py", "judged.waits = given.mark,", "judged.waits = run.mark,"),
    ("gate", "advance.py", " or not gate.is_open(run):", ":"),
    (
        "gate",
        "reduce.py",
        "    goal = advance.goal_of(run, node)\n    run.changed()",
        "    goal = advance.goal_of(run, node)",
    ),
    ("withheld", "advance.py", "(run.paused or node.withheld or", "(node.withheld or"),
    ("withheld", "advance.py", "(run.paused or node.withheld or", "(run.paused or"),
    (
        "withheld",
        "advance.py",
        "        run.ending is not None\n        or node.renew",
        "        node.renew",
    ),
    ("withheld", "advance.py", "        return not node.let_through", "        return False"),
    (
        "withheld",
        "state.py",
        "(Level.DOWN, Level.STARTED, Level.CONFIGURED, Level.CONNECTED)",
        "tuple(Level)",
    ),
    ("order", "advance.py", "    if holds_up(run, node, target):", "    if False:"),
    ("order", "advance.py", "condition in node.shown and ", ""),
    ("order", "reduce.py", "    node.shown = frozenset()\n\n", "\n"),
    ("order", "advance.py", "    return not run.hurry and any(", "    return False and any("),
    ("ends", "advance.py", "tuple(later), run.now_s", "process.escalation, run.now_s"),
    ("ends", "advance.py", "    run.wakes_at(process.asked_until_s)\n", ""),
    (
        "ends",
        "reduce.py",
        "        if node.request is not None and at_s >= advance.late_at_s",
        "        if False and late_at_s",
    ),
    ("processes", "advance.py", " or is_to_end(run, process) or held", " or held"),
    (
        "processes",
        "reduce.py",
        "process.state, process.end = ProcessState.EXITED, given",
        "process.state, process.end = None, given",
    ),
    (
        "up",
        "reduce.py",
        "            node.renew = node.stuck = False",
        "            node.stuck = False",
    ),
    ("up", "gate.py", "    judged.looking = False", "    pass"),
    ("up", "failure.py", "max(node.due_s, due_s)", "NEVER_S"),
    ("violations", "gate.py", "LASTS_S = 1.0", "LASTS_S = 60.0"),
    ("violations", "failure.py", "_outcome(run, run.judged.counted)", '_outcome(run, "")'),
    ("answers", "state.py", "        self.order, self.undone =", "        _ ="),
    ("answers", "failure.py", "    run.answer(ExitCode.BRING_UP_FAILED, answer)\n", ""),
]
"""The promise that is broken, the module, what it has, and what the mutant has instead."""

ENOUGH = 4000
"""Stories after which a mutant counts as not noticed."""

REAL = Core()


@settings(max_examples=2000, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_every_promise_is_kept_whatever_happens(seed: int) -> None:
    World(REAL, seed).run_story()


@pytest.mark.thorough
@pytest.mark.parametrize("part", range(8))
def test_every_promise_is_kept_in_many_more_stories(part: int) -> None:
    _tell(REAL, range(part * 2500, (part + 1) * 2500))


def test_every_promise_is_broken_by_a_mutant() -> None:
    assert {promise for promise, *_ in MUTANTS} == PROMISES.keys()


@pytest.fixture
def mutant(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Core]:
    """The reducer with one change, under another name."""
    _, changed, old, new = request.param
    name = "mutant_core"
    (tmp_path / name).mkdir()
    for path in SOURCES.glob("*.py"):
        text = path.read_text()
        if path.name == changed:
            assert text.count(old) == 1, f"{changed} has {text.count(old)} times {old!r}"
            text = text.replace(old, new)
        text = text.replace("lifecycle.supervisor.core", name)
        (tmp_path / name / path.name).write_text(text)
    sys.path.insert(0, str(tmp_path))
    try:
        yield Core(name)
    finally:
        sys.path.remove(str(tmp_path))
        for each in [each for each in sys.modules if each.partition(".")[0] == name]:
            del sys.modules[each]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "mutant", MUTANTS, indirect=True, ids=[f"{each[0]}-{i}" for i, each in enumerate(MUTANTS)]
)
def test_a_mutant_is_noticed(mutant: Core) -> None:
    with pytest.raises((AssertionError, RecursionError)):
        _tell(mutant, range(ENOUGH))


def _tell(core: Core, seeds: Iterable[int]) -> None:
    for seed in seeds:
        World(core, seed).run_story()
