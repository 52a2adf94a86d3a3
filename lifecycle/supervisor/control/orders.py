"""Orders to a supervisor that holds a system (pause, resume, restart, mode, apply); its manifest.

Owns: `Order`, which orders fit which phase, and the mailbox that gives them to the session one by
one; and `Revisions`: whether a manifest is still the one that runs, and whether the running system
can take a new one. An order with a plan that is not the one that runs is refused unless it says to
take it, and so is, with the reason, what cannot be changed while the supervisor runs. How orders
are carried out is gate/sequence.py's, what differs `plan.comparison`'s. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Iterable, Iterator

from lifecycle.errors import BringUpError, ExitCode, LifecycleError, UsageError, did_you_mean
from lifecycle.network.connection_url import parse
from lifecycle.plan.build import with_files_of_now
from lifecycle.plan.change import PlanChange, change_between
from lifecycle.plan.comparison import PlanDifference, changes
from lifecycle.plan.model import Plan
from lifecycle.supervisor.control.protocol import (
    Answer,
    ChangedNodes,
    ControlRequest,
    ProcessState,
    Question,
)
from lifecycle.supervisor.nodes.system import NodeRun, System
from lifecycle.supervisor.run.failure import StepFailedError
from lifecycle.supervisor.run.options import UpOptions, local_processes

ACTIVE = "active"
PAUSED = "paused"
HELD = "held"
"""Phases in which orders are taken. HELD: some nodes wait at a gate that stayed closed, or that a
consequence of a violation closed behind them."""


class Order(Question, frozen=True, kw_only=True):
    """One order, as it was asked for or as policy gives it.

    Attributes:
        plan: the plan of the manifest that the order names, as it is now; None if it names none.
        keys: for RESTART by policy, of the nodes, which are down already; empty for one by hand.
            For PAUSE by policy, of the nodes that are deactivated; empty for all.
        reason: for PAUSE by policy, what it is for, as `lifecycle status` shows it.
        change: for APPLY, what `plan` is for the running system.
    """

    plan: Plan | None = None
    keys: tuple[str, ...] = ()
    reason: str = ""
    change: PlanChange | None = None

    @property
    def said(self) -> str:
        """How messages say it, after "cannot"."""
        return _SAID.get(self.ask, self.ask.value)


_SAID = {
    ControlRequest.MODE: "switch the mode of",
    ControlRequest.APPLY: "apply another manifest to",
}


class NotBegunError(BringUpError):
    """An order that could not be begun: the system is as it was."""


class RolledBackError(LifecycleError):
    """A manifest that could not be applied: what failed, and what the system is now.

    Attributes:
        ends: what failed beside it, which ends the run unless policy restarts it; None if nothing.
    """

    def __init__(
        self, message: str, exit_code: ExitCode, ends: StepFailedError | None = None
    ) -> None:
        super().__init__(message)
        self.exit_code = exit_code
        self.ends = ends


PHASES = {
    ControlRequest.PAUSE: (ACTIVE, HELD),
    ControlRequest.RESUME: (PAUSED, HELD),
    ControlRequest.RESTART: (ACTIVE, PAUSED, HELD),
    ControlRequest.MODE: (ACTIVE, PAUSED, HELD),
    ControlRequest.APPLY: (ACTIVE, PAUSED, HELD),
}
_HINTS = {
    ControlRequest.PAUSE: "only an active system can be paused",
    ControlRequest.RESUME: "only a paused system can be resumed",
    ControlRequest.RESTART: "only a system that is active or paused can be restarted",
    ControlRequest.MODE: "only a system that is active or paused can enter another mode",
    ControlRequest.APPLY: "only a system that is active or paused can take another manifest",
}


def check_order(order: Order, system: System, phase: str, *, waits: Order | None = None) -> None:
    """Make sure that an order can be carried out now, or after another.

    Args:
        order: to be carried out.
        system: whose.
        phase: of it.
        waits: the order that is carried out now, and after which this one's turn comes; None if
            none is. Who knows what the system will be then cannot be asked: the phase counts at
            the turn. While another manifest is applied only `down` is taken: what an order means
            may change by it.

    Raises:
        UsageError: it does not fit the phase, or names a node that cannot be restarted.
    """
    applies = waits is not None and waits.ask is ControlRequest.APPLY
    if applies and phase not in PHASES[order.ask]:
        raise UsageError(
            f"cannot {order.said} {system.plan.system!r}: it is {phase}, another manifest is "
            "being applied to it",
            hint="ask again once 'lifecycle apply' has ended; 'lifecycle down' is taken at once",
        )
    if waits is None and phase not in PHASES[order.ask]:
        raise UsageError(
            f"cannot {order.said} {system.plan.system!r}: it is {phase}",
            hint=_HINTS[order.ask],
        )
    server = system.server
    starts = order.ask in (ControlRequest.RESTART, ControlRequest.APPLY)
    if starts and server and server.state is ProcessState.EXITED:
        raise UsageError(
            f"cannot {order.said} {order.node or system.plan.system!r}: the discovery server "
            "has died, and without it nobody who comes again is found",
            hint="start the system again: lifecycle down, then lifecycle up",
        )
    if order.node:
        node_of(order, system)
    if order.ask is ControlRequest.MODE:
        _check_mode(order, system)
    if order.ask is ControlRequest.APPLY and (order.plan is None or not order.timeout_s >= 0):
        raise UsageError(
            f"cannot apply a manifest to {system.plan.system!r} without one, or within "
            f"{order.timeout_s:g} s"
        )


def _check_mode(order: Order, system: System) -> None:
    name, modes = system.plan.system, [each.name for each in system.plan.modes]
    if order.mode not in modes:
        raise UsageError(
            f"cannot enter mode {order.mode!r} of {name!r}: it has "
            f"{'the modes ' + ', '.join(modes) if modes else 'no modes'}",
            hint=did_you_mean(order.mode, modes) if modes else "declare them under 'modes:'",
        )
    if system.remote:
        raise UsageError(
            f"cannot switch the mode of {name!r}: nodes on other machines run in it, too",
            hint="modes are switched where one supervisor runs all nodes",
        )


def node_of(order: Order, system: System) -> NodeRun:
    """Return the node that an order names.

    Raises:
        UsageError: there is none, or it is not ours to restart.
    """
    for node in system.nodes.values():
        if order.node in (node.planned.key, node.name):
            if node.process is None and node.unload is None:
                raise UsageError(
                    f"cannot restart {node.name!r}: it is attached, no process of this supervisor"
                )
            return node
    known = ", ".join(
        sorted(node.name for node in system.nodes.values() if node.process or node.unload)
    )
    raise UsageError(
        f"cannot restart {order.node!r}: this supervisor runs no such node; it runs: {known}"
    )


class Pending:
    """An order that waits to be carried out, or is."""

    def __init__(self, order: Order) -> None:
        self.order = order
        self.done: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()

    def finish(self, answer: Answer) -> None:
        """Answer who gave it; a second time is harmless."""
        if not self.done.done():
            self.done.set_result(answer)


class Mailbox:
    """Orders in the order in which they came."""

    def __init__(self) -> None:
        self._queue: asyncio.Queue[Pending] = asyncio.Queue()
        self._open: set[Pending] = set()
        self._placed = asyncio.Event()

    async def place(self, order: Order) -> Answer:
        """Give an order and wait for what comes of it."""
        pending = Pending(order)
        self._open.add(pending)
        try:
            await self._queue.put(pending)
            self._placed.set()
            self._placed = asyncio.Event()
            return await asyncio.shield(pending.done)
        finally:
            self._open.discard(pending)

    async def next(self) -> Pending:
        """Wait for the next order."""
        return await self._queue.get()

    async def arrives(self) -> None:
        """Return once an order waits; it stays where it is."""
        while self._queue.empty():
            await self._placed.wait()

    def close(self, reason: str) -> None:
        """Refuse what is still open."""
        for pending in tuple(self._open):
            pending.finish(Answer(exit_code=ExitCode.BRING_UP_FAILED, error=reason))


_MOST = 20
_CHANGEABLE = ("nodes.", "links.", "policy.", "on_violation.", "modes.")
"""Parts of a manifest that a running supervisor can change: the rest made the supervisor's own
participant, its authority and the networks that it programs."""
_NOT_CHANGEABLE = ("policy.ros_interface",)


class Revisions:
    """The manifest of one running system."""

    def __init__(self, system: System, options: UpOptions) -> None:
        self._system = system
        self._options = options

    def differences(self, plan: Plan) -> tuple[str, ...]:
        """Say how `plan` differs from what runs, one line each; empty if it does not."""
        return _lines(changes(self._system.first, plan))

    def change(self, plan: Plan) -> PlanChange:
        """Return what `plan` is for the system that runs."""
        system = self._system
        return change_between(system.first, plan, modes=(system.mode, system.mode_by(plan)))

    def said(self, change: PlanChange, plan: Plan) -> ChangedNodes:
        """Return a change in the words of the control socket, with the revision in force."""
        return said(change, self._system.first, plan, self._system.revision)

    def check(self, order: Order) -> None:
        """Make sure that nothing but the manifest that the order means will run.

        Raises:
            UsageError: the manifest has changed since the start, or cannot be taken.
        """
        running = self._system.first
        if order.ask is ControlRequest.APPLY:
            assert order.plan is not None
            self._check_apply(order.plan)
        elif order.plan is not None:
            found = changes(running, order.plan)
            if found and order.ask is not ControlRequest.PAUSE:
                raise self._refused(order, found)
        elif order.ask is ControlRequest.RESTART:
            keys = self._restarted(order)
            found = changes(running, with_files_of_now(running))
            if found := tuple(each for each in found if each.node in keys):
                raise self._refused(order, found)

    def _restarted(self, order: Order) -> Collection[str]:
        """Return the keys of all nodes that an order restarts."""
        if not order.node:
            return tuple(self._system.nodes)
        node = node_of(order, self._system)
        # A component has none of its own: its container loads it anew.
        return (node.planned.key,) if node.process is None else node.process.planned.nodes

    def _refused(self, order: Order, found: Iterable[PlanDifference]) -> UsageError:
        system = self._system.plan.system
        what, said = order.ask.value, order.said
        listed = "\n".join(_lines(found))
        path = (order.plan or self._system.first).manifest_path
        take = f"lifecycle apply {path}"
        same = f"; or keep what runs: lifecycle {what} {system}" if order.plan is not None else ""
        same = f"{same} {order.mode}" if same and order.mode else same
        return UsageError(
            f"cannot {said} {system!r}: its manifest is not the one that runs:\n{listed}\n"
            f"take the new one: {take}{same}"
        )

    def _check_apply(self, plan: Plan) -> None:
        """Make sure that the running system can become that of another plan."""
        system, running = self._system, self._system.first
        what = f"cannot apply {plan.manifest_path} to {running.system!r} while it runs"
        if not _is_whole(plan):
            raise UsageError(f"{what}: it is no plan; its nodes and processes do not fit together")
        change = self.change(plan)
        # Whoever has other ports by that has other connections, too, and is started again.
        found = tuple(each for each in change.differences if each.path != "order of nodes")
        self._check_surroundings(plan, found, what)
        urls = [*_urls(running), *_urls(plan)]
        if change.ends_or_starts and any(parse(url).transport.is_tcp for url in urls):
            raise _refused_whole(
                what, "a TCP port that was used is not connected to again by who used it"
            )
        for key in (*change.restarted, *change.removed):
            if (name := system.nodes[key].name) in system.adopted:
                raise UsageError(
                    f"{what}: {name!r} would be taken down, and was adopted",
                    hint="who started it ends it; then lifecycle down, and lifecycle up",
                )

    def _check_surroundings(self, plan: Plan, found: tuple[PlanDifference, ...], what: str) -> None:
        """Make sure that another plan is for the same supervisor, in the same surroundings."""
        running = self._system.first
        elsewhere = any(each.path.startswith("discovery.") for each in found)
        fixed = [
            *_lines(
                each
                for each in found
                if not f"{each.path}.".startswith(_CHANGEABLE) or each.path in _NOT_CHANGEABLE
            ),
            *(() if elsewhere else _places(running, plan)),
        ]
        if fixed:
            raise _refused_whole(what, "a running supervisor cannot change this:", fixed)
        if (running.observers, running.server) != (plan.observers, plan.server):
            raise _refused_whole(what, "its supervisor would be connected otherwise")
        own = local_processes(plan, self._options.machine)
        if self._system.remote or len(own) < len(plan.processes):
            raise _refused_whole(what, "nodes on other machines run by it, too:", _lines(found))


def _is_whole(plan: Plan) -> bool:
    """Whether a plan, which a client sent, names no nodes but its own, each once."""
    nodes = {each.key: each.process for each in plan.nodes}
    placed = [(key, each.name) for each in plan.processes for key in each.nodes]
    named = {after.node for each in plan.nodes for after in each.after}
    named.update(key for flow in plan.flows for key in (flow.publisher, flow.subscription))
    named.update(key for level in plan.levels for key in level)
    named.update(key for mode in plan.modes for key in mode.inactive)
    return (
        len(nodes) == len(plan.nodes) == len({each.full_name for each in plan.nodes})
        and sorted(placed) == sorted(nodes.items())
        and named <= nodes.keys()
    )


def _refused_whole(what: str, why: str, lines: Iterable[str] = ()) -> UsageError:
    listed = "".join(f"\n{each}" for each in lines)
    return UsageError(
        f"{what}: {why}{listed}",
        hint="end it and start it anew: lifecycle down, then lifecycle up",
    )


def _places(running: Plan, plan: Plan) -> Iterator[str]:
    """Yield how the environments differ in which two plans were made that declare the same."""
    for what, old, new in (
        ("ROS_DOMAIN_ID", running.domain_id, plan.domain_id),
        (
            "ROS_AUTOMATIC_DISCOVERY_RANGE",
            running.discovery_range.name,
            plan.discovery_range.name,
        ),
        ("RMW_IMPLEMENTATION", running.rmw, plan.rmw),
    ):
        if old != new:
            yield f"{what}: was {old}, is {new}"


def said(change: PlanChange, running: Plan, plan: Plan, revision: int) -> ChangedNodes:
    """Return a change by the full names of nodes.

    Args:
        change: see above.
        running: what runs, or ran.
        plan: what it becomes.
        revision: of the manifest in force.
    """
    return ChangedNodes(
        differences=_lines(change.differences),
        added=tuple(plan.node(key).full_name for key in change.added),
        removed=tuple(running.node(key).full_name for key in change.removed),
        restarted=tuple(plan.node(key).full_name for key in change.restarted),
        parameters=tuple(plan.node(key).full_name for key in change.parameters),
        revision=revision,
    )


def _lines(found: Iterable[PlanDifference]) -> tuple[str, ...]:
    """Phrase differences with their places in the new manifest, at most 20 of them."""
    every = tuple(found)
    lines = []
    for each in every[:_MOST]:
        place = f"{each.at.spelled}: " if each.at else ""
        lines.append(f"{place}{each.path}: was {each.old}, is {each.new}")
    if len(every) > _MOST:
        lines.append(f"and {len(every) - _MOST} more")
    return tuple(lines)


def _urls(plan: Plan) -> Iterator[str]:
    for _, connections in plan.observers:
        yield from connections.urls
    for node in plan.nodes:
        yield from node.connections.urls
        for each in node.participants:
            yield from each.connections.urls
