"""What the tests of nodes share: a driver of managed nodes, and hosts."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from asking import Asking
from host_process import HostProcess
from lifecycle_driver import Driver
from planning import built_with, planned

from lifecycle import LifecycleNode
from lifecycle.plan.model import PlannedNode


@pytest.fixture
def driver(context: rclpy.Context) -> Iterator[Driver]:
    """One executor, with clients for everything that `ros2 lifecycle` asks."""
    driver = Driver(context)
    yield driver
    driver.close()


@pytest.fixture
def start(fresh_domain: int, tmp_path: Path) -> Iterator[Callable[..., HostProcess]]:
    """Start hosts in a domain of their own."""
    hosts: list[HostProcess] = []

    def start(*nodes: PlannedNode, **spec: Any) -> HostProcess:
        log = tmp_path / f"host{len(hosts)}.log"
        host = HostProcess(fresh_domain, nodes, log, **spec)
        hosts.append(host)
        return hosts[-1]

    yield start
    for host in hosts:
        host.close()


@pytest.fixture
def ask(driver: Driver) -> Iterator[Callable[..., Asking]]:
    """Make an ordinary action client of a server: `ask("/count", node)`."""
    with contextlib.ExitStack() as stack:

        def ask(action: str, server: Any) -> Asking:
            asking = Asking(driver, action, server)
            stack.callback(asking.close)
            return asking

        yield ask


@pytest.fixture
def active(driver: Driver, context: rclpy.Context) -> Callable[..., Any]:
    """Construct a class as node /it, spin it and bring it to a state, active by default."""

    def active(
        node_class: type[LifecycleNode], *endpoints: Any, to: str = "activate", **plan: Any
    ) -> Any:
        spec = planned("it", *endpoints, **plan)
        with built_with(spec, context):
            node = node_class()
        driver.add(node)
        for label in ("configure", "connect", "activate"):
            if to:
                assert driver.set(spec.full_name, label)
            if label == to:
                break
        return node

    return active
