"""How long after SIGKILL a node is active and verified again, and what becomes of the time.

One `lifecycle up` of a talker and two listeners, `restart: on-failure` with its default delay of
0.1 s. The talker is killed again and again; each time is from the kill to the line in the JSON
output that says so, by the machine's one clock. In turns with it, so that a busy machine is seen:
how long the same system takes from its start to active.

    python benchmarks/restart.py [--kills 15] [--tcp] [--domain 46]
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[1]
NODES = "tests.ros.supervisor.systems"
SETTLES_S = 2.5
"""A killed node has run for so long: its initial announcements are over."""
STAGES = ("exited", "starting", "running", "connected", "verified", "restarted")


def manifest(directory: Path, domain_id: int, *, tcp: bool) -> Path:
    """Write the manifest of a talker and two listeners."""
    topic = {"name": "chatter", "type": "std_msgs/msg/String"}
    discovery: dict[str, Any] = {"domain_id": domain_id, "range": "localhost"}
    if tcp:
        discovery = {"domain_id": domain_id, "mode": "static", "transport": "tcpv4"}
    listener = {
        "run": {"python": f"{NODES}:Listener", "output": "log"},
        "interface": {"subscriptions": [topic]},
    }
    document = {
        "manifest_version": 1,
        "system": "restarted",
        "discovery": discovery,
        "restart": "on-failure",
        "start_limit_interval_sec": 0,
        "nodes": {
            "talker": {
                "run": {"python": f"{NODES}:Talker", "output": "log"},
                "interface": {"publishers": [topic]},
            },
            "near": listener,
            "far": listener,
        },
    }
    file = directory / "restarted.lifecycle.yaml"
    file.write_text(yaml.safe_dump(document))
    return file


def stage_of(event: dict[str, Any]) -> str:
    """Return which stage of the talker's return an event ends; empty if none."""
    if event.get("event") == "process" and event["process"] == "talker":
        return str(event["state"])
    if event.get("event") == "system":
        return str(event["reached"])
    return "restarted" if event.get("event") == "restarted" else ""


def measure(path: Path, kills: int) -> tuple[float, list[dict[str, float]]]:
    """Return how long bring-up took, and for each kill when each stage was over, in seconds."""
    began_s = time.monotonic()
    command = [sys.executable, "-m", "lifecycle", "up", str(path), "--format", "json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None
    up_s = killed_s = 0.0
    pid = 0
    rows: list[dict[str, float]] = []
    try:
        for line in process.stdout:
            event, now_s = json.loads(line), time.monotonic()
            stage = stage_of(event)
            if stage == "running":
                pid = event["pid"]
            if rows and stage in STAGES:
                rows[-1].setdefault(stage, now_s - killed_s)
            if not up_s and stage == "active":
                up_s = now_s - began_s
            elif stage != "restarted":
                continue
            if len(rows) == kills:
                process.send_signal(signal.SIGTERM)
                continue
            time.sleep(SETTLES_S)
            killed_s = time.monotonic()
            rows.append({})
            os.kill(pid, signal.SIGKILL)
    finally:
        process.terminate()
        process.wait(60)
    return up_s, rows


def main() -> int:
    """Print medians."""
    parser = argparse.ArgumentParser(description="Measure the restart of a killed node.")
    parser.add_argument("--kills", type=int, default=15)
    parser.add_argument("--tcp", action="store_true", help="connect participants by TCP")
    parser.add_argument("--domain", type=int, default=46)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        path = manifest(Path(directory), options.domain, tcp=options.tcp)
        up_s, rows = measure(path, options.kills)
    whole = [each for each in rows if "restarted" in each]
    for stage in STAGES:
        times = [each[stage] for each in whole if stage in each]
        print(f"{stage:10}  median {statistics.median(times):6.3f} s  longest {max(times):6.3f} s")
    load = os.getloadavg()[0] / (os.cpu_count() or 1)
    print(f"{len(whole)} of {options.kills} kills; bring-up took {up_s:.3f} s; load {load:.1f}")
    return 0 if len(whole) == options.kills else 1


if __name__ == "__main__":
    sys.exit(main())
