"""Work grows with a system and not with its square: ratios of CPU time, with generous bounds.

`benchmarks/scale.py` measures the exponents themselves.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.scale import cpu_s, exponent, stages

MOST = 1.5
"""Linear is 1, pairs of all with all 2; the rest is for a busy machine and a small system."""

ROUNDS = 4
STAGES = ("check", "plan", "verify", "svg")


@pytest.mark.parametrize(
    ("shape", "sizes", "pairs"),
    [("chain", (30, 120), 4), ("star", (20, 80), 4), ("one topic", (12, 36), 9)],
)
def test_four_times_the_nodes_are_not_sixteen_times_the_work(
    tmp_path: Path, shape: str, sizes: tuple[int, int], pairs: int
) -> None:
    best: dict[tuple[str, int], float] = {}
    grown: dict[str, float] = {}
    for _ in range(ROUNDS):
        for size in sizes:
            for stage, work in stages(shape, size, tmp_path):
                if stage in STAGES:
                    taken_s = min(cpu_s(work) for _ in range(2))
                    best[stage, size] = min(taken_s, best.get((stage, size), taken_s))
        grown = {
            each: exponent(best[each, sizes[0]], best[each, sizes[1]], pairs) for each in STAGES
        }
        if max(grown.values()) < MOST:
            break  # other work on the machine only ever adds time
    assert {stage: each for stage, each in grown.items() if each > MOST} == {}, best
