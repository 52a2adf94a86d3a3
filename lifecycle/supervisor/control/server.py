"""The supervisor's control socket: what `lifecycle status`, `down`, `pause` and others ask.

Owns: listening and answering; and `check`: of an order that
names a manifest, is it the one that runs, and can it be taken meanwhile? An order with a plan that
is not the one that runs is refused unless it says to take it, and so is, with the reason, what
cannot be changed while the supervisor runs. Which orders fit what the system is doing, and what
they do, is the core's, what differs `plan.comparison`'s; what is asked and answered is
protocol.py's. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
from msgspec.structs import replace

from lifecycle.codec import from_json, to_json
from lifecycle.errors import ExitCode, UsageError
from lifecycle.network.connection_url import parse
from lifecycle.plan.build import with_files_of_now
from lifecycle.plan.comparison import PlanDifference, changes, difference_lines
from lifecycle.plan.model import Plan
from lifecycle.run_directory import short_path
from lifecycle.supervisor.control.protocol import (
    Answer,
    ControlRequest,
    SystemStatus,
    strange,
)
from lifecycle.supervisor.core.change import change_to
from lifecycle.supervisor.core.orders import SAID, restarted
from lifecycle.supervisor.core.state import Order
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.run.options import local_processes
from lifecycle.verify.observation import Observation
from lifecycle.verify.verdict import Verdict

if TYPE_CHECKING:
    from lifecycle.supervisor.shell.supervisor import Supervisor


_CLOSE_S = 1.0
"""In the end, a client that reads nothing for so long loses what it was not sent."""
_LARGEST_QUESTION = 64 * 2**20
"""Bytes of a line; a question may hold a whole plan."""


class SupervisorSnapshot(msgspec.Struct, frozen=True, kw_only=True):
    """All that a supervisor knows at one moment.

    Attributes:
        observation: what its last verdict was judged by; empty before the first.
        verdict: None before the first.
    """

    plan: Plan
    status: SystemStatus
    observation: Observation
    verdict: Verdict | None


class ControlServer:
    """Answers on the control socket while the supervisor lives."""

    def __init__(self, path: Path, session: Supervisor) -> None:
        self._path = path
        self._session = session
        self._server: asyncio.AbstractServer | None = None
        self._open: set[asyncio.StreamWriter] = set()
        self._waiting: set[asyncio.StreamWriter] = set()

    async def open(self) -> None:
        """Listen.

        Raises:
            UsageError: the socket cannot be made, on a full disk say.
        """
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._path.unlink(missing_ok=True)
            with short_path(self._path) as name:
                sock.bind(name)
        except OSError as error:
            sock.close()
            raise UsageError(f"cannot listen at {str(self._path)!r}: {error.strerror}") from error
        self._server = await asyncio.start_unix_server(
            self._serve, sock=sock, limit=_LARGEST_QUESTION
        )

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._open.add(writer)
        try:
            while line := await reader.readline():
                question = from_json(line, Order)
                if question.ask is ControlRequest.DOWN:
                    self._waiting.add(writer)
                    self._session.stop("lifecycle down", ExitCode.BRING_UP_FAILED)
                else:
                    await _say(writer, await self._answer(question))
        except (ConnectionError, ValueError):
            # A client that went away or speaks another language ends its own connection only.
            pass
        finally:
            if writer not in self._waiting:
                self._open.discard(writer)
                writer.close()

    async def _answer(self, question: Order) -> Answer:
        if question.plan is not None:
            question = replace(question, plan=self._session.system.attached(question.plan))
        if question.ask is ControlRequest.STATUS:
            differs: tuple[str, ...] = ()
            if (plan := question.plan) is not None:
                differs = difference_lines(changes(self._session.system.first, plan))
            return Answer(status=self._session.status(), differences=differs)
        if question.ask is ControlRequest.LOOK:
            return Answer(look=msgspec.Raw(to_json(self._session.look())))
        return await self._session.order(question)

    async def close(self, exit_code: int) -> None:
        """Answer those who asked for it that all is over, and stop listening; bounded."""
        if self._server is None:
            return
        self._server.close()
        for writer in self._waiting:
            with contextlib.suppress(ConnectionError):
                writer.write(to_json(Answer(exit_code=exit_code)) + b"\n")
        for writer in self._open:
            writer.close()
        left = {asyncio.ensure_future(each.wait_closed()): each for each in self._open}
        if left:
            _, late = await asyncio.wait(left, timeout=_CLOSE_S)
            for each in late:
                left[each].transport.abort()
            # A connection that was cut counts as closed.
            await asyncio.gather(*left, return_exceptions=True)
        self._server = None


async def _say(writer: asyncio.StreamWriter, answer: Answer) -> None:
    writer.write(to_json(answer) + b"\n")
    await writer.drain()


def shown(path: Path, answer: Answer) -> SupervisorSnapshot:
    """Return what a supervisor shows in an answer.

    Raises:
        UsageError: it is none of this version.
    """
    try:
        return from_json(answer.look, SupervisorSnapshot)
    except ValueError as error:
        raise strange(path, str(error)) from error


_CHANGEABLE = ("nodes.", "links.", "policy.", "on_violation.", "modes.")
"""Parts of a manifest that a running supervisor can change: the rest made the supervisor's own
participant, its authority and the networks that it programs."""
_NOT_CHANGEABLE = ("policy.ros_interface",)


def check(order: Order, system: System) -> None:
    """Make sure that nothing but the manifest that an order means will run.

    Raises:
        UsageError: the manifest has changed since the start, or cannot be taken.
    """
    running = system.first
    if order.ask is ControlRequest.APPLY:
        if order.plan is None or not order.timeout_s >= 0:
            raise UsageError(
                f"cannot apply a manifest to {running.system!r} without one, or within "
                f"{order.timeout_s:g} s"
            )
        _check_apply(order.plan, system)
    elif order.plan is not None:
        found = changes(running, order.plan)
        if found and order.ask is not ControlRequest.PAUSE:
            raise _refused(order, system, found)
    elif order.ask is ControlRequest.RESTART:
        keys = restarted(system.run, order)
        found = changes(running, with_files_of_now(running))
        if found := tuple(each for each in found if each.node in keys):
            raise _refused(order, system, found)


def _refused(order: Order, system: System, found: Iterable[PlanDifference]) -> UsageError:
    name = system.plan.system
    what, said = order.ask.value, SAID.get(order.ask, order.ask.value)
    listed = "\n".join(difference_lines(found))
    path = (order.plan or system.first).manifest_path
    take = f"lifecycle apply {path}"
    same = f"; or keep what runs: lifecycle {what} {name}" if order.plan is not None else ""
    same = f"{same} {order.mode}" if same and order.mode else same
    return UsageError(
        f"cannot {said} {name!r}: its manifest is not the one that runs:\n{listed}\n"
        f"take the new one: {take}{same}"
    )


def _check_apply(plan: Plan, system: System) -> None:
    """Make sure that the running system can become that of another plan."""
    running, machine = system.first, system.run.options.machine
    what = f"cannot apply {plan.manifest_path} to {running.system!r} while it runs"
    if not _is_whole(plan):
        raise UsageError(f"{what}: it is no plan; its nodes and processes do not fit together")
    change = change_to(system.run, plan)
    # Whoever has other ports by that has other connections, too, and is started again.
    found = tuple(each for each in change.differences if each.path != "order of nodes")
    fixed = [
        each
        for each in found
        if not f"{each.path}.".startswith(_CHANGEABLE) or each.path in _NOT_CHANGEABLE
    ]
    places = (
        ("ROS_DOMAIN_ID", running.domain_id, plan.domain_id),
        (
            "ROS_AUTOMATIC_DISCOVERY_RANGE",
            running.discovery_range.name,
            plan.discovery_range.name,
        ),
        ("RMW_IMPLEMENTATION", running.rmw, plan.rmw),
    )
    lines = [*difference_lines(fixed)]
    if not any(each.path.startswith("discovery.") for each in found):
        # Two plans that declare the same may have been made in environments that differ.
        lines += (f"{name}: was {old}, is {new}" for name, old, new in places if old != new)
    if lines:
        raise _refused_whole(what, "a running supervisor cannot change this:", lines)
    if (running.observers, running.server) != (plan.observers, plan.server):
        raise _refused_whole(what, "its supervisor would be connected otherwise")
    if system.remote or len(local_processes(plan, machine)) < len(plan.processes):
        raise _refused_whole(
            what, "nodes on other machines run by it, too:", difference_lines(found)
        )
    urls = [*_urls(running), *_urls(plan)]
    if change.ends_or_starts and any(parse(url).transport.is_tcp for url in urls):
        raise _refused_whole(
            what, "a TCP port that was used is not connected to again by who used it"
        )


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


def _urls(plan: Plan) -> Iterator[str]:
    for _, connections in plan.observers:
        yield from connections.urls
    for node in plan.nodes:
        yield from node.connections.urls
        for each in node.participants:
            yield from each.connections.urls
