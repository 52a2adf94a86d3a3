"""Diagnostics, status and orders over ROS topics and services, for those without a shell.

Owns: when a supervisor publishes on /diagnostics and on its status topic, what it says there, and
how a service call becomes the order that the control socket would give. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Iterable, Sequence
from typing import Protocol

from msgspec.structs import replace

from lifecycle.codec import to_json
from lifecycle.errors import LifecycleError
from lifecycle.manifest import RosInterfaceAccess
from lifecycle.supervisor.control.orders import Done, Order, OrderKind
from lifecycle.supervisor.control.protocol import NodeStatus, SystemStatus
from lifecycle.supervisor.run.events import Event, LogLine, SystemReached
from lifecycle.verify import (
    MODE_SERVICE,
    Outcome,
    Verdict,
    supervisor_prefix,
    supervisor_services,
)

Entry = tuple[int, str, str, str, Sequence[tuple[str, str]]]
"""Level, name, message, hardware id and values of a diagnostic_msgs/DiagnosticStatus."""

OK, WARN, ERROR, STALE = range(4)
"""Levels of diagnostic_msgs/DiagnosticStatus."""

EACH_S = 1.0
"""How often diagnostics are published at least, as their aggregator expects it."""
_BURST_S = 0.05
_DOWN = "down"


class Offer(Protocol):
    """Topics and services, see lifecycle.middleware.RosInterface."""

    def publish_status(self, text: str) -> None:
        """Publish to present and later subscribers."""

    def publish_diagnostics(self, entries: Iterable[Entry]) -> None:
        """Publish diagnostics."""

    def destroy(self) -> None:
        """Offer and publish nothing any more."""


Answer = Callable[[bool, str], None]


class Offering(Protocol):
    """What makes topics and services, see ObserverParticipant."""

    def ros_interface(
        self, prefix: str, services: Iterable[str], on_call: Callable[[str, Answer], None]
    ) -> Offer:
        """Make them; calls come from any thread."""


class RosInterface:
    """What one run offers in ROS, from the moment that its system is active.

    Args:
        access: what the manifest allows.
        machine: of this supervisor, where the system has several; else empty.
        modes: names of those that it may be asked to enter.
        participant: makes topics and services.
        status: returns what is known now.
        verdict: returns the last one; None before the first.
        order: carries out an order.
        down: begins to take the system down.
    """

    def __init__(
        self,
        access: RosInterfaceAccess,
        machine: str,
        participant: Offering,
        *,
        modes: Iterable[str] = (),
        status: Callable[[], SystemStatus],
        verdict: Callable[[], Verdict | None],
        order: Callable[[Order], Awaitable[Done]],
        down: Callable[[], None],
    ) -> None:
        self._access = access
        self._machine = machine
        self._modes = tuple(modes)
        self._participant = participant
        self._status = status
        self._verdict = verdict
        self._order = order
        self._down = down
        self._offer: Offer | None = None
        self._due: asyncio.TimerHandle | None = None
        self._orders: set[asyncio.Task[None]] = set()
        self._rules: set[str] = set()
        self._published: SystemStatus | None = None
        self._hurries = False

    def on_event(self, event: Event) -> None:
        """Publish what changed; a listener of the run."""
        if isinstance(event, LogLine) or self._access is RosInterfaceAccess.OFF:
            return
        if self._offer is None:
            if isinstance(event, SystemReached) and event.reached == "active":
                self._open()
        elif not self._hurries:
            self._hurries = True  # changes come in bursts
            self._publish_in(_BURST_S)

    def close(self) -> None:
        """Publish a last time, and offer nothing any more; again is harmless."""
        if self._due is not None:
            self._due.cancel()
        offer, self._offer = self._offer, None
        if offer is not None:
            self._say(offer)
            offer.destroy()

    def _open(self) -> None:
        loop = asyncio.get_running_loop()

        def called(name: str, answer: Answer) -> None:
            with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
                loop.call_soon_threadsafe(self._called, name, answer)

        prefix = supervisor_prefix(self._status().system, self._machine)
        services = supervisor_services(self._access, self._modes)
        self._offer = self._participant.ros_interface(prefix, services, called)
        self._publish()

    def _publish_in(self, wait_s: float) -> None:
        if self._due is not None:
            self._due.cancel()
        self._due = asyncio.get_running_loop().call_later(wait_s, self._publish)

    def _publish(self) -> None:
        if self._offer is not None:
            self._hurries = False
            self._say(self._offer)
            self._publish_in(EACH_S)

    def _say(self, offer: Offer) -> None:
        status = self._status()
        if (timeless := _timeless(status)) != self._published:
            self._published = timeless
            offer.publish_status(to_json(status).decode())
        offer.publish_diagnostics(diagnostics(status, self._verdict(), self._rules))

    def _called(self, name: str, answer: Answer) -> None:
        if name == _DOWN:
            answer(True, "the system is being taken down")
            self._down()
        elif name.startswith(MODE_SERVICE) or name in {each.value for each in OrderKind}:
            mode = name.removeprefix(MODE_SERVICE)
            order = (
                Order(kind=OrderKind(name))
                if mode == name
                else Order(kind=OrderKind.MODE, mode=mode)
            )
            task = asyncio.ensure_future(self._ordered(order, answer))
            self._orders.add(task)
            task.add_done_callback(self._orders.discard)
        else:
            status = self._status()
            answer(status.verdict is not Outcome.VIOLATED, to_json(status).decode())

    async def _ordered(self, order: Order, answer: Answer) -> None:
        error = "cannot do this: the supervisor ends"
        try:
            error = (await self._order(order)).error
        except LifecycleError as refused:
            error = str(refused)
        finally:
            answer(not error, error or self._status().phase)


def _timeless(status: SystemStatus) -> SystemStatus:
    """Return a status without what changes with every second."""
    return replace(
        status,
        elapsed_s=0.0,
        nodes=tuple(
            replace(each, uptime_s=None, next_try_s=None, cpu_s=None, rss_bytes=None, threads=None)
            for each in status.nodes
        ),
    )


def diagnostics(
    status: SystemStatus, verdict: Verdict | None, reported: set[str]
) -> tuple[Entry, ...]:
    """Return one entry for each node, and one for each rule that is violated or unverifiable.

    Args:
        status: of the system.
        verdict: the last one; None before the first.
        reported: rules that had an entry before. They go on having one, which says that all is
            well: an aggregator would take an entry that does not come any more for a failure.
            Those of `verdict` are added.
    """
    findings = () if verdict is None else verdict.findings
    entries = [
        _of_node(
            each,
            status,
            Outcome.worst(
                finding.outcome
                for finding in findings
                if each.node in (*finding.nodes, finding.subject)
            ),
        )
        for each in status.nodes
    ]
    reported.update(each.rule for each in findings)
    for rule in sorted(reported):
        found = [each for each in findings if each.rule == rule]
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        entries.append(
            (
                _LEVELS[Outcome.worst(each.outcome for each in found)],
                f"{status.system}: {rule}",
                f"{found[0].message}{more}" if found else "ok",
                status.system,
                tuple((each.subject, each.observed) for each in found),
            )
        )
    return tuple(entries)


_LEVELS = {Outcome.OK: OK, Outcome.UNVERIFIABLE: WARN, Outcome.VIOLATED: ERROR}


def _of_node(node: NodeStatus, status: SystemStatus, outcome: Outcome) -> Entry:
    level, message = _LEVELS[outcome], node.state or node.reach.value
    if node.next_try_s is not None:
        level, message = ERROR, f"starts again in {node.next_try_s:.1f} s"
    elif node.died:
        level, message = ERROR, node.died
    elif node.silent:
        level, message = STALE, f"silent: {node.silent}"
    elif level == OK and status.phase != "active":
        level, message = WARN, f"{message}, the system is {status.phase}"
    values = [
        ("state", node.state),
        ("reach", node.reach.value),
        ("process", node.process),
        ("pid", str(node.pid or "")),
        ("matched", f"{node.matched}/{node.endpoints}"),
        ("findings", str(node.findings)),
        ("restarts", str(node.restarts)),
    ]
    if node.uptime_s is not None:
        values.append(("uptime_s", f"{node.uptime_s:.1f}"))
    if node.rss_bytes is not None:
        values += [("cpu_s", f"{node.cpu_s:.2f}"), ("rss_bytes", str(node.rss_bytes))]
    if node.last_failure is not None:
        values.append(("last_failure", f"{node.last_failure.at}: {node.last_failure.message}"))
    return level, f"{status.system}: {node.node}", message, status.system, tuple(values)
