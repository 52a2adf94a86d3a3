"""What every test on real DDS shares: a domain of its own, loopback only, nothing left behind.

A domain is claimed by an abstract socket, so that test processes on one machine never meet: two
runs side by side, or the workers of one run. The socket, and with it the claim, goes with the
process. `LIFECYCLE_TEST_DOMAINS=10-19` narrows the pool.
"""

from __future__ import annotations

import contextlib
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

with warnings.catch_warnings():
    # rclpy imports lark through its type supports, and lark a module that is deprecated.
    warnings.simplefilter("ignore", DeprecationWarning)
    import rclpy
    import rosidl_generator_py  # noqa: F401

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from lifecycle.middleware.fastdds.profiles import discovery_environment
from lifecycle.middleware.process.shared_memory import leftovers
from lifecycle.middleware.versions import DISTRIBUTIONS
from lifecycle.pytest_plugin import claimed_domain
from tests.second_try import SECOND_TRY
from tests.shared_memory import owned_by

BOUND_S = 30.0
"""Seconds that a wait for an event may take on a busy machine; it ends with the event."""


@pytest.fixture(scope="session", autouse=True)
def domain_id(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The ROS domain of this test process; the environment is set for it and for its children."""
    with claimed_domain() as domain, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("ros_log")))
        for each in DISTRIBUTIONS:
            patch.delenv(each.profiles_variable, raising=False)
        profiles = discovery_environment(tmp_path_factory.mktemp("profiles"))
        for name, value in profiles.items():
            patch.setenv(name, value)
        yield domain


@pytest.fixture
def fresh_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A domain for one test alone: nodes killed in it haunt the graph for 20 s, and nobody else."""
    with claimed_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        yield domain


@pytest.fixture(scope="module")
def shared_domain() -> Iterator[int]:
    """A domain for the tests of one module that look at one running system."""
    with claimed_domain() as domain:
        yield domain


_Seen = dict[tuple[str, int], str]
"""By name and inode of a file: the test after which it was first left; empty while it was not.

A port has the same name whoever makes it: one of another test, or of a process that no supervisor
of ours has started, is another file.
"""


@pytest.fixture(scope="session", autouse=True)
def _shared_memory() -> Iterator[_Seen]:
    """Fail the run if a segment that it made is left and unused at its end, and say since when."""
    seen: _Seen = {}
    yield seen
    left = {file[0]: seen[file] for file in _left(seen)}
    assert left == {}, "shared memory files were left behind"


def _files(names: Iterable[str]) -> Iterator[tuple[str, int]]:
    """Yield files of these names as they are now."""
    for name in names:
        with contextlib.suppress(FileNotFoundError):
            yield name, Path("/dev/shm", name).stat().st_ino


def _left(seen: _Seen) -> list[tuple[str, int]]:
    return [each for each in _files(leftovers()) if each in seen]


@pytest.fixture(autouse=True)
def _note_shared_memory(_shared_memory: _Seen, request: pytest.FixtureRequest) -> Iterator[None]:
    """Note what is used, and fail the test whose participants would haunt those that follow."""
    me = psutil.Process()
    before = owned_by([me.pid])
    yield
    after = owned_by([me.pid])
    used = after | owned_by([child.pid for child in me.children(recursive=True)])
    for file in _files(used):
        _shared_memory.setdefault(file, "")
    for file in _left(_shared_memory):
        _shared_memory[file] = _shared_memory[file] or request.node.nodeid
    assert after - before == set(), (
        "a participant of this test is still there: destroy all that belongs to it"
    )


@pytest.fixture
def context(domain_id: int) -> Iterator[rclpy.Context]:
    """An rclpy context in the test's domain."""
    context = rclpy.Context()
    context.init(args=[], domain_id=domain_id)
    yield context
    context.try_shutdown()
    context.destroy()


@pytest.fixture
def make_node(context: rclpy.Context) -> Iterator[Callable[..., Node]]:
    """Make nodes that go with the test: `make_node("talker", namespace="/robot")`."""
    nodes: list[Node] = []

    def make(name: str, **options: Any) -> Node:
        nodes.append(Node(name, context=context, **{"enable_rosout": False, **options}))
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()


SpinUntil = Callable[..., None]


@pytest.fixture
def spin_until(context: rclpy.Context) -> Iterator[SpinUntil]:
    """Spin nodes until something holds: `spin_until(lambda: got, node, other)`."""

    def spin(holds: Callable[[], object], *nodes: Node, timeout_s: float = BOUND_S) -> None:
        executor = SingleThreadedExecutor(context=context)
        for node in nodes:
            executor.add_node(node)
        deadline = time.monotonic() + timeout_s
        try:
            while not holds():
                assert time.monotonic() < deadline, f"not within {timeout_s} s"
                executor.spin_once(timeout_sec=0.02)
        finally:
            for node in nodes:
                executor.remove_node(node)
            executor.shutdown()

    return spin


@pytest.fixture
def wait_until() -> Callable[..., None]:
    """Wait, without spinning, until something holds that no event tells of."""

    def wait(holds: Callable[[], object], *, timeout_s: float = BOUND_S) -> None:
        deadline = time.monotonic() + timeout_s
        while not holds():
            assert time.monotonic() < deadline, f"not within {timeout_s} s"
            time.sleep(0.005)

    return wait


_DROPPED_REPLY = "ignore:failed to send response:RuntimeWarning"
"""rclpy warns of a reply whose reader the server does not know yet, and who asked asks again.

As an error it would end the executor, and the thread, of a server in this process.
"""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark everything below tests/ros as `ros`, and give it a second try."""
    here = Path(__file__).parent
    for item in items:
        if here in item.path.parents:
            item.add_marker(pytest.mark.ros)
            item.add_marker(SECOND_TRY)
            item.add_marker(pytest.mark.filterwarnings(_DROPPED_REPLY))
