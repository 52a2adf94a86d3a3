"""What one changed endpoint costs a supervisor: `python benchmarks/changed_endpoint.py`.

Under `lifecycle up` there are nodes with ten endpoints each, a chain, ten to a process so that one
host can run many of them. A tool beside them (`ros2 topic echo` is one) makes a subscription of a
topic of its own, and destroys it, again and again; each is one changed endpoint of the graph, at
which the supervisor looks and judges. Printed is the CPU time of the supervisor for each of these
changes, in milliseconds, beyond what it uses while nothing changes. What its DDS threads do with
the announcement itself is in it.

    python benchmarks/changed_endpoint.py [--sizes 5 10 20 50] [--changes 60] [--domain 70]
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script, only its own directory is there

from benchmarks.bring_up import manifest
from benchmarks.idle import cpu_s

ROOT = Path(__file__).resolve().parents[1]
SIZES = (5, 10, 20, 50)
PER_PROCESS = 10
PAUSE_S = 0.15
"""Longer than a burst of changes lasts, and a look at the largest of these systems."""

SETTLE_S = 8.0
_TOOL = """
import sys, time
import rclpy
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node("_ros2cli_1", start_parameter_services=False, enable_rosout=False)
print("ready", flush=True)
for line in sys.stdin:
    for _ in range(int(line) // 2):
        subscription = node.create_subscription(String, "/changed_endpoint", lambda _: None, 1)
        time.sleep({pause})
        node.destroy_subscription(subscription)
        time.sleep({pause})
    print("done", flush=True)
"""


def system(nodes: int, domain_id: int) -> str:
    """Return the manifest of a chain of nodes, ten to a process."""
    document = manifest(nodes, "chain", domain_id)
    for index, node in enumerate(document["nodes"].values()):
        node["process"] = f"p{index // PER_PROCESS}"
    return yaml.safe_dump(document)


def measure(nodes: int, domain_id: int, changes: int) -> tuple[float, float]:
    """Return the supervisor's CPU seconds for each change, and in a second without one."""
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(domain_id),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
    }
    with tempfile.TemporaryDirectory() as directory:
        file = Path(directory) / "changed.lifecycle.yaml"
        file.write_text(system(nodes, domain_id), encoding="utf-8")
        up = [sys.executable, "-m", "lifecycle", "up", str(file), "--format", "json"]
        with (
            subprocess.Popen(
                [*up, "--timeout", str(60 + 3 * nodes)],
                cwd=ROOT,
                env={**environment, "XDG_RUNTIME_DIR": directory, "ROS_LOG_DIR": directory},
                stdout=subprocess.PIPE,
                text=True,
            ) as supervisor,
            subprocess.Popen(
                [sys.executable, "-c", _TOOL.format(pause=PAUSE_S)],
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            ) as tool,
        ):
            assert supervisor.stdout is not None
            assert tool.stdin is not None
            assert tool.stdout is not None
            try:
                for line in supervisor.stdout:
                    event = json.loads(line)
                    if event.get("event") == "system" and event["reached"] == "active":
                        break
                else:
                    raise SystemExit(f"cannot bring up {nodes} nodes")
                tool.stdout.readline()
                _turn(tool, 2)
                time.sleep(SETTLE_S)
                begun, before = time.monotonic(), cpu_s([supervisor.pid])[supervisor.pid]
                time.sleep(changes * PAUSE_S)
                idle = cpu_s([supervisor.pid])[supervisor.pid] - before
                idle /= time.monotonic() - begun
                begun, before = time.monotonic(), cpu_s([supervisor.pid])[supervisor.pid]
                _turn(tool, changes)
                used = cpu_s([supervisor.pid])[supervisor.pid] - before
                return (used - idle * (time.monotonic() - begun)) / changes, idle
            finally:
                tool.stdin.close()
                supervisor.send_signal(signal.SIGINT)
                supervisor.stdout.read()


def _turn(tool: subprocess.Popen[str], changes: int) -> None:
    assert tool.stdin is not None
    assert tool.stdout is not None
    print(changes, file=tool.stdin, flush=True)
    tool.stdout.readline()


def main() -> None:
    """Print one line for each size."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, metavar="N")
    parser.add_argument("--changes", type=int, default=60)
    parser.add_argument("--domain", type=int, default=70)
    options = parser.parse_args()
    print(f"{'nodes':>8}{'ms CPU per changed endpoint':>30}{'ms CPU per idle second':>26}")
    for size in options.sizes:
        each_s, idle_s = measure(size, options.domain, options.changes)
        print(f"{size:>8}{1e3 * each_s:>30.1f}{1e3 * idle_s:>26.1f}", flush=True)


if __name__ == "__main__":
    main()
