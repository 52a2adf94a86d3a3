"""What a message, a tick and an image cost in our nodes, beside plain rclpy nodes, in turns.

    python benchmarks/data_path.py [--runs 3] [--markdown]

prints medians and the ratio of ours to plain rclpy:

- publish: one call of `publish` in an active node, held or asked for by its name each time, nobody
  subscribed; and in an inactive node, where it is dropped
- message: user and system time of the receiving process for each message, 1,000 a second
- timer: how far intervals of 5 ms are off, mean and 99th percentile
- image: 1 MB images from one process to another, up to four on the way: MB a second, and user and
  system time of both processes for each
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import rclpy
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import String

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script, only its own directory is there

from benchmarks.measuring import FLOOR, OURS, FailedError, Row, cpu_of, end_on_sigterm, render, row

PROGRAM = Path(__file__).with_name("data_path_nodes.py")
BOUND_S = 60.0
MESSAGES = 1000
RATE_HZ = 1000.0
TICKS = 300
IMAGES = 200
NAMES = {"ours": OURS, "plain": FLOOR}


@contextlib.contextmanager
def program(whose: str, role: str, number: int = 0) -> Iterator[subprocess.Popen[str]]:
    """Run a program of data_path_nodes.py; it is ended here, and killed where it does not end."""
    process = subprocess.Popen(
        [sys.executable, str(PROGRAM), whose, role, str(number)], stdout=subprocess.PIPE, text=True
    )
    # Whatever hangs, reading its output comes to an end.
    killer = threading.Timer(BOUND_S, process.kill)
    killer.start()
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        process.wait()
        killer.cancel()
        assert process.stdout is not None
        process.stdout.close()


def line_of(process: subprocess.Popen[str]) -> str:
    """Return its next line.

    Raises:
        FailedError: there is none.
    """
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise FailedError(f"{' '.join(map(str, process.args[1:]))} ended, exit {process.wait()}")
    return line


def publish(runs: int) -> list[Row]:
    """Time calls of publish."""
    found = []
    for _ in range(runs):
        with program("ours", "publish") as process:
            found.append(json.loads(line_of(process)))
    plain, ours, by_name, inactive = (
        statistics.median(each[name] for each in found)
        for name in ("plain", "ours", "by name", "inactive")
    )
    return [
        row("publish, ns", {OURS: ours, FLOOR: plain}),
        row("publish by name, ns", {OURS: by_name, FLOOR: plain}),
        row("publish while inactive, ns", {OURS: inactive, FLOOR: plain}),
    ]


def message(runs: int) -> list[Row]:
    """Measure what a received message costs; both receivers run all the time."""
    found: dict[str, list[float]] = {name: [] for name in NAMES.values()}
    node = Node("sender")
    try:
        with (
            program("ours", "receive", MESSAGES) as ours,
            program("plain", "receive", MESSAGES) as plain,
        ):
            receivers = {"ours": ours, "plain": plain}
            publishers = {
                whose: node.create_publisher(String, f"to_{whose}", 100) for whose in receivers
            }
            for whose, publisher in publishers.items():
                until_matched(publisher, receivers[whose])
            for number in range(runs + 1):
                for whose, receiver in receivers.items():
                    used_us = received(publishers[whose], receiver)
                    if number:  # the first is not measured
                        found[NAMES[whose]].append(used_us)
    finally:
        node.destroy_node()
    medians = {name: statistics.median(each) for name, each in found.items()}
    return [row("message received, µs of CPU", medians)]


def received(publisher: Publisher, receiver: subprocess.Popen[str]) -> float:
    """Send, and return the receiver's CPU time for each message, in microseconds."""
    before_s = cpu_of(receiver.pid)
    due_s = time.monotonic()
    for _ in range(MESSAGES):
        due_s += 1 / RATE_HZ
        time.sleep(max(0.0, due_s - time.monotonic()))
        publisher.publish(String(data="x" * 32))
    line_of(receiver)
    return (cpu_of(receiver.pid) - before_s) / MESSAGES * 1e6


def until_matched(publisher: Publisher, receiver: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + BOUND_S / 2
    while not publisher.get_subscription_count():
        if time.monotonic() > deadline or receiver.poll() is not None:
            raise FailedError(f"nobody subscribes to {publisher.topic}")
        time.sleep(0.01)
    # A subscription of ours is there before its node is active, and would drop what comes.
    time.sleep(0.5)


def timer(runs: int) -> list[Row]:
    """Measure how punctual timers are."""
    found: dict[str, list[dict[str, float]]] = {name: [] for name in NAMES.values()}
    for _ in range(runs):
        for whose, name in NAMES.items():
            with program(whose, "tick", TICKS) as process:
                found[name].append(json.loads(line_of(process)))
    return [
        row(
            f"timer, {title}, µs off",
            {
                name: statistics.median(each[key] for each in measured)
                for name, measured in found.items()
            },
        )
        for key, title in (("mean_us", "mean"), ("p99_us", "99 %"))
    ]


def image(runs: int) -> list[Row]:
    """Measure how fast images go from one process to another, and what both use for each."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in NAMES.values()}
    for _ in range(runs):
        for whose, name in NAMES.items():
            with program(whose, "take") as taker, program(whose, "send", IMAGES) as sender:
                line_of(sender)
                before_s = cpu_of(taker.pid) + cpu_of(sender.pid)
                mb_s = json.loads(line_of(sender))["mb_s"]
                used_s = cpu_of(taker.pid) + cpu_of(sender.pid) - before_s
                found[name].append((mb_s, used_s / IMAGES * 1e6))
    return [
        row(
            title,
            {
                name: statistics.median(each[which] for each in measured)
                for name, measured in found.items()
            },
        )
        for which, title in enumerate(("1 MB images, MB/s", "1 MB image, both, µs of CPU"))
    ]


PARTS = {"publish": publish, "message": message, "timer": timer, "image": image}


def measure_all(runs: int, domain_id: int, failures: list[str]) -> list[Row]:
    """Measure everything; return the table's lines.

    Args:
        runs: of each.
        domain_id: of all programs.
        failures: what failed is added here.
    """
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as logs:
        os.environ["ROS_LOG_DIR"] = logs
        os.environ["ROS_DOMAIN_ID"] = str(domain_id)
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        rclpy.init()
        try:
            for name, part in PARTS.items():
                print(f"{name:40}", end="\r", file=sys.stderr, flush=True)
                try:
                    rows += part(runs)
                except FailedError as error:
                    failures.append(f"{name}: {error}")
        finally:
            rclpy.try_shutdown()
    return rows


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Measure the data path against plain rclpy.")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--domain", type=int, default=41)
    parser.add_argument("--markdown", action="store_true", help="as in docs/performance.md")
    options = parser.parse_args()
    end_on_sigterm()
    failures: list[str] = []
    rows = measure_all(options.runs, options.domain, failures)
    print(f"ours and plain rclpy in turns, medians of {options.runs}\n")
    print(render(rows, markdown=options.markdown))
    for each in failures:
        print(f"failed: {each}")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
