"""Domains of their own for cases, and the marks of all that is below."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.second_try import SECOND_TRY

DOMAINS = (*range(215, 232), *range(70, 102))
"""Their ports lie outside Linux's ephemeral range (32768–60999)."""


@pytest.fixture
def domain() -> Iterator[int]:
    """A ROS domain that no other test of this machine has, claimed by an abstract socket."""
    pool = DOMAINS
    if given := os.environ.get("LIFECYCLE_TEST_DOMAINS", ""):
        first, _, last = given.partition("-")
        pool = tuple(range(int(first), int(last or first) + 1))
    with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)) as claim:
        for each in pool:
            with contextlib.suppress(OSError):
                claim.bind(f"\0lifecycle-test-domain-{each}")
                yield each
                return
        pytest.fail(f"all test domains {pool} are taken; see LIFECYCLE_TEST_DOMAINS")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark all below as `ros`; Fast DDS may lose a first contact."""
    here = Path(__file__).parent
    for item in items:
        if here in item.path.parents:
            item.add_marker(pytest.mark.ros)
            item.add_marker(SECOND_TRY)
