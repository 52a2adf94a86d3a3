"""systemd is notified when a system is verified and active, and of nothing sooner."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from lifecycle.supervisor.run.events import (
    GateOpened,
    Stopping,
    SystemReached,
    VerdictChanged,
)
from lifecycle.supervisor.run.journal import ServiceManager
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Stage
from tests.unit.supervisor.fakes import run_started, verdict_of


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sink:
        sink.bind(str(tmp_path / "notify"))
        sink.setblocking(False)
        yield sink


def _received(manager: socket.socket) -> list[list[str]]:
    found: list[list[str]] = []
    with contextlib.suppress(BlockingIOError):
        while True:
            found.append(manager.recv(4096).decode().split("\n"))
    return found


def test_a_system_is_ready_when_it_is_active_and_not_before(
    manager: socket.socket, tmp_path: Path
) -> None:
    service = ServiceManager({"NOTIFY_SOCKET": str(tmp_path / "notify")})
    service.on_event(run_started("/a", "/b", system="arm"))
    service.on_event(SystemReached(reached="connected", elapsed_s=1.0))
    service.on_event(
        VerdictChanged(stage=Stage.CONNECTED, verdict=verdict_of(Outcome.VIOLATED, "graph.x"))
    )
    service.on_event(SystemReached(reached="verified", elapsed_s=1.0))
    service.on_event(GateOpened(outcome="ok", nodes=("/a",), trusted="a\nb"))
    assert _received(manager) == [
        ["STATUS=arm: connecting 2 nodes"],
        ["STATUS=arm: connecting, violated, 1 findings"],
        ["STATUS=arm: verified, activating; taken on trust: a\\nb"],
    ]
    service.on_event(SystemReached(reached="active", elapsed_s=2.0))
    assert _received(manager) == [["READY=1", "STATUS=arm: active and verified"]]
    service.on_event(Stopping(reason="SIGTERM"))
    assert _received(manager) == [["STOPPING=1", "STATUS=arm: stopping, SIGTERM"]]


def test_the_watchdog_is_served_in_half_of_its_time_from_the_loop(
    manager: socket.socket, tmp_path: Path
) -> None:
    environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "40000"}
    service = ServiceManager({**environment, "WATCHDOG_PID": str(os.getpid())})

    service.on_event(SystemReached(reached="active", elapsed_s=2.0))
    _received(manager)

    async def main() -> None:
        loop = asyncio.get_running_loop()
        end = service.watch()
        for _ in range(3):
            await asyncio.wait_for(loop.sock_recv(manager, 100), 5.0)
        end()
        assert _received(manager) == []

    asyncio.run(main())
    other = ServiceManager({**environment, "WATCHDOG_PID": "1"})
    asyncio.run(_watched(other))
    assert ["WATCHDOG=1"] not in _received(manager)


def test_a_bring_up_that_goes_on_has_more_time_until_it_is_active(
    manager: socket.socket, tmp_path: Path
) -> None:
    """What is restarted during bring-up has its time anew; a fixed limit would cut that off."""
    service = ServiceManager({"NOTIFY_SOCKET": str(tmp_path / "notify")})
    asyncio.run(_watched(service))
    assert _received(manager) == [["EXTEND_TIMEOUT_USEC=20000000"]]
    service.on_event(SystemReached(reached="active", elapsed_s=2.0))
    assert _received(manager) == [["READY=1", "STATUS=: active and verified"]]
    asyncio.run(_watched(service))
    assert _received(manager) == []


async def _watched(service: ServiceManager) -> None:
    service.watch()()


def test_without_a_service_manager_nothing_is_sent_and_a_deaf_one_stops_nothing(
    tmp_path: Path,
) -> None:
    gone = {"NOTIFY_SOCKET": str(tmp_path / "gone"), "WATCHDOG_USEC": "x"}
    for environment in ({}, {"NOTIFY_SOCKET": "relative"}, gone):
        service = ServiceManager(environment)
        service.on_event(SystemReached(reached="active", elapsed_s=2.0))
