"""The graph_watch example as a user runs it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from fast_dds_words import without_fast_dds
from rclpy.node import Node
from std_msgs.msg import String

pytestmark = pytest.mark.ros

ROOT = Path(__file__).parents[3]
LIMIT_S = 60.0


def test_a_new_publisher_of_the_topic_is_greeted_and_seen_off(
    make_node: Callable[..., Node],
) -> None:
    watch = subprocess.Popen(
        [sys.executable, "-m", "examples.graph_watch.watch", "/greetings"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    limit = threading.Timer(LIMIT_S, watch.kill)
    limit.start()
    try:
        assert watch.stdout is not None
        assert watch.stdout.readline() == "watching /greetings\n"
        node = make_node("greeter")
        node.create_publisher(String, "/other", 1)
        publisher = node.create_publisher(String, "/greetings", 1)
        assert watch.stdout.readline() == "/greeter publishes /greetings (std_msgs/msg/String)\n"
        node.destroy_publisher(publisher)
        assert watch.stdout.readline() == "/greeter no longer publishes /greetings\n"
        watch.send_signal(signal.SIGTERM)
        rest, errors = watch.communicate(timeout=LIMIT_S)
        assert (watch.returncode, rest, without_fast_dds(errors)) == (0, "", [])
    finally:
        limit.cancel()
        watch.kill()
        watch.communicate()


def test_a_program_says_what_of_a_system_does_not_run(fresh_domain: int) -> None:
    asked = subprocess.run(
        [
            *(sys.executable, "-m", "examples.graph_watch.is_running"),
            "manifests/first_node.lifecycle.yaml",
        ],
        cwd=ROOT,
        env={**os.environ, "ROS_DOMAIN_ID": str(fresh_domain)},
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    said = asked.stdout.splitlines()
    assert (asked.returncode, without_fast_dds(asked.stderr)) == (1, [])
    assert said[0] == f"there is no node /talker in domain {fresh_domain}", said
