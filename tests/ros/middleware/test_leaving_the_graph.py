"""Leaving a process that had participants: at once, bounded, and without a trace."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from lifecycle.middleware.process.shared_memory import leftovers, sweep
from lifecycle.middleware.rcl.graph import GraphObserver
from tests.shared_memory import owned_by

WaitUntil = Callable[..., None]

_PROCESS = """
import sys
import rclpy
from rclpy.action import ActionServer
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from lifecycle_msgs.srv import ChangeState
from std_msgs.msg import String
from lifecycle.middleware.process.control import leave_and_exit

context = rclpy.Context()
context.init(args=[])
node = Node("plain", context=context)
managed = LifecycleNode("managed", context=context)
held = node.create_publisher(String, "/a", 10)
print("up", flush=True)
sys.stdin.readline()
leave_and_exit(5, nodes=[node, managed], contexts=[context])
"""


def start() -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", _PROCESS],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "up\n"
    return process


@pytest.fixture
def observer(fresh_domain: int) -> GraphObserver:
    """One that sends over shared memory, as nodes do; by itself an observer has none."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "DEFAULT")
        made = GraphObserver(fresh_domain)
    with made as observer:
        yield observer


def names(observer: GraphObserver) -> list[str]:
    return [node.full_name for node in observer.snapshot()[0]]


def domains_own(files: Iterable[str]) -> set[str]:
    """Leave out ports 7000–7399: free ones are taken at once by processes of every domain."""
    return {name for name in files if not re.search(r"port7[0-3]\d\d(?!\d)", name)}


def test_a_process_that_hangs_with_the_gil_held_still_ends_with_its_code() -> None:
    hang = (
        "import ctypes\n"
        "from lifecycle.middleware.process.control import leave_and_exit\n"
        "class Hangs:\n"
        "    waitables = ()\n"
        "    def destroy_node(self): ctypes.PyDLL(None).sleep(60)\n"
        "leave_and_exit(6, nodes=[Hangs()], deadline_s=0.2)\n"
    )
    assert subprocess.run([sys.executable, "-c", hang], check=False, timeout=50).returncode == 6


def test_an_exception_while_leaving_is_logged_and_the_rest_still_destroyed() -> None:
    leave = (
        "import logging\n"
        "from lifecycle.middleware.process.control import leave_and_exit\n"
        "logging.basicConfig(format='%(message)s')\n"
        "class Breaks:\n"
        "    waitables = ()\n"
        "    def destroy_node(self): raise OSError('broken')\n"
        "class Works(Breaks):\n"
        "    def destroy_node(self): print('destroyed')\n"
        "leave_and_exit(0, nodes=[Breaks(), Works()])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", leave], check=True, capture_output=True, text=True, timeout=30
    )
    assert done.stdout == "destroyed\n"
    assert "cannot destroy" in done.stderr
    assert done.stderr.endswith("OSError: broken\n")


def test_the_sweep_spares_a_living_process_and_clears_up_after_a_killed_one(
    observer: GraphObserver, wait_until: WaitUntil
) -> None:
    with start() as process:
        wait_until(lambda: "/plain" in names(observer))
        ours = owned_by([process.pid])
        kinds = {re.sub(r"[0-9a-f]{16}|\d+", "#", name) for name in ours}
        assert kinds == {
            "fastrtps_#",
            "fastrtps_#_el",
            "fastrtps_port#",
            "fastrtps_port#_el",
            # Neither mapped nor open while its port is in use: only its group tells.
            "sem.fastrtps_port#_mutex",
        }
        assert set(ours).isdisjoint(sweep())
        assert all(Path("/dev/shm", name).exists() for name in ours)
        process.kill()
        process.communicate(timeout=30)
    # The observer still sends to the port; the segment's owner is dead. Subsets, because a
    # supervisor that ends meanwhile, in another test process, may have swept it already.
    segment = {name for name in ours if "port" not in name}
    assert domains_own(ours).intersection(leftovers()) <= segment
    assert domains_own(ours).intersection(sweep()) <= segment
    assert not any(Path("/dev/shm", name).exists() for name in segment)
    assert all(Path("/dev/shm", name).exists() for name in domains_own(ours) - segment)
    observer.destroy()

    def is_gone() -> bool:
        sweep()  # of two at once each may take the other for an owner
        return not any(Path("/dev/shm", name).exists() for name in domains_own(ours))

    wait_until(is_gone)


def test_a_process_knows_whether_it_still_has_shared_memory_that_has_a_name(
    fresh_domain: int,
) -> None:
    code = (
        "import gc, sys, rclpy\n"
        "from lifecycle.middleware.process.shared_memory import holds_shared_memory\n"
        "print(holds_shared_memory())\n"
        "rclpy.init(domain_id=int(sys.argv[1]))\n"
        "node = rclpy.create_node('some')\n"
        "print(holds_shared_memory())\n"
        "node.destroy_node()\n"
        "rclpy.shutdown()\n"
        "del node\n"
        "gc.collect()\n"
        "print(holds_shared_memory())\n"
    )
    said = subprocess.check_output(
        [sys.executable, "-c", code, str(fresh_domain)], text=True, timeout=30
    )
    assert said.split() == ["False", "True", "False"]
