"""Diagnostics, status and orders over ROS topics and services, for those without a shell.

Owns: when a supervisor publishes on /diagnostics and on its status topic, what it says there, and
how a service call becomes the order that the control socket would give. None of it is there while
a bring-up goes on: it is made a moment after the system is active, or once nothing goes on. Must
not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterable, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING

from msgspec.structs import replace

from lifecycle.codec import to_json
from lifecycle.errors import ExitCode, LifecycleError, MiddlewareError
from lifecycle.manifest.model import Policy, RosInterfaceAccess
from lifecycle.manifest.names import MODE_SERVICE, supervisor_prefix, supervisor_services
from lifecycle.plan.model import Plan
from lifecycle.supervisor.control.protocol import ControlRequest, NodeStatus, SystemStatus
from lifecycle.supervisor.core.orders import FITS
from lifecycle.supervisor.core.state import Order
from lifecycle.supervisor.run.events import (
    Emitter,
    Event,
    GateOpened,
    NodeChanged,
    NodeJoined,
    Notice,
    ProcessChanged,
    RequestSent,
    Stopping,
    SystemReached,
    WiringChanged,
)
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.tool_filter import supervisor_label, takes_diagnostics
from lifecycle.verify.verdict import Verdict

if TYPE_CHECKING:
    from lifecycle.middleware.services.ros_interface import RosInterface as RosEntities
    from lifecycle.supervisor.nodes.observer_participant import ObserverParticipant
    from lifecycle.supervisor.shell.supervisor import Supervisor

Entry = tuple[int, str, str, str, Sequence[tuple[str, str]]]
"""Level, name, message, hardware id and values of a diagnostic_msgs/DiagnosticStatus."""

OK, WARN, ERROR, STALE = range(4)
"""Levels of diagnostic_msgs/DiagnosticStatus."""

EACH_S = 1.0
"""How often diagnostics are published at least, as their aggregator expects it."""
HELD_UP_S = 3.5
"""A bring-up in which nothing happened for so long is held up, and says why. What discovery lost it
sends again after 3 s (middleware/rcl/graph.py)."""
AFTER_ACTIVE_S = 0.25
"""What was to do for `active` is done first; who ends the system then pays nothing for this."""
_BURST_S = 0.05
_DOWN = "down"
_PACKAGES = ("diagnostic_msgs", "std_msgs", "std_srvs")
_ON_ITS_WAY = (
    GateOpened,
    NodeChanged,
    NodeJoined,
    ProcessChanged,
    RequestSent,
    SystemReached,
    WiringChanged,
)
"""Events of a bring-up that goes on; another verdict may come for ever."""


def check_installed(policy: Policy) -> None:
    """Make sure that what a manifest asks for can be offered.

    Raises:
        MiddlewareError: a package is not installed.
    """
    if not policy.ros_interface_required or policy.ros_interface is RosInterfaceAccess.OFF:
        return
    if lacking := [name for name in _PACKAGES if find_spec(name) is None]:
        raise MiddlewareError(
            f"cannot offer 'policy: {{ros_interface: {policy.ros_interface.value}}}': no Python "
            f"package {' or '.join(lacking)} is installed",
            hint="install it, or write 'policy: {ros_interface: off}'",
        )


Answer = Callable[[bool, str], None]


class RosInterface:
    """What one run offers in ROS, from the moment that its system is active or held up.

    Args:
        session: what is asked and ordered.
        plan: whose policy says what is allowed.
        machine: of this supervisor, where the system has several; else empty.
        participant: makes topics and services.
        emit: takes a notice, once, of why nothing can be offered.
        modes: names of those that it may be asked to enter.
    """

    def __init__(
        self,
        session: Supervisor,
        plan: Plan,
        machine: str,
        participant: ObserverParticipant,
        *,
        emit: Emitter,
        modes: Iterable[str] = (),
    ) -> None:
        self._session = session
        self._plan = plan
        self._access = plan.policy.ros_interface
        self._machine = machine
        self._modes = tuple(modes)
        self._participant = participant
        self._emit = emit
        self._offer: RosEntities | None = None
        self._opens = self._access is not RosInterfaceAccess.OFF
        self._was_active = False
        self._due: asyncio.TimerHandle | None = None
        self._orders: set[asyncio.Task[None]] = set()
        self._rules: set[str] = set()
        self._published: SystemStatus | None = None
        self._hurries = False

    def begin(self) -> None:
        """Wait from now on for the system to be active, or to be held up."""
        if self._opens:
            self._in(HELD_UP_S, self._open)

    def on_event(self, event: Event) -> None:
        """Publish what changed; a listener of the run."""
        if self._offer is not None:
            if not self._hurries:
                self._hurries = True  # changes come in bursts
                self._in(_BURST_S, self._publish)
        elif isinstance(event, Stopping):
            self._stop()
        elif self._opens and not self._was_active and isinstance(event, _ON_ITS_WAY):
            self._was_active = isinstance(event, SystemReached) and event.reached == "active"
            self._in(AFTER_ACTIVE_S if self._was_active else HELD_UP_S, self._open)

    def close(self) -> None:
        """Publish a last time, and offer nothing any more; again is harmless."""
        self._stop()
        offer, self._offer = self._offer, None
        if offer is not None:
            self._say(offer)
            offer.destroy()

    def _in(self, wait_s: float, do: Callable[[], None]) -> None:
        """Do something later, in place of what was to be done."""
        if self._due is not None:
            self._due.cancel()
        self._due = asyncio.get_running_loop().call_later(wait_s, do)

    def _stop(self) -> None:
        self._opens = False
        if self._due is not None:
            self._due.cancel()

    def _open(self) -> None:
        self._opens = False
        loop = asyncio.get_running_loop()

        def called(name: str, answer: Answer) -> None:
            with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
                loop.call_soon_threadsafe(self._called, name, answer)

        prefix = supervisor_prefix(self._plan.system, self._machine)
        services = supervisor_services(self._access, self._modes)
        try:
            self._offer = self._participant.ros_interface(
                prefix, services, called, diagnoses=takes_diagnostics(self._plan)
            )
        except MiddlewareError as error:
            why = (
                f"cannot offer diagnostics and status in ROS: {error}; the system runs without; "
                "'policy: {ros_interface: off}' does not try"
            )
            self._emit(Notice(message=why))
        else:
            self._publish()

    def _publish(self) -> None:
        if self._offer is not None:
            self._hurries = False
            self._say(self._offer)
            self._in(EACH_S, self._publish)

    def _say(self, offer: RosEntities) -> None:
        seen = self._session.look()
        status = seen.status
        if (timeless := _timeless(status)) != self._published:
            self._published = timeless
            offer.publish_status(to_json(status).decode())
        label = supervisor_label(status.system, self._machine)
        source = supervisor_prefix(status.system, self._machine)
        offer.publish_diagnostics(
            diagnostics(status, seen.verdict, self._rules, label=label, source=source)
        )

    def _called(self, name: str, answer: Answer) -> None:
        if name == _DOWN:
            answer(True, "the system is being taken down")
            self._session.stop("the down service", ExitCode.BRING_UP_FAILED)
        elif name.startswith(MODE_SERVICE) or name in {each.value for each in FITS}:
            mode = name.removeprefix(MODE_SERVICE)
            order = (
                Order(ask=ControlRequest(name))
                if mode == name
                else Order(ask=ControlRequest.MODE, mode=mode)
            )
            task = asyncio.ensure_future(self._ordered(order, answer))
            self._orders.add(task)
            task.add_done_callback(self._orders.discard)
        else:
            status = self._session.status()
            answer(status.verdict is not Outcome.VIOLATED, to_json(status).decode())

    async def _ordered(self, order: Order, answer: Answer) -> None:
        error = "cannot do this: the supervisor ends"
        try:
            error = (await self._session.order(order)).error
        except LifecycleError as refused:
            error = str(refused)
        finally:
            answer(not error, error or self._session.status().phase)


def _timeless(status: SystemStatus) -> SystemStatus:
    """Return a status without what changes with every second."""
    return replace(
        status,
        elapsed_s=0.0,
        nodes=tuple(
            replace(
                each,
                uptime_s=None,
                next_try_s=None,
                cpu_s=None,
                rss_bytes=None,
                threads=None,
            )
            for each in status.nodes
        ),
    )


def diagnostics(
    status: SystemStatus, verdict: Verdict | None, reported: set[str], *, label: str, source: str
) -> tuple[Entry, ...]:
    """Return one entry for each node, and one for each rule that is violated or unverifiable.

    Args:
        status: of the system.
        verdict: the last one; None before the first.
        reported: rules that had an entry before. They go on having one, which says that all is
            well: an aggregator would take an entry that does not come any more for a failure.
            Those of `verdict` are added.
        label: what the names of entries begin with, which an aggregator knows them by.
        source: their hardware id, by which those who read the health of nodes leave them out.
    """
    findings = () if verdict is None else verdict.findings
    entries = [
        _of_node(
            each,
            status,
            (label, source),
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
                f"{label}: {rule}",
                f"{found[0].message}{more}" if found else "ok",
                source,
                tuple((each.subject, each.observed) for each in found),
            )
        )
    return tuple(entries)


_LEVELS = {Outcome.OK: OK, Outcome.UNVERIFIABLE: WARN, Outcome.VIOLATED: ERROR}


def _of_node(
    node: NodeStatus, status: SystemStatus, label: tuple[str, str], outcome: Outcome
) -> Entry:
    level, message = _LEVELS[outcome], node.state or node.reach.value
    message += f", {node.doing}" if node.doing else ""
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
    return level, f"{label[0]}: {node.node}", message, label[1], tuple(values)
