"""How planning, judging and drawing grow with a system: `python benchmarks/scale.py`.

Systems of 100, 300 and 1,000 nodes with ten endpoints each, as a chain (each node subscribes to the
one before it), as a star (all nodes with one), and with one topic that all nodes publish and
subscribe, like /tf. Measured is the CPU time, in seconds, of reading and checking the manifest
(`check`), of planning it (`plan`), of verifying it against an observation of a faultless system
(`verify`), and of the plan's text, JSON and pictures. The exponent is that of the growth
from the smallest to the largest system: 1 is linear; on the one topic of all, where the pairs
themselves are the square of the nodes, it is by pairs. Then, for each stage, the function whose own
time grows most. Needs neither ROS nor a network.
"""

from __future__ import annotations

import argparse
import cProfile
import gc
import math
import os
import pstats
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script, only its own directory is there

from lifecycle.cli.verbs.check import check
from lifecycle.cli.verbs.plan import render
from lifecycle.manifest.loading import load
from lifecycle.plan.build import build_plan
from lifecycle.verify.judge import verify
from lifecycle.verify.verdict import Stage
from tests.unit.verify.perfect import perfect

SIZES = (100, 300, 1_000)
SHAPES = ("chain", "star", "one topic")
PER_SIDE = 5
"""Publishers of a node; it has as many subscriptions."""
PER_PROCESS = 10
"""Nodes that share a process, so that 1,000 nodes fit the ports of one domain."""
PICTURES = ("mermaid", "dot", "svg", "html")
WORTH = 0.02
"""Share of a stage's time below which a function's growth is not reported."""

_TYPE = "std_msgs/msg/String"


def manifest(shape: str, nodes: int) -> str:
    """Return the manifest of a system, as YAML."""
    lines = ["manifest_version: 1", "system: scale", "discovery: {domain_id: 7}", "nodes:"]
    processes = max(1, nodes // PER_PROCESS)
    for number in range(nodes):
        publishers, subscriptions = _topics(shape, number, nodes)
        lines += [
            f"  n{number}:",
            '    run: {python: "examples.first_node.nodes:Talker"}',
            f"    process: p{number % processes}",
            "    interface:",
            "      publishers:",
            *(f"        - {{name: {each}, type: {_TYPE}}}" for each in publishers),
            "      subscriptions:",
            *(f"        - {{name: {each}, type: {_TYPE}}}" for each in subscriptions),
        ]
    return "\n".join(lines) + "\n"


def _topics(shape: str, number: int, nodes: int) -> tuple[list[str], list[str]]:
    if shape == "one topic":
        return ["/tf"], ["/tf"]
    own = [f"/t{number}_{each}" for each in range(PER_SIDE)]
    if shape == "chain":
        return own, [f"/t{(number - 1) % nodes}_{each}" for each in range(PER_SIDE)]
    if number:
        return own, [f"/t0_{each}" for each in range(PER_SIDE)]
    others = range(1, nodes)
    return own, [f"/t{other}_{each}" for other in others for each in range(PER_SIDE)]


def stages(shape: str, nodes: int, folder: Path) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield each stage's name and what does it."""
    path = folder / "scale.lifecycle.yaml"
    path.write_text(manifest(shape, nodes), encoding="utf-8")
    yield "check", lambda: check(str(path), (), strict=False)
    loaded = load(str(path)).manifest
    yield "plan", lambda: build_plan(loaded, environment=os.environ)
    plan = build_plan(loaded, environment=os.environ)
    seen = perfect(plan)
    yield "verify", lambda: verify(plan, seen, stage=Stage.CONNECTED)
    for format_ in ("text", "json", *PICTURES):
        yield format_, lambda format_=format_: render(plan, format_)


def cpu_s(work: Callable[[], Any], *, profile: cProfile.Profile | None = None) -> float:
    """Return the CPU seconds of one run, without collecting what was there before."""
    gc.collect()
    gc.freeze()
    try:
        begun = time.process_time()
        if profile is None:
            work()
        else:
            profile.runcall(work)
        return time.process_time() - begun
    finally:
        gc.unfreeze()


def own_times(profile: cProfile.Profile) -> dict[tuple[str, int, str], float]:
    """Return each function's own CPU seconds."""
    stats: Any = pstats.Stats(profile)
    return {function: own_s for function, (_, _, own_s, _, _) in stats.stats.items()}


def exponent(small_s: float, large_s: float, factor: float) -> float:
    """Return e where time grows with size to the power of e."""
    return math.log(max(large_s, 1e-9) / max(small_s, 1e-9)) / math.log(factor)


def worst(
    small: dict[tuple[str, int, str], float],
    large: dict[tuple[str, int, str], float],
    factor: float,
) -> str:
    """Name the function whose own time grows most, of those that matter at the larger size."""
    enough_s = WORTH * sum(large.values())
    found = [
        (exponent(small[each], own_s, factor), each, own_s)
        for each, own_s in large.items()
        if own_s > enough_s and small.get(each, 0.0) > 0.0
    ]
    if not found:
        return ""
    grows, (file, line, name), own_s = max(found)
    place = f"{Path(file).name}:{line} " if line else ""
    return f"{place}{name} ({grows:.2f}, {own_s:.3f} s)"


def measure(shape: str, sizes: Sequence[int], *, functions: bool) -> None:
    """Print the table of one shape."""
    times: dict[str, dict[int, float]] = {}
    profiles: dict[str, dict[int, dict[tuple[str, int, str], float]]] = {}
    for size in sizes:
        with tempfile.TemporaryDirectory() as folder:
            for stage, work in stages(shape, size, Path(folder)):
                work()  # what is read once for all
                times.setdefault(stage, {})[size] = min(cpu_s(work) for _ in range(3))
                if functions and size in (sizes[0], sizes[-1]):
                    profile = cProfile.Profile(time.process_time)
                    cpu_s(work, profile=profile)
                    profiles.setdefault(stage, {})[size] = own_times(profile)
    factor = (sizes[-1] / sizes[0]) ** (2 if shape == "one topic" else 1)
    heads = "".join(f"{size:>10}" for size in sizes)
    print(f"\n{shape}: CPU s at so many nodes\n{'':8}{heads}  exponent  grows most")
    for stage, by_size in times.items():
        row = "".join(f"{by_size[size]:>10.3f}" for size in sizes)
        grows = exponent(by_size[sizes[0]], by_size[sizes[-1]], factor)
        most = ""
        if functions:
            most = worst(profiles[stage][sizes[0]], profiles[stage][sizes[-1]], factor)
        print(f"{stage:8}{row}{grows:>10.2f}  {most}", flush=True)


def main() -> None:
    """Measure what the command line asks for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sizes", default=",".join(map(str, SIZES)), help="nodes, ascending")
    parser.add_argument("--shapes", default=",".join(SHAPES))
    parser.add_argument("--no-functions", action="store_true", help="do not profile")
    asked = parser.parse_args()
    sizes = [int(each) for each in asked.sizes.split(",")]
    for shape in asked.shapes.split(","):
        few = [each for each in sizes if each <= 300] if shape == "one topic" else sizes
        measure(shape, few, functions=not asked.no_functions)


if __name__ == "__main__":
    main()
