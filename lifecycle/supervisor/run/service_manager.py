"""Notify systemd of a run's readiness, status and watchdog: the sd_notify protocol.

Owns: `ServiceManager`, a listener of events. READY is sent when the system is verified and active,
never before. Until then EXTEND_TIMEOUT_USEC, and always WATCHDOG, come from the supervisor's event
loop, so that a supervisor that hangs is ended.
Source: sd_notify(3), sd_watchdog_enabled(3), systemd.service(5) "Type=notify".
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from collections.abc import Callable, Mapping

from lifecycle.printable import one_line
from lifecycle.supervisor.run.events import (
    Event,
    Failure,
    GateOpened,
    RunStarted,
    Stopping,
    SystemReached,
    VerdictChanged,
)

_TIMES_PER_LIMIT = 2
"""sd_watchdog_enabled(3): send in half of the time that is given."""

_EXTENSION_S = 20.0
"""For how much longer it may be starting. Bring-up has its own deadlines, which count anew for what
is restarted; the service manager's is for a supervisor that hangs."""


class ServiceManager:
    """Reports one run to the service manager that has started this process, if one has.

    Args:
        environment: NOTIFY_SOCKET names its socket, a leading `@` an abstract one; WATCHDOG_USEC
            the microseconds within which it wants a sign of life, of the process WATCHDOG_PID.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = address if address.startswith(("/", "@")) else ""
        if address.startswith("@"):
            self._address = f"\0{address[1:]}"
        self._watchdog_s: float | None = None
        with contextlib.suppress(ValueError):
            pid = int(environment.get("WATCHDOG_PID", "") or os.getpid())
            limit_us = int(environment.get("WATCHDOG_USEC", ""))
            if pid == os.getpid() and limit_us > 0:
                self._watchdog_s = limit_us / 1e6
        self._timer: asyncio.TimerHandle | None = None
        self._starting = True
        self._active = False
        self._system = ""

    def on_event(self, event: Event) -> None:
        """Report what an event means for the service."""
        if isinstance(event, RunStarted):
            self._system = event.system
            self._send(STATUS=f"{event.system}: connecting {len(event.nodes)} nodes")
        elif isinstance(event, GateOpened):
            trusted = f"; taken on trust: {event.trusted}" if event.trusted else ""
            self._send(STATUS=f"{self._system}: verified, activating{trusted}")
        elif isinstance(event, SystemReached) and event.reached == "active":
            self._starting, self._active = False, True
            self._send(READY="1", STATUS=f"{self._system}: active and verified")
        elif isinstance(event, VerdictChanged):
            found = f", {len(event.verdict.findings)} findings" if event.verdict.findings else ""
            phase = "active" if self._active else "connecting"
            self._send(STATUS=f"{self._system}: {phase}, {event.verdict.verdict.value}{found}")
        elif isinstance(event, Failure):
            self._send(STATUS=f"{self._system}: {event.message}")
        elif isinstance(event, Stopping):
            self._starting = self._active = False
            self._send(STOPPING="1", STATUS=f"{self._system}: stopping, {event.reason}")

    def watch(self) -> Callable[[], None]:
        """Send signs of life from the running event loop; return what ends that."""
        if self._address:
            limit_s = min(self._watchdog_s or _EXTENSION_S, _EXTENSION_S)
            self._alive(asyncio.get_running_loop(), limit_s / _TIMES_PER_LIMIT)

        def end() -> None:
            if self._timer is not None:
                self._timer.cancel()

        return end

    def _alive(self, loop: asyncio.AbstractEventLoop, period_s: float) -> None:
        if self._starting:
            self._send(EXTEND_TIMEOUT_USEC=f"{_EXTENSION_S * 1e6:.0f}")
        if self._watchdog_s is not None:
            self._send(WATCHDOG="1")
        self._timer = loop.call_later(period_s, self._alive, loop, period_s)

    def _send(self, **state: str) -> None:
        """Send without waiting: a service manager that does not read is no reason to stop."""
        if not self._address:
            return
        text = "\n".join(f"{name}={one_line(value)}" for name, value in state.items())
        with (
            contextlib.suppress(OSError),
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender,
        ):
            sender.sendto(text.encode(), self._address)
