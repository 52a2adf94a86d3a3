"""Diagnostics, status and orders over ROS topics and services, for those without a shell.

Owns: when a supervisor publishes on /diagnostics and on its status topic, what it says there, and
how a service call becomes the order that the control socket would give. It is made a moment after
the system is active, or once bring-up takes long. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import msgspec

from lifecycle.codec import to_json
from lifecycle.errors import ExitCode, MiddlewareError
from lifecycle.graph.loop import set_within
from lifecycle.manifest.model import RosInterfaceAccess
from lifecycle.manifest.names import supervisor_prefix, supervisor_services
from lifecycle.measure.flows import FlowMeasurement, Pair
from lifecycle.supervisor.control.protocol import ControlRequest, NodeStatus, SystemStatus, timeless
from lifecycle.supervisor.core.state import Order
from lifecycle.supervisor.run.events import Event, LogLine, Notice, Stopping, SystemReached
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.tool_filter import supervisor_label, takes_diagnostics
from lifecycle.verify.verdict import FlowReport, Verdict

if TYPE_CHECKING:
    from lifecycle.middleware.services.supervisor_topics import RosInterface as RosEntities
    from lifecycle.supervisor.shell.supervisor import Supervisor

Entry = tuple[int, str, str, str, Sequence[tuple[str, str]]]
"""Level, name, message, hardware id and values of a diagnostic_msgs/DiagnosticStatus."""

OK, WARN, ERROR, STALE = range(4)
"""Levels of diagnostic_msgs/DiagnosticStatus."""

EACH_S = 1.0
"""How often diagnostics are published at least, as their aggregator expects it."""
BRINGS_UP_S = 3.5
"""A bring-up that takes longer says why. What discovery lost it sends again after 3 s
(middleware/rcl/graph.py)."""
AFTER_ACTIVE_S = 0.25
"""What was to do for `active` is done first; who ends the system then pays nothing for this."""
_BURST_S = 0.05


Answer = Callable[[bool, str], None]


class RosInterface:
    """What one run offers in ROS, from the moment that its system is active or held up."""

    def __init__(self, supervisor: Supervisor) -> None:
        self._supervisor = supervisor
        self._machine = min(supervisor.system.machines or ("",))
        self._offer: RosEntities | None = None
        self._active = asyncio.Event()
        self._changed = asyncio.Event()
        self._ends = False
        self._reported = Reported()
        self._published: SystemStatus | None = None

    def on_event(self, event: Event) -> None:
        """Note that there is something new to publish; a listener of the run."""
        if not isinstance(event, LogLine):
            self._changed.set()
        if isinstance(event, SystemReached) and event.reached == "active":
            self._active.set()
        self._ends = self._ends or isinstance(event, Stopping)

    async def follow(self) -> None:
        """Offer it as soon as it is time, and publish what changes, until this is cancelled."""
        if self._supervisor.system.plan.policy.access is RosInterfaceAccess.OFF:
            return
        if await set_within(self._active, BRINGS_UP_S):
            await asyncio.sleep(AFTER_ACTIVE_S)
        if not self._ends:
            self._open()
        while self._offer is not None:
            self._changed.clear()
            self._say(self._offer)
            if await set_within(self._changed, EACH_S):
                await asyncio.sleep(_BURST_S)  # changes come in bursts

    def close(self) -> None:
        """Publish a last time, and offer nothing any more; again is harmless."""
        offer, self._offer = self._offer, None
        if offer is not None:
            self._say(offer)
            offer.destroy()

    def _open(self) -> None:
        loop, system = asyncio.get_running_loop(), self._supervisor.system

        def called(name: str, answer: Answer) -> None:
            with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
                loop.call_soon_threadsafe(self._called, name, answer)

        modes = () if system.remote else (each.name for each in system.plan.modes)
        try:
            self._offer = self._supervisor.means.participant.ros_interface(
                supervisor_prefix(system.plan.system, self._machine),
                supervisor_services(system.plan.policy.access, modes),
                called,
                diagnoses=takes_diagnostics(system.plan),
            )
        except MiddlewareError as error:
            why = (
                f"cannot offer diagnostics and status in ROS: {error}; the system runs without; "
                "'policy: {ros_interface: off}' does not try"
            )
            system.emit(Notice(message=why))

    def _say(self, offer: RosEntities) -> None:
        seen = self._supervisor.look()
        status = seen.status
        if (known := timeless(status)) != self._published:
            self._published = known
            offer.publish_status(to_json(status).decode())
        label = supervisor_label(status.system, self._machine)
        source = supervisor_prefix(status.system, self._machine)
        offer.publish_diagnostics(
            diagnostics(status, seen.verdict, self._reported, label=label, source=source)
        )

    def _called(self, name: str, answer: Answer) -> None:
        if name == "get_status":
            status = self._supervisor.status()
            answer(status.verdict is not Outcome.VIOLATED, to_json(status).decode())
        elif name == ControlRequest.DOWN.value:
            answer(True, "the system is being taken down")
            self._supervisor.stop("the down service", ExitCode.BRING_UP_FAILED)
        else:
            ask, _, mode = name.partition("/")  # MODE_SERVICE is followed by a mode
            order = Order(ask=ControlRequest(ask), mode=mode)
            self._supervisor.start(self._ordered(order, answer))

    async def _ordered(self, order: Order, answer: Answer) -> None:
        error = "cannot do this: the supervisor ends"
        try:
            error = (await self._supervisor.order(order)).error
        finally:
            answer(not error, error or self._supervisor.status().phase)


class Reported(msgspec.Struct):
    """What had an entry on /diagnostics, and goes on having one.

    An aggregator would take an entry that does not come any more for a failure.
    """

    flows: set[Pair] = msgspec.field(default_factory=set)
    rules: set[str] = msgspec.field(default_factory=set)


def diagnostics(
    status: SystemStatus, verdict: Verdict | None, reported: Reported, *, label: str, source: str
) -> tuple[Entry, ...]:
    """Return one entry for each node, each measured flow with declared numbers, each rule broken.

    Those of now are added to `reported`. Names begin with `label`, which an aggregator knows them
    by; those who read the health of nodes leave out entries of the hardware id `source`.
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
    measured = {each.pair: each for each in status.measured if each.bounds}
    reported.flows |= measured.keys()
    entries += (
        _of_flow(each, measured.get(each.pair), status)
        for each in (() if verdict is None else verdict.flows)
        if each.pair in reported.flows
    )
    reported.rules.update(each.rule for each in findings)
    for rule in sorted(reported.rules):
        found = [each for each in findings if each.rule == rule]
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        level = _LEVELS[Outcome.worst(each.outcome for each in found)]
        message = f"{found[0].message}{more}" if found else "ok"
        entries.append((level, rule, message, [(each.subject, each.observed) for each in found]))
    return tuple(
        (level, f"{label}: {name}", message, source, tuple(values))
        for level, name, message, values in entries
    )


_DONE = ("measuring", "active")
_LEVELS = {Outcome.OK: OK, Outcome.UNVERIFIABLE: WARN, Outcome.VIOLATED: ERROR}
_Said = tuple[int, str, str, Sequence[tuple[str, str]]]
"""Level, name, message and values."""


def _of_flow(flow: FlowReport, measured: FlowMeasurement | None, status: SystemStatus) -> _Said:
    name = f"{flow.topic} {flow.publisher} → {flow.subscription}"
    if measured is None:
        level, message = _LEVELS[flow.outcome], "not measured"
        if level == OK and status.phase not in _DONE:
            level, message = WARN, f"{message}, the system is {status.phase}"
        return level, name, message, ()
    # Numbers are values, so that who shows each new message is not shown one each second.
    message = measured.outcome
    level = {"violated": ERROR, "unverifiable": WARN}.get(message, OK)
    if measured.violated:
        message += f": {', '.join(dict.fromkeys(each.name for each in measured.violated))}"
    bounds = ((each.name, each.text) for each in measured.bounds)
    return level, name, message, (*measured.numbers().items(), *bounds)


def _of_node(node: NodeStatus, status: SystemStatus, outcome: Outcome) -> _Said:
    level, message = _LEVELS[outcome], node.state or node.reach.value
    message += f", {node.doing}" if node.doing else ""
    if node.next_try_s is not None:
        level, message = ERROR, f"starts again in {node.next_try_s:.1f} s"
    elif node.died:
        level, message = ERROR, node.died
    elif node.silent:
        level, message = STALE, f"silent: {node.silent}"
    elif level == OK and status.phase not in _DONE:
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
    if node.last_failure is not None:
        values.append(("last_failure", f"{node.last_failure.at}: {node.last_failure.message}"))
    return level, node.node, message, values
