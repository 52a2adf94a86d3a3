"""Work grows with a system and not with its square: ratios of CPU time, with generous bounds.

`benchmarks/scale.py` measures the exponents themselves.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.scale import cpu_s, exponent, stages

MOST = 1.5
"""Linear is 1, pairs of all with all 2; the rest is for a busy machine and a small system."""

STAGES = ("check", "plan", "verify", "svg")


@pytest.mark.parametrize(
    ("shape", "sizes", "pairs"),
    [("chain", (30, 120), 4), ("star", (20, 80), 4), ("one topic", (12, 36), 9)],
)
def test_four_times_the_nodes_are_not_sixteen_times_the_work(
    tmp_path: Path, shape: str, sizes: tuple[int, int], pairs: int
) -> None:
    times: dict[str, list[float]] = {}
    for size in sizes:
        for stage, work in stages(shape, size, tmp_path):
            if stage not in STAGES:
                continue
            work()  # what is read once for all
            times.setdefault(stage, []).append(min(cpu_s(work) for _ in range(2)))
    grown = {stage: exponent(small, large, pairs) for stage, (small, large) in times.items()}
    assert {stage: each for stage, each in grown.items() if each > MOST} == {}, times
