"""Domains of their own for cases, and the marks of all that is below."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from lifecycle.pytest_plugin import claimed_domain
from tests.second_try import SECOND_TRY


@pytest.fixture
def domain() -> Iterator[int]:
    """A ROS domain that no other test of this machine has."""
    with claimed_domain() as domain:
        yield domain


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark all below as `ros`; Fast DDS may lose a first contact."""
    here = Path(__file__).parent
    for item in items:
        if here in item.path.parents:
            item.add_marker(pytest.mark.ros)
            item.add_marker(SECOND_TRY)
