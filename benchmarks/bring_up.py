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
tree until then, its PSS and threads then, and seconds from SIGINT until nothing is left; and the
ratio of lifecycle to the floor. `--shape chain`: each node has five publishers and five
subscriptions, those of the node before it. What failed is in the table and named below it, and
makes the exit code 1.

All talk with `range: subnet`, which holds more participants on one host than `localhost`.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import json
import statistics
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script, only its own directory is there

from benchmarks.measuring import COLUMNS, FLOOR, OURS, FailedError, Row, Used, render, row, run

HERE = Path(__file__).resolve()
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


def manifest(nodes: int, shape: str, domain_id: int) -> dict[str, Any]:
    """The system of `nodes` nodes, as a manifest."""
    made = _chained if shape == "chain" else _single
    return {
        "manifest_version": 1,
        "system": "bring_up",
        "discovery": {"domain_id": domain_id, "range": "subnet"},
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


def measure(name: str, nodes: int, shape: str, domain_id: int) -> Used:
    """Bring `nodes` nodes up and down once.

    Raises:
        FailedError: it did not work.
    """
    variables = {
        "ROS_DOMAIN_ID": str(domain_id),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
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
    with tempfile.TemporaryDirectory() as directory:
        file = Path(directory) / "bring_up.lifecycle.yaml"
        file.write_text(yaml.safe_dump(manifest(nodes, shape, domain_id)))
        return run(
            [
                *(sys.executable, "-m", "lifecycle.cli", "up", str(file), "--format", "json"),
                *("--timeout", str(max(30.0, bound_s))),
            ],
            is_active=_says_active,
            variables=variables,
            bound_s=bound_s,
        )


def _says_active(line: str) -> bool:
    event = json.loads(line)
    return event.get("event") == "system" and event["reached"] == "active"


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
    failures: list[str],
) -> list[Row]:
    """Measure everything in turns; return the table's lines.

    Args:
        failures: what failed is added here. It is not tried again with that many nodes.
    """
    for name in names:  # what is slow the first time only is not to be measured
        _once(name, 1, shape, domain_id)
    rows = []
    for size in sizes:
        measured: dict[str, list[Used]] = {name: [] for name in names}
        failed: dict[str, str] = {}
        for _ in range(runs):
            for name in names:
                if name in failed:
                    continue
                found = _once(name, size, shape, domain_id)
                if isinstance(found, str):
                    failed[name] = found
                else:
                    measured[name].append(found)
        failures += [f"{name} with {size} nodes: {why}" for name, why in failed.items()]
        rows += _rows(size, measured, failed)
    return rows


def _once(name: str, size: int, shape: str, domain_id: int) -> Used | str:
    print(f"{size:4} {shape}: {name:20}", end="\r", file=sys.stderr, flush=True)
    try:
        return measure(name, size, shape, domain_id)
    except FailedError as error:
        return str(error)


def _rows(size: int, measured: dict[str, list[Used]], failed: dict[str, str]) -> list[Row]:
    rows = []
    for field, title in MEASURES.items():
        values: dict[str, float | str] = {
            name: "failed"
            if name in failed
            else statistics.median(dataclasses.asdict(each)[field] for each in found)
            for name, found in measured.items()
        }
        rows.append(row(f"N={size}: {title}", values))
    return rows


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
    names = available(options.only)
    if skipped := [each for each in options.only if each not in names]:
        print(f"skipped, because it cannot be imported: {', '.join(skipped)}")
    failures: list[str] = []
    rows = measure_all(
        options.sizes,
        options.runs,
        options.shape,
        options.domain,
        names=names,
        failures=failures,
    )
    print(f"{options.shape}, separate processes, cold, medians of {options.runs} in turns\n")
    print(render(rows, markdown=options.markdown))
    for each in failures:
        print(f"failed: {each}")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
