"""Work grows with a system and not with its square: ratios of CPU time, with generous bounds.

`benchmarks/scale.py` measures the exponents themselves.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.scale import cpu_s, exponent, stages

MOST = 1.5
"""Linear is 1, pairs of all with all 2; the rest is for a busy machine and a small system."""

MOST_SHARE = 0.25
"""It is 0.05; what is compared, to know what has not changed, grows with the system."""

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


def test_one_changed_endpoint_is_not_judged_at_the_price_of_the_system(tmp_path: Path) -> None:
    shares: list[float] = []
    for _ in range(ROUNDS):
        taken = {
            stage: min(cpu_s(work) for _ in range(3))
            for stage, work in stages("chain", 100, tmp_path)
            if stage in ("verify", "change")
        }
        shares.append(taken["change"] / taken["verify"])
        if shares[-1] < MOST_SHARE:
            break  # other work on the machine only ever adds time
    assert min(shares) < MOST_SHARE, shares
