"""A node alone in a terminal: with a manifest, and without one."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from host_process import driver_in
from lifecycle_driver import Driver
from std_msgs.msg import Int32, String

HERE = Path(__file__).parent
ROOT = HERE.parents[2]
FIRST_NODE = "manifests/first_node.lifecycle.yaml"
UP = [
    "configuring",
    "inactive/disconnected",
    "inactive/connecting",
    "inactive/connected",
    "activating/connected",
    "active",
]
DOWN = ["shuttingdown", "finalized"]

Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def start(fresh_domain: int) -> Iterator[Start]:
    """Start programs in a domain of their own."""
    processes: list[subprocess.Popen[str]] = []

    def start(*arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        processes.append(process)
        return process

    yield start
    for process in processes:
        process.kill()
        process.communicate()


@pytest.fixture
def neighbour(fresh_domain: int) -> Iterator[Driver]:
    """A driver in that domain."""
    with driver_in(fresh_domain) as driver:
        yield driver


def lifecycle_run(start: Start, *arguments: str) -> subprocess.Popen[str]:
    return start("-m", "lifecycle", "run", *arguments)


def read_until(process: subprocess.Popen[str], last: str) -> list[str]:
    assert process.stdout is not None
    lines: list[str] = []
    while not lines or lines[-1] != last:
        line = process.stdout.readline()
        assert line, f"ended after {lines}; stderr:\n{process.communicate()[1]}"
        lines.append(line.rstrip("\n"))
    return lines


def test_a_node_alone_asks_for_its_sender_sockets_once(start: Start) -> None:
    code = (
        f"import sys; sys.path.insert(0, {str(HERE)!r}); import lifecycle, senders_asked; "
        "from alone import Counter; lifecycle.run(Counter)"
    )
    process = start("-c", code)
    read_until(process, "/counter: active")
    process.send_signal(signal.SIGINT)
    _, reported = process.communicate(timeout=30)
    assert process.returncode == 0
    assert reported.split() == ["asked"]


def test_a_node_of_a_manifest_comes_up_talks_and_ends_with_ctrl_c(
    start: Start, neighbour: Driver
) -> None:
    heard: list[String] = []
    neighbour.node.create_subscription(String, "/chatter", heard.append, 10)
    process = lifecycle_run(start, FIRST_NODE, "talker", "greeting:=Hi")
    assert read_until(process, "/talker: active") == [
        f"/talker: {state}" for state in ("unconfigured", *UP)
    ]
    neighbour.spin_until(lambda: heard)
    assert heard[0].data.startswith("Hi, ")
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=30)
    assert out.splitlines() == [
        "SIGINT: shutting down",
        *(f"/talker: {state}" for state in DOWN),
    ]
    assert process.returncode == 130


def test_ros_arguments_and_manual_mode(start: Start, neighbour: Driver) -> None:
    process = lifecycle_run(
        start, FIRST_NODE, "talker", "--manual", "--ros-args", "-r", "chatter:=/elsewhere"
    )
    read_until(process, "/talker: unconfigured")
    assert neighbour.set("/talker", "configure")
    assert neighbour.set("/talker", "connect")
    neighbour.spin_until(lambda: neighbour.node.count_publishers("/elsewhere") == 1)
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=30)
    assert process.returncode == 0


def test_a_node_that_is_not_in_the_manifest_is_a_usage_error(start: Start) -> None:
    process = lifecycle_run(start, FIRST_NODE, "walker")
    _, error = process.communicate(timeout=30)
    assert process.returncode == 2
    assert error.splitlines() == [
        f"cannot find node 'walker' in {FIRST_NODE}; its nodes: talker, listener"
    ]


def test_a_program_without_a_manifest_comes_up_by_itself(start: Start, neighbour: Driver) -> None:
    counted: list[Int32] = []
    neighbour.node.create_subscription(Int32, "/there/count", counted.append, 10)
    process = start(
        str(HERE / "alone.py"), "--ros-args", "-r", "__node:=other", "-r", "__ns:=/there"
    )
    read_until(process, "/there/other: active")
    neighbour.spin_until(lambda: len(counted) > 2)
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=30)
    assert process.returncode == 0


def test_manual_wins_over_what_the_class_says(start: Start, neighbour: Driver) -> None:
    process = start(str(HERE / "alone.py"), "manual")
    read_until(process, "/counter: unconfigured")
    assert neighbour.state("/counter") == (1, "unconfigured")
    assert neighbour.set("/counter", "configure")
    read_until(process, "/counter: inactive/disconnected")
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=30)
    assert process.returncode == 0


def test_a_bring_up_that_fails_says_why_and_ends_with_6(start: Start) -> None:
    process = start(str(HERE / "alone.py"), "fail")
    out, error = process.communicate(timeout=30)
    assert process.returncode == 6
    assert (
        "cannot bring up /counter: /counter: on_activate raised OSError: no such counter"
        in out.splitlines()
    )
    assert 'raise OSError("no such counter")' in error


def test_a_node_whose_reader_went_away_lives_on(start: Start, neighbour: Driver) -> None:
    heard: list[String] = []
    neighbour.node.create_subscription(String, "/chatter", heard.append, 10)
    process = lifecycle_run(start, FIRST_NODE, "talker")
    assert process.stdout is not None
    process.stdout.close()
    neighbour.spin_until(lambda: len(heard) > 1)
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) == 0


@pytest.mark.parametrize(
    ("class_", "managed", "states"),
    [
        ("Talker", False, ["running"]),
        ("Managed", True, ["unconfigured", "configuring", "inactive", "activating", "active"]),
    ],
)
def test_a_node_of_rclpy_runs_alone_too(
    start: Start, tmp_path: Path, class_: str, managed: bool, states: list[str]
) -> None:
    manifest = tmp_path / "alone.lifecycle.yaml"
    manifest.write_text(
        "manifest_version: 1\nsystem: alone\nnodes:\n  node:\n"
        f"    run: {{python: 'tests.ros.supervisor.rclpy_nodes:{class_}'}}\n"
        f"    managed: {str(managed).lower()}\n    endpoints: open\n"
    )
    process = lifecycle_run(start, str(manifest), "node")
    said = read_until(process, f"/node: {states[-1]}")
    assert said == [f"/node: {each}" for each in states]
    process.send_signal(signal.SIGTERM)
    out, errors = process.communicate(timeout=30)
    assert (process.returncode, out.splitlines()[0]) == (0, "SIGTERM: shutting down"), errors
