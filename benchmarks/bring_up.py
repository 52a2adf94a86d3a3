"""How fast systems of 1 to 100 single-process nodes come up and go: `lifecycle up` beside others.

Four things, in turns, so that a busy moment of the machine hits all of them:

- launch_ros, where it can be imported: a process a node, lifecycle events; verifies nothing
- Popen + services: one `python` a node, service calls side by side; verifies nothing
- lifecycle: `lifecycle up`, which verifies the whole graph before it activates
- floor: a fork server and a control channel, and nothing else (bring_up_floor.py)

Each starts cold and runs the same nodes; everything it started is measured and ended.

    python benchmarks/bring_up.py [--sizes 1 5 10 20 50 100] [--runs 3] [--shape single|chain]
        [--only NAME ...] [--markdown]

prints medians: seconds from the command to all nodes being active, CPU seconds of the whole process
tree until then, its PSS and threads then, and seconds from SIGINT until nothing is left; the ratio
of lifecycle to the floor; and how long each stage of `lifecycle up` took. `--shape chain`: each
node has five publishers and five subscriptions, those of the node before it. What failed is in the
table and named below it, and makes the exit code 1.

All talk with `range: subnet`, which holds more participants on one host than `localhost`.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import json
import math
import statistics
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script, only its own directory is there

from benchmarks.measuring import (
    COLUMNS,
    FLOOR,
    OURS,
    FailedError,
    Row,
    Used,
    aligned,
    cell,
    end_on_sigterm,
    render,
    row,
    run,
)

HERE = Path(__file__).resolve()
STAGES = ("started", "configured", "connected", "verified", "active")
SIZES = (1, 5, 10, 20, 50, 100)
CHAIN = 5
PROGRAMS = {
    COLUMNS[0]: "bring_up_launch.py",
    COLUMNS[1]: "bring_up_baseline.py",
    FLOOR: "bring_up_floor.py",
}
MEASURES = {
    "active_s": "to all active, s",
    "cpu_s": "CPU until then, s",
    "pss_mib": "PSS then, MiB",
    "threads": "threads then",
    "gone_s": "SIGINT to gone, s",
}


def manifest(nodes: int, shape: str, domain_id: int, range_: str = "subnet") -> dict[str, Any]:
    """The system of `nodes` nodes, as a manifest."""
    made = _chained if shape == "chain" else _single
    return {
        "manifest_version": 1,
        "system": "bring_up",
        "discovery": {"domain_id": domain_id, "range": range_},
        "policy": {"unheard": "ignore"},
        "nodes": {f"node_{index}": made(index) for index in range(nodes)},
    }


def _endpoint(name: str) -> dict[str, str]:
    return {"name": name, "type": "std_msgs/msg/String"}


def _single(index: int) -> dict[str, Any]:
    return {
        "run": {"python": "benchmarks.bring_up_node:Ours"},
        "interface": {"publishers": [_endpoint(f"out_{index}")]},
    }


def _chained(index: int) -> dict[str, Any]:
    node: dict[str, Any] = {
        "run": {"python": "benchmarks.bring_up_node:" + ("Chained" if index else "Ours")},
        "interface": {
            "publishers": [_endpoint(f"link_{index}_{number}") for number in range(CHAIN)]
        },
    }
    if index:
        node["interface"]["subscriptions"] = [_endpoint(f"in_{each}") for each in range(CHAIN)]
        node["remap"] = {f"in_{each}": f"link_{index - 1}_{each}" for each in range(CHAIN)}
    return node


@dataclasses.dataclass
class Findings:
    """What is found besides what the table has.

    Attributes:
        failures: what failed, in words.
        stages: seconds of each stage of `lifecycle up`, by the number of nodes.
    """

    failures: list[str] = dataclasses.field(default_factory=list)
    stages: dict[int, dict[str, list[float]]] = dataclasses.field(default_factory=dict)


def measure(
    name: str,
    nodes: int,
    shape: str,
    domain_id: int,
    findings: Findings,
    *,
    range_: str = "subnet",
) -> Used:
    """Bring `nodes` nodes up and down once.

    Args:
        name: one of COLUMNS.
        nodes: how many.
        shape: "single" or "chain".
        domain_id: of all of them.
        findings: gets the stages.
        range_: of discovery.

    Raises:
        FailedError: it did not work.
    """
    variables = {
        "ROS_DOMAIN_ID": str(domain_id),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": range_.upper(),
        "PYTHONDONTWRITEBYTECODE": "",
    }
    bound_s = 60.0 + 3.0 * nodes
    if name != OURS:
        command = [sys.executable, str(HERE.with_name(PROGRAMS[name])), str(nodes), shape]
        return run(
            command,
            is_active=lambda line: line == "active\n",
            variables=variables,
            bound_s=bound_s,
        )
    stages: dict[str, float] = {}
    failures: list[str] = []
    before_s = time.monotonic()

    def is_active(line: str) -> bool:
        """Note when the last node, or the system, has come so far."""
        event = json.loads(line)
        if event.get("event") == "failure":
            failures.append(event["message"])
        if reached := event.get("reach") or event.get("reached"):
            stages[reached] = time.monotonic()
        return event.get("event") == "system" and bool(event["reached"] == "active")

    with tempfile.TemporaryDirectory() as directory:
        file = Path(directory) / "bring_up.lifecycle.yaml"
        file.write_text(yaml.safe_dump(manifest(nodes, shape, domain_id, range_)))
        verb = ("up", str(file), "--format", "json", "--timeout", str(bound_s))
        try:
            used = run(
                [sys.executable, "-m", "lifecycle", *verb],
                is_active=is_active,
                variables=variables,
                bound_s=bound_s,
            )
        except FailedError as error:
            raise FailedError("; ".join([str(error), *failures[:1]])) from None
    for stage in filter(stages.__contains__, STAGES):
        took_s = max(0.0, stages[stage] - before_s)
        findings.stages.setdefault(nodes, {}).setdefault(stage, []).append(took_s)
        before_s = stages[stage]
    return used


def available(only: Iterable[str] = COLUMNS) -> tuple[str, ...]:
    """Return what can be measured here."""
    there = importlib.util.find_spec("launch_ros") is not None
    return tuple(each for each in COLUMNS if each in only and (there or each != COLUMNS[0]))


def measure_all(
    sizes: Sequence[int],
    runs: int,
    shape: str,
    domain_id: int,
    *,
    names: Sequence[str],
    findings: Findings,
    enough_s: float = math.inf,
) -> list[Row]:
    """Measure everything in turns; return the table's lines.

    What failed is not tried again with that many nodes.

    Args:
        sizes: numbers of nodes.
        runs: of each.
        shape: "single" or "chain".
        domain_id: of all of them.
        names: of the things to measure.
        findings: gets what failed, and the stages.
        enough_s: on the monotonic clock; from then on each is run once.
    """
    for name in names:  # what is slow the first time only is not to be measured
        _once(name, 1, shape, domain_id, Findings())
    rows = []
    for size in sizes:
        measured: dict[str, list[Used]] = {name: [] for name in names}
        failed: dict[str, str] = {}
        for number in range(runs):
            if number and time.monotonic() > enough_s:
                break
            for name in names:
                if name in failed:
                    continue
                found = _once(name, size, shape, domain_id, findings)
                if isinstance(found, str):
                    failed[name] = found
                else:
                    measured[name].append(found)
        findings.failures += [
            f"{name} with {size} nodes, {shape}: {why}" for name, why in failed.items()
        ]
        title = f"N={size}" if shape == "single" else f"{shape} N={size}"
        rows += _rows(title, measured, failed)
    return rows


def _once(name: str, size: int, shape: str, domain_id: int, findings: Findings) -> Used | str:
    print(f"{size:4} {shape}: {name:20}", end="\r", file=sys.stderr, flush=True)
    try:
        return measure(name, size, shape, domain_id, findings)
    except FailedError as error:
        return str(error)


def _rows(title: str, measured: dict[str, list[Used]], failed: dict[str, str]) -> list[Row]:
    rows = []
    for field, what in MEASURES.items():
        values: dict[str, float | str] = {
            name: "failed"
            if name in failed
            else statistics.median(dataclasses.asdict(each)[field] for each in found)
            for name, found in measured.items()
        }
        rows.append(row(f"{title}: {what}", values))
    return rows


def stage_table(stages: dict[int, dict[str, list[float]]], *, markdown: bool) -> str:
    """Return how long each stage of `lifecycle up` took, seconds, by the number of nodes."""
    names = max((tuple(each) for each in stages.values()), key=len, default=())
    cells = [["stage, s", *(f"N={size}" for size in stages)]]
    for name in names:
        found = (stages[size].get(name) for size in stages)
        cells.append([name, *(cell(statistics.median(each)) if each else "" for each in found)])
    return aligned(cells, markdown=markdown)


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Measure bring-up against others and the floor.")
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, metavar="N")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--shape", choices=("single", "chain"), default="single")
    parser.add_argument("--only", nargs="+", choices=COLUMNS, default=COLUMNS, metavar="NAME")
    parser.add_argument("--domain", type=int, default=40)
    parser.add_argument("--markdown", action="store_true", help="as in docs/performance.md")
    options = parser.parse_args()
    end_on_sigterm()
    names = available(options.only)
    if skipped := [each for each in options.only if each not in names]:
        print(f"skipped, because it cannot be imported: {', '.join(skipped)}")
    findings = Findings()
    rows = measure_all(
        options.sizes,
        options.runs,
        options.shape,
        options.domain,
        names=names,
        findings=findings,
    )
    print(f"{options.shape}, separate processes, cold, medians of {options.runs} in turns\n")
    print(render(rows, markdown=options.markdown))
    if findings.stages:
        print(f"\nstages of lifecycle up, {options.shape}, likewise\n")
        print(stage_table(findings.stages, markdown=options.markdown))
    for each in findings.failures:
        print(f"failed: {each}")
    return 1 if findings.failures else 0


if __name__ == "__main__":
    sys.exit(main())
