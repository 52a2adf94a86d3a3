"""What supervision costs while nothing happens: CPU time of a supervisor and of what it watches.

Ten nodes in ten processes do nothing: under `lifecycle up`, in its hosts, and as plain nodes of
commands, which it asks every 2 s whether they hang; then as managed nodes of rclpy that nobody
watches. The user and system time of every process is read from /proc/PID/stat at both ends of a
quiet interval, and how often its threads woke up.

    python benchmarks/idle.py [--nodes 10] [--seconds 30] [--domain 70]
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
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import psutil
import yaml

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script, only its own directory is there

from benchmarks.bring_up import manifest

HERE = Path(__file__).resolve()
ROOT = HERE.parents[1]
SETTLE_S = 8.0
"""Discovery announces each participant twenty times in its first 2 s."""

UP_S = 60.0


def cpu_s(pids: Iterable[int]) -> dict[int, float]:
    """Return user and system time of processes, in seconds."""
    tick = os.sysconf("SC_CLK_TCK")
    used = {}
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        used[pid] = (int(fields[11]) + int(fields[12])) / tick
    return used


def switches(pids: Iterable[int]) -> dict[int, int]:
    """Return how often threads of processes were woken up and gave up the processor themselves."""
    counts = {}
    for pid in pids:
        counts[pid] = 0
        for task in Path(f"/proc/{pid}/task").iterdir():
            for line in (task / "status").read_text(encoding="utf-8").splitlines():
                if line.startswith("voluntary_ctxt_switches"):
                    counts[pid] += int(line.split()[1])
    return counts


def measure(groups: Mapping[str, list[int]], seconds: float) -> None:
    """Print what each group of processes uses, in percent of one core, and how often it wakes."""
    pids = [pid for group in groups.values() for pid in group]
    began, before, woken = time.monotonic(), cpu_s(pids), switches(pids)
    time.sleep(seconds)
    took, after, awake = time.monotonic() - began, cpu_s(pids), switches(pids)
    for name, group in groups.items():
        used = sum(after[pid] - before[pid] for pid in group)
        wakes = sum(awake[pid] - woken[pid] for pid in group)
        print(f"{name:42}{100 * used / took:8.2f} %{wakes / took:9.1f} wake-ups/s", flush=True)


def of_commands(nodes: int, domain_id: int) -> dict[str, Any]:
    """Return the manifest of plain nodes of rclpy, each a command of its own."""
    code = "import sys, rclpy; rclpy.init(); rclpy.spin(rclpy.create_node(sys.argv[1]))"
    names = [f"node_{index}" for index in range(nodes)]
    return {
        **manifest(nodes, "single", domain_id, "localhost"),
        "nodes": {
            each: {"run": {"command": [sys.executable, "-c", code, each]}, "managed": False}
            for each in names
        },
    }


def supervised(system: dict[str, Any], what: str, seconds: float) -> None:
    """Measure `lifecycle up`."""
    with tempfile.TemporaryDirectory() as directory:
        file = Path(directory) / "idle.lifecycle.yaml"
        file.write_text(yaml.safe_dump(system))
        with subprocess.Popen(
            [sys.executable, "-m", "lifecycle", "up", str(file), "--format", "json"],
            cwd=ROOT,
            env={**os.environ, "XDG_RUNTIME_DIR": directory, "ROS_LOG_DIR": directory},
            stdout=subprocess.PIPE,
            text=True,
        ) as process:
            assert process.stdout is not None
            pids: dict[str, int] = {}
            for line in process.stdout:
                event = json.loads(line)
                if event.get("event") == "process":
                    pids[event["process"]] = event["pid"]
                if event.get("event") == "system" and event["reached"] == "active":
                    break
            time.sleep(SETTLE_S)
            hosts = list(pids.values())
            below = psutil.Process(process.pid).children(recursive=True)
            servers = [each.pid for each in below if each.pid not in hosts]
            groups = {
                "supervisor": [process.pid],
                "fork server": servers,
                what: hosts,
            }
            measure(groups, seconds)
            process.send_signal(signal.SIGINT)
            process.stdout.read()


def alone(nodes: int, domain_id: int, seconds: float) -> None:
    """Measure the same nodes as rclpy's own managed nodes, with nobody who watches."""
    code = (
        "import sys, rclpy; from rclpy.lifecycle import LifecycleNode; "
        "from std_msgs.msg import String; rclpy.init(); name = sys.argv[1]; "
        "node = LifecycleNode('node_' + name); "
        "publisher = node.create_lifecycle_publisher(String, 'out_' + name, 10); "
        "node.trigger_configure(); node.trigger_activate(); print('up', flush=True); "
        "rclpy.spin(node)"
    )
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(domain_id),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(index)],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        for index in range(nodes)
    ]
    try:
        for each in processes:
            assert each.stdout is not None
            each.stdout.readline()
        time.sleep(SETTLE_S)
        measure({f"{nodes} nodes, unsupervised": [each.pid for each in processes]}, seconds)
    finally:
        for each in processes:
            each.send_signal(signal.SIGINT)
        for each in processes:
            each.communicate(timeout=UP_S)


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure what idle supervision costs.")
    parser.add_argument("--nodes", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--domain", type=int, default=70)
    options = parser.parse_args()
    print(f"{'':42}{'of one core':>10}")
    hosted = manifest(options.nodes, "single", options.domain, "localhost")
    supervised(hosted, f"{options.nodes} nodes, supervised", options.seconds)
    commands = of_commands(options.nodes, options.domain)
    supervised(commands, f"{options.nodes} nodes of commands, asked", options.seconds)
    alone(options.nodes, options.domain, options.seconds)


if __name__ == "__main__":
    main()
