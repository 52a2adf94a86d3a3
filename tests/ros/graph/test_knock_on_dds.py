"""Whoever was there before the observer is in its first observation, not in one 3 s later."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from lifecycle.graph.graph import Graph
from lifecycle.middleware.fastdds.discovery import SETTLE_S
from tests.builders import plan_of
from tests.stalls import Stalls, assert_in_time, noted_stalls

pytestmark = [pytest.mark.ros, pytest.mark.alone]

STRANGER = """
import os, signal
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
import rclpy
from std_msgs.msg import String
rclpy.init(signal_handler_options=rclpy.SignalHandlerOptions.NO)
node = rclpy.create_node('stranger')
publisher = node.create_publisher(String, '/noise', 10)
print('here', flush=True)
signal.sigwait({signal.SIGTERM})
node.destroy_node()
rclpy.shutdown()
os._exit(0)
"""
"""Ends when told to, whatever rclpy's own handling of signals makes of it in its first moment."""

NOTHING = plan_of()
TIMES = 6


@pytest.fixture
def stranger(fresh_domain: int) -> Iterator[int]:
    """The domain in which somebody is, with Fast DDS's own defaults."""
    process = subprocess.Popen(
        [sys.executable, "-c", STRANGER],
        env={**os.environ, "ROS_DOMAIN_ID": str(fresh_domain)},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"here\n"
    yield fresh_domain
    process.terminate()
    process.wait(30)
    process.stdout.close()


async def first_look(domain_id: int, stalls: Stalls) -> tuple[bool, float]:
    """Return whether the noise was seen, and the seconds it took beside those the machine took."""
    begun = time.monotonic()
    with Graph.in_loop(domain_id) as observer:
        observation = await observer.observe(NOTHING)  # type: ignore[arg-type]
    seen = any(endpoint.name == "/noise" for endpoint in observation.endpoints)
    return seen, stalls.taken(begun, time.monotonic())


def test_the_first_observation_holds_whoever_was_there_before(stranger: int) -> None:
    with noted_stalls() as stalls:
        looks = [asyncio.run(first_look(stranger, stalls)) for _ in range(TIMES)]
    assert all(seen for seen, _ in looks)
    # Unanswered, about half of the looks would take until the next announcement, 3 s later.
    assert sorted(taken for _, taken in looks)[TIMES // 2] < SETTLE_S / 2


def test_an_empty_domain_is_known_to_be_empty_in_a_moment(fresh_domain: int) -> None:
    with noted_stalls() as stalls:

        def late_s() -> float:
            seen, taken = asyncio.run(first_look(fresh_domain, stalls))
            assert not seen
            return taken - SETTLE_S / 2

        assert_in_time(late_s)
