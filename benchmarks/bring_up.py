"""How fast ten single-process nodes come up: `lifecycle up` beside the obvious way.

The obvious way is what one writes without a supervisor: one `python` per node with an
`rclpy.lifecycle` node, then `change_state` calls one after the other. Both start cold, run the same
ten nodes with one publisher each, and end everything they started. `lifecycle up` verifies the
whole graph before it activates; the baseline verifies nothing.

    python benchmarks/bring_up.py [--nodes 10] [--repeat 5] [--domain 40]

prints, for each, the seconds from the command to all nodes being active, and to everything being
gone again, and the ratio.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml

TOPIC_TYPE = "std_msgs/msg/String"
HERE = Path(__file__).resolve()


def manifest(nodes: int, domain_id: int) -> str:
    """The system of `nodes` nodes, as a manifest."""
    return yaml.safe_dump(
        {
            "manifest_version": 1,
            "system": "bring_up",
            "discovery": {"domain_id": domain_id, "range": "localhost"},
            "policy": {"unheard": "ignore"},
            "nodes": {
                f"node_{index}": {
                    "run": {"python": "benchmarks.bring_up_node:Ours"},
                    "interface": {"publishers": [{"name": f"out_{index}", "type": TOPIC_TYPE}]},
                }
                for index in range(nodes)
            },
        }
    )


def ours(nodes: int, domain_id: int) -> tuple[float, float]:
    """Run `lifecycle up`; return (seconds to active, seconds in all)."""
    with tempfile.TemporaryDirectory() as directory:
        file = Path(directory) / "bring_up.lifecycle.yaml"
        file.write_text(manifest(nodes, domain_id))
        began = time.monotonic()
        active = 0.0
        with subprocess.Popen(
            [
                *(sys.executable, "-m", "lifecycle.cli", "up", str(file)),
                *("--stop-after", "0", "--format", "json"),
            ],
            cwd=HERE.parents[1],
            stdout=subprocess.PIPE,
            text=True,
        ) as process:
            assert process.stdout is not None
            for line in process.stdout:
                event = json.loads(line)
                if event.get("event") == "system" and event["reached"] == "active":
                    active = time.monotonic() - began
        if process.returncode != 0:
            raise SystemExit(f"lifecycle up failed with {process.returncode}")
        return active, time.monotonic() - began


def baseline(nodes: int, domain_id: int) -> tuple[float, float]:
    """Run the obvious way in an interpreter of its own; return the same."""
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(domain_id),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    began = time.monotonic()
    active = 0.0
    with subprocess.Popen(
        [sys.executable, str(HERE.with_name("bring_up_baseline.py")), str(nodes)],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line == "active\n":
                active = time.monotonic() - began
    if process.returncode != 0:
        raise SystemExit(f"the baseline failed with {process.returncode}")
    return active, time.monotonic() - began


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure bring-up against the obvious way.")
    parser.add_argument("--nodes", type=int, default=10)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--domain", type=int, default=40)
    options = parser.parse_args()
    runs = {"baseline": baseline, "lifecycle up": ours}
    measured: dict[str, list[tuple[float, float]]] = {name: [] for name in runs}
    for _ in range(options.repeat):
        # In turns, so that a busy moment of the machine hits both.
        for name, run in runs.items():
            measured[name].append(run(options.nodes, options.domain))
    medians = {
        name: tuple(statistics.median(column) for column in zip(*values, strict=True))
        for name, values in measured.items()
    }
    print(f"{options.nodes} single-process nodes, cold, median of {options.repeat}, seconds")
    print(f"{'':14}{'to all active':>15}{'whole command':>15}")
    for name, values in medians.items():
        print(f"{name:14}" + "".join(f"{value:15.2f}" for value in values))
    ratios = (
        slow / fast for slow, fast in zip(medians["baseline"], medians["lifecycle up"], strict=True)
    )
    print(f"{'ratio':14}" + "".join(f"{ratio:14.1f}×" for ratio in ratios))


if __name__ == "__main__":
    main()
