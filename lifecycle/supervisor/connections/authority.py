"""Reconciles every node's connections and mappings with their desired state: the authority.

Owns: when nodes are wired and how often again. What each node must have, and what is missing, is
instructions.py's; requests to a node are driver.py's. Must not import rclpy.

Everything is level-triggered: each look compares desired with observed state, so that a lost
connection, a new endpoint and the first wiring are one case; what is due later is due at a look.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING

import msgspec

from lifecycle.errors import BringUpError
from lifecycle.graph.loop import ended
from lifecycle.node.host.control import Command, Operation
from lifecycle.plan.model import Plan
from lifecycle.supervisor.connections.instructions import (
    Instructions,
    NegotiatedSource,
    by_plan,
    is_negotiated,
    not_wired,
    steps,
    wired,
)
from lifecycle.supervisor.core.state import NEVER_S, Level
from lifecycle.supervisor.nodes.driver import (
    ACTIVE,
    INACTIVE,
    NodeDriver,
    NodeInterfaceClient,
)
from lifecycle.supervisor.run.events import Notice, WiringChanged, WiringLost
from lifecycle.verify.observation import NodeConfiguration, Observation
from lifecycle.verify.verdict import Finding

if TYPE_CHECKING:
    from lifecycle.supervisor.nodes.system import NodeRun
    from lifecycle.supervisor.shell.supervisor import Supervisor

AGAIN_S = 1.0
"""What was lost is made again at once; the next try comes so long after."""

RELEASE_S = 2.0
"""For disconnecting a node that is not declared: it is not waited for longer at the end."""


class _Wiring(msgspec.Struct):
    """What the authority knows of one node that it wires.

    Attributes:
        has: what the node had at last.
        ours: names of what it was connected to by us, oldest first.
        tries: to make what is missing; `last_s`: when the last one was.
        error: why it cannot be made; empty if nothing is missing, or it was not tried yet.
    """

    has: Instructions
    ours: list[str] = msgspec.field(default_factory=list)
    tries: int = 0
    last_s: float = float("-inf")
    error: str = ""


class ConnectionAuthority:
    """Wires the nodes of one supervisor, and those that joined without being declared.

    Attributes:
        again_s: seconds after which it has to look again; for ever if nothing is due.
    """

    def __init__(self, shell: Supervisor) -> None:
        self._shell = shell
        self._system = shell.system
        plan = shell.system.plan
        self._negotiated = NegotiatedSource(plan) if is_negotiated(plan) else None
        self._wirings: dict[str, _Wiring] = {}
        self._others: dict[str, NodeConfiguration] = {}
        self._instructions: Mapping[str, Instructions] = {}
        self._making: dict[str, asyncio.Task[None]] = {}
        self._closed = False
        self._repairs = plan.data_layer.events
        self._follows = self._repairs or self._negotiated is not None
        self.again_s = NEVER_S

    async def wire(self, node: NodeRun) -> None:
        """Make everything that a configured node must have before it connects.

        Raises:
            BringUpError: the first step that failed, with node, connection, endpoint and reason;
                or the nodes' capabilities do not fit.
        """
        assert node.driver is not None
        configuration = await node.driver.interface()
        node.learn(configuration)
        wanted = self._negotiate().get(node.name)
        if problems := self._problems():
            raise BringUpError("\n".join(problems))
        if wanted is None:
            return
        if configuration is None:
            if wanted.connections:
                name, how = wanted.connections[0]
                raise BringUpError(
                    f"cannot connect {node.name!r} to {name!r} ({', '.join(how.urls)}): "
                    "it offers no ~/connect_to",
                    hint="only nodes of ours can be wired; give it no connection",
                )
            return  # it makes its endpoints itself
        wiring = self._wiring(node.name)
        wiring.has = wired(configuration)
        there = dict(wiring.has.connections)
        wiring.ours = [connection for connection in wiring.ours if connection in there]
        await self._make(node.name, steps(wanted, wiring.has))

    async def unwire(self, node: NodeRun) -> None:
        """Unmake what a node was connected to, the last connection first."""
        wiring = self._wirings.get(node.name)
        for name in reversed([] if wiring is None else wiring.ours.copy()):
            step = Command(node=node.name, operation=Operation.DISCONNECT_FROM, connection=name)
            with contextlib.suppress(BringUpError):  # the step's own event says why
                await self._make(node.name, [step])

    def replan(self, plan: Plan, names: Collection[str]) -> None:
        """Forget what these nodes were instructed: they are started again, by this plan."""
        if self._negotiated is not None:
            self._negotiated.replan(plan, names)
        for name in names:
            self._wirings.pop(name, None)
        self._instructions = {}

    def look(self, observation: Observation) -> None:
        """Take what was seen: negotiate again, and have what is missing made."""
        self._others = {}
        for each in observation.configurations:
            node = self._system.node_named(each.name)
            if node is None:
                self._others[each.name] = each
            elif not node.core.process:
                node.configuration = each
        if not self._follows:
            return
        before = self._problems()
        self._negotiate()
        for problem in self._problems():
            if problem not in before:
                self._system.emit(Notice(message=problem))
        self.again_s = NEVER_S
        for said, has, missing in () if self._closed else self._lacking():
            if self._is_due(said, has, missing):
                self._making[said.name] = self._shell.start(self._repair(said.name, has, missing))

    async def close(self) -> None:
        """Stop following, and disconnect what was made on nodes that are not declared."""
        self._closed = True
        await ended(*self._making.values())
        for name, wiring in tuple(self._wirings.items()):  # nodes leave meanwhile
            if self._system.node_named(name) is not None or name not in self._others:
                continue
            unmade = steps(Instructions(node=name), wiring.has, ours=wiring.ours)
            try:
                await asyncio.wait_for(self._make(name, unmade), RELEASE_S)
            except (BringUpError, asyncio.TimeoutError):
                continue  # the step's own event said why; the node is not ours to wait for

    def findings(self) -> tuple[Finding, ...]:
        """Return what could not be wired while the system runs."""
        found = [
            not_wired(name, wiring.error) for name, wiring in self._wirings.items() if wiring.error
        ]
        system = self._system.plan.system
        found += [not_wired(system, each) for each in self._problems()]
        return tuple(found)

    def is_at_work(self) -> bool:
        """Whether a running node lacks something that is still to be made, or is being made.

        A node reports a mapping as soon as it has begun; the endpoint before it is there until its
        peers have found the new one, for seconds.
        """
        if not self._follows:
            return False
        return any(not each.done() for each in self._making.values()) or any(
            missing and not self._wiring(said.name).error for said, _, missing in self._lacking()
        )

    def _wiring(self, name: str) -> _Wiring:
        return self._wirings.setdefault(name, _Wiring(has=Instructions(node=name)))

    def _negotiate(self) -> Mapping[str, Instructions]:
        known = dict(self._others)
        for node in self._system.nodes.values():
            if node.configuration is not None:
                known[node.name] = node.configuration
        if self._negotiated is not None:
            self._instructions = self._negotiated.instructions(known)
            self._system.expected = self._negotiated.expected
        elif not self._instructions:
            self._instructions = by_plan(self._system.run.plan)
        return self._instructions

    def _problems(self) -> tuple[str, ...]:
        return () if self._negotiated is None else self._negotiated.problems

    def _lacking(
        self,
    ) -> Iterator[tuple[NodeConfiguration, Instructions, tuple[Command, ...]]]:
        """Yield of each node that can be wired now what it says, what it has and what it lacks."""
        remote = {each.full_name for each in self._system.remote.values()}
        for name, wanted in self._instructions.items():
            node = self._system.node_named(name)
            said = self._others.get(name) if node is None else node.configuration
            if said is None or said.state not in (INACTIVE, ACTIVE) or name in remote:
                continue
            if node is not None and (
                node.is_gone or node.driver is None or node.core.stuck or not said.connected
            ):
                continue
            if node is not None and node.core.base is Level.ACTIVE:
                continue  # it is verified as it was found
            wiring = self._wiring(name)
            has = wired(said) if self._repairs or node is None else wiring.has
            yield said, has, steps(wanted, has, ours=wiring.ours)

    def _is_due(
        self, said: NodeConfiguration, has: Instructions, missing: tuple[Command, ...]
    ) -> bool:
        """Return whether a node lacks something that is to be made now."""
        wiring, making = self._wiring(said.name), self._making.get(said.name)
        if making is not None and not making.done():
            return False
        if not missing:
            wiring.has, wiring.error, wiring.tries = has, "", 0
            return False
        left_s = wiring.last_s + AGAIN_S - self._shell.now_s()
        if left_s > 0:
            self.again_s = min(self.again_s, left_s)
        return left_s <= 0

    async def _repair(self, name: str, has: Instructions, missing: tuple[Command, ...]) -> None:
        wiring = self._wiring(name)
        self._say_lost(wiring, has)
        wiring.tries += 1
        wiring.last_s, wiring.has = self._shell.now_s(), has
        try:
            await self._make(name, missing)
        except BringUpError as error:
            wiring.error = error.message
        self._system.touch()  # a success that does not show in the node's own report is none

    def _say_lost(self, wiring: _Wiring, has: Instructions) -> None:
        there, mapped, name = dict(has.connections), dict(has.mappings), has.node
        for connection, _ in wiring.has.connections:
            if connection in wiring.ours and connection not in there:
                self._system.emit(WiringLost(node=name, connection=connection))
        for endpoint, connection in wiring.has.mappings:
            if endpoint not in mapped and (connection in there or not connection):
                self._system.emit(WiringLost(node=name, connection=connection, endpoint=endpoint))

    async def _make(self, name: str, missing: Iterable[Command]) -> None:
        """Make steps of a node in order; the first that fails ends it."""
        node, wiring = self._system.node_named(name), self._wiring(name)
        interface: NodeDriver | NodeInterfaceClient | None = node.driver if node else None
        interface = interface or NodeInterfaceClient(self._shell.means.participant.clients, name)
        for step in missing:
            if node is not None:
                node.wiring = str(step)
            try:
                configuration = await interface.wire(step)
            except BringUpError as error:
                self._system.emit(_done(step, attempt=wiring.tries, error=error.message))
                raise
            finally:
                if node is not None:
                    node.wiring = ""
            if step.operation is Operation.CONNECT_TO and step.connection not in wiring.ours:
                wiring.ours.append(step.connection)
            elif step.operation is Operation.DISCONNECT_FROM and step.connection in wiring.ours:
                wiring.ours.remove(step.connection)
            if configuration is not None:
                wiring.has = wired(configuration)
                if node is None:
                    self._others[configuration.name] = configuration
                else:
                    node.learn(configuration)
            self._system.emit(_done(step, attempt=wiring.tries))
        self._system.touch()


def _done(step: Command, *, attempt: int = 1, error: str = "") -> WiringChanged:
    return WiringChanged(
        node=step.node,
        operation=step.operation,
        connection=step.connection,
        endpoint=step.endpoint,
        urls=step.connections.urls,
        attempt=max(1, attempt),
        error=error,
    )
