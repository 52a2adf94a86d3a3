"""What every test on several hosts shares: they are skipped, with the reason, where none can be."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.net.hosts import Host, Hosts, lacking
from tests.second_try import SECOND_TRY


@pytest.fixture
def hosts() -> Iterator[Hosts]:
    """Hosts that end with the test."""
    with Hosts() as hosts:
        yield hosts


@pytest.fixture
def pair(hosts: Hosts) -> tuple[Host, Host]:
    """Hosts A and B on one switch."""
    one, other = hosts.bridged("A", "B")
    return one, other


@pytest.fixture(scope="module")
def switched() -> Iterator[tuple[Host, Host]]:
    """Two hosts on one switch, for the tests of a module."""
    with Hosts() as made:
        one, other = made.bridged("one", "other")
        yield one, other


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark everything below tests/net, give it a second try, and skip it where no host can be.

    All of it is `thorough`: most machines cannot run it.
    """
    here = Path(__file__).parent
    mine = [item for item in items if here in item.path.parents]
    reason = lacking() if mine else ""
    for item in mine:
        item.add_marker(pytest.mark.net)
        item.add_marker(pytest.mark.thorough)
        item.add_marker(SECOND_TRY)
        if reason:
            item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give hosts none of what tests/ros sets for its own processes in the same session."""
    for name in (
        "ROS_DOMAIN_ID",
        "ROS_AUTOMATIC_DISCOVERY_RANGE",
        "FASTRTPS_DEFAULT_PROFILES_FILE",
    ):
        monkeypatch.delenv(name, raising=False)
