"""The ROS graph on real DDS: the three layers of the graph interface put together.

Owns: `Graph`, for programs that follow a ROS graph and for the supervisor that judges one: what is
asked of which node, and when, and whose answers count; which of discovery's nodes are members of
the graph; when a change is worth another look.
"""

from __future__ import annotations

import asyncio
import functools
import logging
import os
import typing
from collections.abc import Awaitable, Callable, Collection, Coroutine, Iterable, Iterator
from typing import Any, TypeVar

from msgspec.structs import replace
from rclpy.node import Node

from lifecycle.errors import MiddlewareError
from lifecycle.graph.loop import GraphLoop, set_within
from lifecycle.graph.model import GraphChange
from lifecycle.graph.readings import (
    DiagnosticReadings,
    Names,
    ParameterReadings,
    TopicMeasurements,
)
from lifecycle.graph.reporter import receive
from lifecycle.graph.state import Answer, GraphEvents, GraphState
from lifecycle.graph.status import NodeStatus
from lifecycle.middleware.rcl.graph import GraphObserver
from lifecycle.middleware.services.clients import NodeClients
from lifecycle.plan.model import ParticipantConnections, Plan
from lifecycle.verify.judge import verify
from lifecycle.verify.observation import (
    EndpointReport,
    Identity,
    NodeConfiguration,
    Observation,
    ObservedEndpoint,
    ObservedNode,
)
from lifecycle.verify.tool_filter import DeclaredNames, known_node, tolerating_pattern
from lifecycle.verify.verdict import Stage, Verdict

_logger = logging.getLogger(__name__)

_T = TypeVar("_T")

_QUIET_S, _BURST_S = 0.005, 0.05
"""A burst of changes is over when nothing changed for so long, and is cut off after so long."""

_ASK_S = 1.0
"""A node that answers at all answers within milliseconds."""

_READ_S = 3.0
"""No caller waits for a reading, and a node that has just begun may still be on its way."""

_FAREWELL_S = 1.0
"""A node that reports itself says that it leaves, and discovery may show it first."""

_AGAIN_S = 2.0
"""What could not be read is read again after so long."""

_TOGETHER_S = 0.05
"""Changes of discovery come in bursts; who follows them looks once for all within so long."""

_Seen = tuple[NodeStatus | None, ObservedNode | None, bool, tuple[ObservedEndpoint, ...]]
"""What a node says of itself; or, of one that says nothing, what discovery shows: whether it serves
its configuration, its endpoints and those of its hidden participants: it knows what they mean."""


@typing.final
class Graph:
    """A ROS graph as it is now, and what happens in it.

    Use `open` in a program that has no node, `on` in one that has, `in_loop` in one that judges the
    graph in an asyncio loop. `close` it, or use it in a `with`. Callbacks come in a thread of the
    graph's own, or in that loop, one after another; they must be quick.

    Where its loop has a thread of its own it reads every node whenever it changes, as programs want
    it that ask the state; else nodes are asked by `observe` only, as who judges wants it.

    Args:
        discovery: what is there.
        clients: services of nodes; to be used in the loop.
        loop: where everything runs.
        messages: receive what nodes say of themselves; a change is worth another look.
        unplanned: `observe` also asks nodes that are not planned, as far as they have our node
            interface.

    Attributes:
        state: layer 3.
        events: layer 2.
        changes: changes so far, each counted at once: before its burst has passed (`wait_change`).
    """

    def __init__(
        self,
        discovery: GraphObserver,
        clients: NodeClients,
        loop: GraphLoop,
        *,
        messages: bool = False,
        unplanned: bool = False,
    ) -> None:
        self.changes = 0
        self.state = GraphState(loop.post)
        self.events = GraphEvents(self.state)
        self.discovery = discovery
        self.clients = clients
        self._loop = loop
        self._unplanned = unplanned
        self._follows = loop.has_thread
        self._present: frozenset[str] = frozenset()
        self._answered: dict[str, NodeConfiguration] = {}
        self._read_as: dict[str, _Seen] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._parameters = ParameterReadings(clients, loop, self._wake)
        self._diagnostics = DiagnosticReadings(clients, self._wake)
        self._measurements = TopicMeasurements(clients)
        self._changed = asyncio.Event()
        self._changed.set()  # nothing was looked at yet
        self._to_note = False
        self._to_follow = asyncio.Event()
        self.state.on_change(self._state_changed)
        self._ends: list[Callable[[], None]] = [discovery.on_change(self._wake)]
        if messages:
            self._ends.append(receive(discovery.node, self.state.put_status))
        self._closed = False
        if self._follows:
            loop.post(lambda: self._start(self._follow()))

    @classmethod
    def open(
        cls, domain_id: int | None = None, *, connections: ParticipantConnections | None = None
    ) -> Graph:
        """Follow the graph of a domain with a participant of its own.

        Args:
            domain_id: 0–232; None: ROS_DOMAIN_ID, else 0.
            connections: how the participant is connected; None leaves it to the RMW.

        Raises:
            MiddlewareError: no participant could be made.
        """
        if domain_id is None:
            domain_id = int(os.environ.get("ROS_DOMAIN_ID") or 0)
        return cls._following(GraphObserver(domain_id, connections))

    @classmethod
    def on(cls, node: Node) -> Graph:
        """Follow the graph with a node that an executor spins; close this before it is destroyed.

        Raises:
            MiddlewareError: rcl's graph guard condition could not be waited on.
        """
        return cls._following(GraphObserver.on(node))

    @classmethod
    def _following(cls, discovery: GraphObserver) -> Graph:
        return cls(discovery, NodeClients(discovery), GraphLoop(), messages=True)

    @classmethod
    def in_loop(
        cls,
        domain_id: int,
        connections: ParticipantConnections | None = None,
        *,
        messages: bool = False,
        unplanned: bool = False,
    ) -> Graph:
        """Look at the graph of a domain with a participant of its own, as a supervisor does.

        Make it before starting what is to be observed. All runs in the asyncio loop that runs here;
        nodes are asked when `observe` is called, and then only.

        Args:
            domain_id: 0–232.
            connections: how the participant is connected; None leaves it to the RMW.
            messages: receive what nodes say of themselves; a change is worth another look.
            unplanned: also ask nodes that are not planned, as far as they have our node interface.

        Raises:
            MiddlewareError: no participant could be made.
        """
        discovery = GraphObserver(domain_id, connections)
        loop = GraphLoop(asyncio.get_running_loop())
        return cls(discovery, NodeClients(discovery), loop, messages=messages, unplanned=unplanned)

    # -- one observation

    async def observe(
        self,
        plan: Plan,
        *,
        only: Collection[str] | None = None,
        machines: Collection[str] | None = None,
    ) -> Observation:
        """Return what is there now, as the state has it then.

        Waits until every participant that was there before us is seen: an observation that misses
        one would prove nothing about undeclared nodes. Planned nodes whose configuration was not
        put into the state are asked for it and for their state; what they do not answer within a
        second stays unknown. Parameters that they do not report are read (readings.py).

        Args:
            plan: whose nodes are asked.
            only: full names of the planned nodes that are asked; None for all.
            machines: whose subscriptions are measured where the plan asks for it; None for all.

        Raises:
            MiddlewareError: the graph can no longer be watched.
        """
        planned = {node.full_name for node in plan.nodes}
        names = DeclaredNames.of(plan)
        while True:
            self._changed.clear()
            nodes, endpoints = self.discovery.snapshot(names=names)
            settling_s = self.discovery.settling.left_s()
            if settling_s <= 0:
                break
            # To look costs more than the moment in which the rest of a burst comes.
            if await set_within(self._changed, settling_s):
                await asyncio.sleep(min(_QUIET_S, settling_s))
        self._show(nodes)
        given = self.state.given
        asked = (planned if only is None else planned.intersection(only)) - given.keys()
        judged = _judged_parameters(plan, self._present & asked)
        self._parameters.listen(judged)
        self._diagnostics.listen(
            {
                node.full_name: node.health.diagnostics
                for node in plan.nodes
                if node.health is not None and node.health.diagnostics
            }
        )
        self._measurements.listen(plan, machines)
        answers = await self._ask_all(plan, nodes, asked)
        self._answered = {name: said for name, (_, said) in answers.items() if said is not None}
        said = {**self.state.given, **self._answered}
        reporting = {name for name, each in said.items() if each.parameters is not None}
        if await self._parameters.follow(sorted(judged.keys() - reporting), reporting=reporting):
            # Each node is waited for once.
            return await self.observe(plan, only=only, machines=machines)
        for each in self._answered.values():
            self.state.learn(each)
        observation = self.state.observation(
            nodes,
            endpoints,
            answers,
            parameters=self._parameters.latest,
            health=self._diagnostics.reports(),
            measured=self._measurements.measured(),
        )
        return replace(observation, departed=self.discovery.departed)

    def measure_anew(self) -> None:
        """Forget what was counted of topics that this process measures."""
        self._measurements.begin_anew()

    def drop_configuration(self, node: str) -> None:
        """Forget what a node said of itself whose process ended."""
        self.state.drop_configuration(node)
        self._diagnostics.forget(node)

    def reread_parameters(self) -> bool:
        """Have the next `observe` read all parameters again; return whether it reads any."""
        return self._parameters.reread()

    async def wait_change(self) -> None:
        """Wait until a burst of changes has passed, if any came since this or `observe` was called.

        Discovery, a transition or a parameter of a node that is asked, or a status of one that
        changed makes a change; a configuration that is put into the state makes none.
        """
        loop = self._loop.loop
        await self._changed.wait()
        end = loop.time() + _BURST_S
        while (left_s := end - loop.time()) > 0:
            self._changed.clear()
            # Not at each change: while nodes come there is one for each of their endpoints.
            await asyncio.sleep(min(_QUIET_S, left_s))
            if not self._changed.is_set():
                break
        self._changed.clear()

    def observation(self, plan: Plan) -> Observation:
        """Return what there is of `plan` now and what there is besides, for `lifecycle.verify`.

        It takes up to a second, and just after the graph was made up to 3.5 s. Not to be called in
        a callback, nor with `in_loop`: there, `observe`.
        """
        if not self._loop.has_thread:
            raise TypeError("cannot wait for an observation in its own loop; await observe(plan)")
        return asyncio.run_coroutine_threadsafe(self.observe(plan), self._loop.loop).result()

    def verdict(self, plan: Plan, *, stage: Stage = Stage.ACTIVE) -> Verdict:
        """Return whether what runs now is what `plan` says, by the rules of `lifecycle verify`."""
        return verify(plan, self.observation(plan), stage=stage)

    def close(self) -> None:
        """Leave the graph; again is harmless. Nothing is called back after it."""
        if self._closed:
            return
        self._closed = True
        self.state.close()
        self._loop.close()
        for end in self._ends:
            end()
        self._parameters.close()
        for each in self._tasks:
            each.cancel()
        self.clients.destroy()
        self.discovery.destroy()

    def __enter__(self) -> Graph:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- asking

    async def _ask_all(
        self, plan: Plan, nodes: Iterable[ObservedNode], wanted: Collection[str]
    ) -> dict[str, Answer]:
        """Ask wanted nodes, and those that are not planned if those are to be asked.

        What nodes say of themselves that are in no host of ours is left out; on another machine
        those count that the plan has in a host.
        """
        planned = {each.full_name: bool(each.run.python) for each in plan.nodes}
        asking = [self._ask(node) for node in nodes if node.full_name in wanted]
        if self._unplanned:
            asking += [
                self._ask_unplanned(node.full_name)
                for node in nodes
                if node.managed
                and node.full_name not in planned
                and not tolerating_pattern(node.full_name, plan.policy.tolerated_nodes)
            ]
        answers = dict(await asyncio.gather(*asking))
        here = self.discovery.hosted(name for name, (_, said) in answers.items() if said)
        return {
            name: (state, said if here.get(name, planned.get(name, True)) else None)
            for name, (state, said) in answers.items()
        }

    async def _ask(self, node: ObservedNode) -> tuple[str, Answer]:
        name = node.full_name
        if not node.managed:
            return name, (None, await self._ask_configuration(name))
        self._follow_transitions(name)
        state, configuration = await asyncio.gather(
            self._ask_state(name), self._ask_configuration(name)
        )
        return name, (state, configuration)

    async def _ask_unplanned(self, name: str) -> tuple[str, Answer]:
        configuration = await self._ask_configuration(name)
        if configuration is None:
            return name, (None, None)
        self._follow_transitions(name)
        return name, (configuration.state, configuration)

    async def _ask_state(self, name: str, timeout_s: float = _ASK_S) -> str | None:
        return await _answer("state", name, self.clients.get_state(name, timeout_s=timeout_s))

    async def _ask_configuration(
        self, name: str, *, timeout_s: float = _ASK_S, expected: bool = False
    ) -> NodeConfiguration | None:
        asking = self.clients.get_configuration(name, timeout_s=timeout_s, expected=expected)
        return await _answer("configuration", name, asking)

    def _follow_transitions(self, name: str) -> None:
        self.clients.on_transition(name, functools.partial(self._moved, name))

    # -- what happened, from any thread

    def _moved(self, name: str) -> None:
        self._loop.post(functools.partial(self._parameters.reread, name))
        self._read_as.pop(name, None)
        self._wake()

    def _wake(self) -> None:
        if not self._to_note:  # it is noted later than this, so that it is noted once
            self._to_note = True
            self._loop.post(self._note)

    # -- what happens in the loop

    def _note(self) -> None:
        self._to_note = False
        self.changes += 1
        self._changed.set()
        self._to_follow.set()

    def _state_changed(self, change: GraphChange) -> None:
        """Look again at a node that says something else of itself than it answered, or reports."""
        name, after = change.node, change.after
        if change.status_changed and name not in self.state.given:
            status = None if after is None else after.status
            if self._follows or not _says_as_before(status, self._answered.get(name)):
                self._wake()

    def _show(self, nodes: Iterable[ObservedNode]) -> None:
        """Have nodes join that discovery shows, and forget those that it shows no more."""
        before, self._present = self._present, frozenset(node.full_name for node in nodes)
        for name in sorted(before - self._present):
            self._forget(name)
        for name in sorted(self._present - before):
            if _counts(name):
                self.state.show(name)

    def _forget(self, name: str) -> None:
        """Drop what is held for a node that was in the graph and is not any more."""
        self._read_as.pop(name, None)
        self._parameters.forget(name)
        view = self.state.node(name)
        if view is None or view.status is None or name in self.state.given:
            self._hide(name)
        else:
            self._loop.loop.call_later(_FAREWELL_S, self._hide, name)
        self.clients.forget(name)

    def _hide(self, name: str) -> None:
        if name not in self._present:
            self.state.hide(name, "discovery does not show it any more")

    # -- nodes that are followed

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = self._loop.loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _follow(self) -> None:
        """Read each node that is not what it was when it was read last."""
        while True:
            self._to_follow.clear()
            nodes, endpoints = self.discovery.snapshot()
            self._show(nodes)
            for name, seen in self._look_at(nodes, endpoints):
                if self._read_as.get(name) != seen:
                    self._read_as[name] = seen
                    self._start(self._read(name, seen))
            await self._to_follow.wait()
            await asyncio.sleep(_TOGETHER_S)

    def _look_at(
        self, nodes: Iterable[ObservedNode], endpoints: Iterable[ObservedEndpoint]
    ) -> Iterator[tuple[str, _Seen]]:
        """Yield what is seen of each node whose configuration is not given."""
        shown = {node.full_name: node for node in nodes}
        by_node: dict[str, list[ObservedEndpoint]] = {}
        for endpoint in endpoints:
            by_node.setdefault(endpoint.node, []).append(endpoint)
        for view in self.state.nodes():
            name = view.name
            if name in self.state.given:
                continue
            if view.status is not None:
                yield name, (view.status, None, True, ())
            elif name in shown:
                space, _, base = name.rpartition("/")
                beside = sorted(each for each in shown if each.startswith(f"{space}/_{base}_"))
                owned = (each for owner in (name, *beside) for each in by_node.get(owner, ()))
                serves = self.discovery.offers(name, f"{name}/get_configuration")
                yield name, (None, shown[name], serves, tuple(owned))

    async def _read(self, name: str, seen: _Seen) -> None:
        """Hold what a node serves of itself, or else what is seen of it."""
        _, node, serves, endpoints = seen
        if node is not None and node.managed:
            self._follow_transitions(name)
        configuration: NodeConfiguration | None
        if serves:
            configuration = await self._ask_configuration(name, timeout_s=_READ_S, expected=True)
        else:
            asks = node is not None and node.managed
            state = await self._ask_state(name, _READ_S) if asks else ""
            configuration = _seen_configuration(name, state or "", endpoints)
        if self._read_as.get(name) != seen:
            return  # it has changed meanwhile, and is read again
        if configuration is not None:
            self.state.learn(configuration)
        else:
            del self._read_as[name]
            self._loop.loop.call_later(_AGAIN_S, self._wake)


def _judged_parameters(plan: Plan, present: Collection[str]) -> dict[str, Names]:
    """Return of which nodes that are there parameters are judged or waited for: their names."""
    awaited, found = plan.awaited, dict[str, Names]()
    for node in plan.nodes:
        names = {each.name for each in node.expected_parameters}
        names |= {each.name for each in awaited.get(node.key, ()) if not each.by.kinds}
        if (names or node.has_all_parameters) and node.full_name in present:
            found[node.full_name] = None if node.has_all_parameters else frozenset(names)
    return found


def _says_as_before(status: NodeStatus | None, answer: NodeConfiguration | None) -> bool:
    if status is None or answer is None:
        return False
    said = (answer.state, answer.connected, answer.checksum)
    return (status.state, status.connected, status.checksum) == said


def _seen_configuration(
    name: str, state: str, endpoints: Iterable[ObservedEndpoint]
) -> NodeConfiguration:
    return NodeConfiguration(
        identity=Identity(machine_id="", process_id=0, node_id=""),
        name=name,
        state=state,
        connected=True,
        rmw="",
        transports=(),
        serializations=(),
        paradigms=(),
        endpoints=tuple(
            EndpointReport(kind=each.kind, name="", resolved=each.name, type=each.type, mapped=True)
            for each in endpoints
            if each.node == name
        ),
    )


async def _answer(what: str, node: str, asking: Awaitable[_T]) -> _T | None:
    try:
        return await asking
    except MiddlewareError as error:
        _logger.info("%s of %s unknown: %s", what, node, error)
        return None


def _counts(name: str) -> bool:
    """Whether a node is part of a system: no tool's, no hidden one, and its name is known."""
    hidden = name.rpartition("/")[2].startswith("_")
    return bool(known_node(name)) and not hidden and not tolerating_pattern(name)
