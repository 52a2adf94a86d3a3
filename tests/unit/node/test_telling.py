"""Who is told of connections and of the configuration, when, and how often."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import pytest

from lifecycle.manifest.model import EndpointKind
from lifecycle.node.configuration import ConfigurationChanges
from lifecycle.node.connections import (
    ConnectionEvent,
    ConnectionEventKind,
    events_between,
    listen_to_connections,
)
from lifecycle.verify.observation import EndpointReport, NodeConfiguration
from lifecycle.verify.outcome import ConnectionReport
from tests.builders import configuration

Wired = dict[str, dict[str, int]]
"""Peers of the publishers on each connection."""


def wired(connections: Wired) -> NodeConfiguration:
    """Return what a node with these connections says of itself."""
    ends = [
        EndpointReport(
            kind=EndpointKind.PUBLISHER,
            name=name,
            resolved=f"/{name}",
            type="std_msgs/msg/String",
            qos=None,
            connection=connection,
            mapped=True,
            matched=peers,
        )
        for connection, on in connections.items()
        for name, peers in on.items()
    ]
    made = tuple(
        ConnectionReport(name=name, established=all(on.values()))
        for name, on in connections.items()
    )
    return configuration("/it", *ends, connections=made)


def unexpected(trace: str) -> None:
    raise AssertionError(trace)


class Executor:
    """Runs what it is given when it is told to."""

    def __init__(self) -> None:
        self.tasks: list[Callable[[], Any]] = []

    def later(self, task: Callable[[], Any]) -> bool:
        self.tasks.append(task)
        return True

    def turn(self) -> None:
        while self.tasks:
            returned = self.tasks.pop(0)()
            if returned is not None:
                for _ in returned.__await__():
                    raise AssertionError("the listeners of these tests do not wait")


@pytest.mark.parametrize(
    ("before", "after", "events"),
    [
        ({}, {"net": {}}, ["made net"]),
        ({}, {"net": {"video": 0}}, ["made net", "mapped video 0"]),
        ({"net": {"video": 0}}, {"net": {"video": 2}}, ["mapped video 2", "made net"]),
        ({"net": {"video": 2}}, {"net": {"video": 1}}, ["unmapped video 1"]),
        ({"net": {"video": 2}}, {"net": {"video": 0}}, ["unmapped video 0", "lost net"]),
        # What has no peer yet is no loss.
        ({"net": {"video": 1}}, {"net": {"video": 1, "map": 0}}, ["mapped map 0"]),
        ({"net": {"video": 1}}, {}, ["unmapped video gone", "lost net gone"]),
        ({"net": {"video": 1}}, {"net": {}}, ["unmapped video gone"]),
    ],
)
def test_what_is_different_is_what_listeners_are_told(
    before: Wired, after: Wired, events: list[str]
) -> None:
    words = {
        ConnectionEventKind.CONNECTION_ESTABLISHED: "made",
        ConnectionEventKind.CONNECTION_LOST: "lost",
        ConnectionEventKind.MAPPING_ESTABLISHED: "mapped",
        ConnectionEventKind.MAPPING_LOST: "unmapped",
    }
    found = [
        f"{words[each.kind]} {each.endpoint.partition('/')[2] or each.connection}"
        + (" gone" if each.unmade else "" if each.peers is None else f" {each.peers}")
        for each in events_between(wired(before), wired(after))
    ]
    assert found == events


def test_sync_and_async_listeners_are_called_until_they_are_removed() -> None:
    executor = Executor()
    now = [wired({})]
    changes = ConfigurationChanges(executor.later, lambda: now[0], failed=unexpected)
    listen_to = functools.partial(listen_to_connections, changes, executor.later)
    heard: list[str] = []

    async def listen(event: ConnectionEvent) -> None:
        heard.append(f"async {event.connection}")

    listen_to(lambda event: heard.append(f"sync {event.connection}"))
    remove = listen_to(listen)
    for name in ("net", "radio"):
        now[0] = wired({name: {}, **{each.name: {} for each in now[0].connections}})
        changes.touch()
        executor.turn()
        remove()
    assert heard == ["sync net", "async net", "sync radio"]


def test_many_changes_of_one_turn_are_one_notice_and_are_collected_once() -> None:
    executor = Executor()
    collected: list[Any] = []
    heard: list[Any] = []

    def collect() -> Any:
        collected.append(object())
        return collected[-1]

    changes = ConfigurationChanges(executor.later, collect, failed=unexpected)
    changes.touch()
    assert executor.tasks == []  # nobody listens, so nothing is collected
    changes.listen(heard.append)
    changes.touch()
    changes.touch()
    executor.turn()
    assert heard == collected
    assert len(collected) == 1
    changes.touch()
    executor.turn()
    assert len(heard) == 2


def test_a_node_that_cannot_be_described_tells_the_log_and_nobody_else() -> None:
    executor = Executor()
    log: list[str] = []
    heard: list[Any] = []

    def collect() -> Any:
        raise OSError("no such file")

    changes = ConfigurationChanges(executor.later, collect, failed=log.append)
    changes.listen(heard.append)
    changes.touch()
    executor.turn()
    assert heard == []
    assert log[0].endswith("OSError: no such file\n")


def test_a_change_while_the_configuration_is_collected_is_told() -> None:
    executor = Executor()
    heard: list[Any] = []

    def collect() -> Any:
        if not heard:
            changes.touch()
        return object()

    changes = ConfigurationChanges(executor.later, collect, failed=unexpected)
    changes.listen(heard.append)
    changes.touch()
    executor.turn()
    assert len(heard) == 2
