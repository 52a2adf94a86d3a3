"""Updates the graph's state from discovery, nodes' services and parameters.

Owns: what is asked of which node, and when, and whose answers count; which of discovery's nodes are
members of the graph, and what counts as the configuration of one that serves none; what
/diagnostics says of nodes; when a change is worth another look.
It looks when it is asked to, and when something happened.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import threading
import time
import typing
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from lifecycle import dataclasses
from lifecycle.errors import MiddlewareError
from lifecycle.graph.events import GraphEvents
from lifecycle.graph.messages import GraphMessage, Heartbeat
from lifecycle.graph.parameters import ParameterReadings
from lifecycle.graph.scheduler import Remove, set_within
from lifecycle.graph.state import Answer, GraphState, Look
from lifecycle.plan.model import Plan
from lifecycle.verify.observation import (
    EndpointReport,
    HealthReport,
    Identity,
    NodeConfiguration,
    Observation,
    ObservedEndpoint,
    ObservedNode,
)
from lifecycle.verify.tool_filter import (
    DeclaredNames,
    is_noise_node,
    known_node,
    matches,
    tolerating_pattern,
)

if TYPE_CHECKING:  # it imports rclpy
    from lifecycle.middleware.rcl.graph import GraphObserver
    from lifecycle.middleware.services.clients import NodeClients

_logger = logging.getLogger(__name__)

QUIET_S = 0.02
BURST_S = 0.1

_ASK_S = 1.0
"""A node that answers at all answers within milliseconds."""

_READ_S = 3.0
"""No caller waits for a reading, and a node that has just begun may still be on its way."""

_TOGETHER_S = 0.05
"""Changes of discovery come in bursts; who follows them looks once for all within so long."""


Diagnostic = tuple[str, int, str]
"""Name, level and message of a diagnostic_msgs/DiagnosticStatus."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _Shown:
    """A node that sends no messages, as discovery shows it.

    Attributes:
        serves: it has the node configuration interface.
        beside: what its hidden participants have: it knows what they mean.
    """

    managed: bool
    serves: bool
    endpoints: tuple[ObservedEndpoint, ...]
    beside: tuple[tuple[str, tuple[ObservedEndpoint, ...]], ...]


_OF_WARN, _OF_ERROR, _OF_STALE = 1, 2, 3
"""Levels of that."""

STALE_S = 5.0
"""An entry that was not published for so long says nothing any more, as diagnostic_aggregator has
it by default."""

_LONGEST_MESSAGE = 200
_MOST_ENTRIES = 1000


class DiagnosticReadings:
    """What /diagnostics says of some nodes.

    Args:
        clients: where it is subscribed to, once there is such a node.
        wake: called, in any thread, when it says something else.
        clock: seconds.
    """

    def __init__(
        self,
        clients: NodeClients,
        wake: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clients = clients
        self._wake = wake
        self._clock = clock
        self._lock = threading.Lock()
        self._patterns: dict[str, tuple[str, ...]] = {}
        self._entries: dict[str, tuple[int, str, float]] = {}
        self._said: dict[str, HealthReport] = {}

    def listen(self, patterns: Mapping[str, tuple[str, ...]]) -> None:
        """Follow the entries of nodes from now on.

        Args:
            patterns: of the names of their entries, by full node name.
        """
        with self._lock:
            # Looks at a part of the system go on beside those at all of it.
            self._patterns.update(patterns)
        if patterns:
            self._clients.on_diagnostics(self._arrived)

    def forget(self, node: str) -> None:
        """Forget what was said of a node: what comes in its place has said nothing yet."""
        with self._lock:
            patterns = self._patterns.get(node, ())
            for name in [one for one in self._entries if any(matches(one, p) for p in patterns)]:
                del self._entries[name]

    def reports(self) -> dict[str, HealthReport]:
        """Return what is known now, by full node name."""
        with self._lock:
            self._said = self._reports()
            return self._said

    def _arrived(self, entries: Sequence[Diagnostic]) -> None:
        with self._lock:
            wanted = {each for patterns in self._patterns.values() for each in patterns}
            for name, level, message in entries:
                known = name in self._entries or len(self._entries) < _MOST_ENTRIES
                if known and any(matches(name, each) for each in wanted):
                    self._entries[name] = level, message[:_LONGEST_MESSAGE], self._clock()
            changed = self._reports() != self._said
        if changed:
            self._wake()

    def _reports(self) -> dict[str, HealthReport]:
        found = {node: self._report(patterns) for node, patterns in self._patterns.items()}
        return {node: each for node, each in found.items() if each is not None}

    def _report(self, patterns: tuple[str, ...]) -> HealthReport | None:
        wrong, unknown, ok = [], [], False
        for name, (level, message, at_s) in sorted(self._entries.items()):
            if not any(matches(name, each) for each in patterns):
                continue
            said = f": {message}" if message else ""
            if self._clock() - at_s > STALE_S:
                unknown.append(f"{name!r} was not published for {STALE_S:g} s")
            elif level == _OF_STALE:
                unknown.append(f"{name!r} is stale{said}")
            elif level == _OF_ERROR:
                wrong.append(f"{name!r}{said or ' has level ERROR'}")
            elif level > _OF_WARN:
                unknown.append(f"{name!r} has level {level}, which has no meaning{said}")
            else:
                ok = True
        if wrong or unknown:
            said = "; ".join(wrong or unknown)[:_LONGEST_MESSAGE]
            return HealthReport(ok=False if wrong else None, message=said)
        return HealthReport(ok=True) if ok else None


@typing.final
class Observer:
    """Brings the state of one graph up to date.

    Args:
        discovery: what is there.
        clients: services of nodes.
        events: layer 2; `state` is kept on it, and its scheduler is where everything runs.
        quiet_s: a burst of changes is over when nothing changed for so long, ≥ 0.
        burst_s: a burst is cut off after so long, ≥ quiet_s.
        unplanned: `observe` also asks nodes that are not planned, as far as they have our node
            interface.
        follows: read every node whenever it changes, as programs want it that ask the state;
            else nodes are asked by `observe` only, as who judges wants it.

    Attributes:
        state: layer 3.
        changes: changes so far, each counted at once: before its burst has passed (`wait_change`).
    """

    def __init__(
        self,
        discovery: GraphObserver,
        clients: NodeClients,
        events: GraphEvents,
        *,
        quiet_s: float = QUIET_S,
        burst_s: float = BURST_S,
        unplanned: bool = False,
        follows: bool = False,
    ) -> None:
        self.changes = 0
        self._discovery = discovery
        self._clients = clients
        self._events = events
        self._quiet_s = quiet_s
        self._burst_s = burst_s
        self._unplanned = unplanned
        self._follows = follows
        self._seen: frozenset[str] = frozenset()
        self._asked: set[str] = set()
        self._checksums: dict[str, str] = {}
        self._shown: dict[str, _Shown] = {}
        self._readings: set[asyncio.Task[None]] = set()
        self._parameters = ParameterReadings(clients, self._wake)
        self._diagnostics = DiagnosticReadings(clients, self._wake)
        self._changed = asyncio.Event()
        self._changed.set()  # nothing was looked at yet
        self._to_note = False
        self._loop: asyncio.AbstractEventLoop | None = None
        self._due: Remove | None = None
        self._closed = False
        # The scheduler may be another thread's, and asks for the first node at once.
        self.state = GraphState(events, self._read)
        events.on_message(self._message_received)
        self._remove = discovery.on_change(self._discovery_changed)
        if follows:
            events.scheduler.post(self._follow)

    # -- one observation

    def drop_configuration(self, node: str) -> None:
        """Forget what a node said of itself whose process ended."""
        self.state.drop_configuration(node)
        self._diagnostics.forget(node)

    async def observe(self, plan: Plan) -> Observation:
        """Return what is there now, as the state has it then.

        Waits until every participant that was there before us is seen, which takes a moment at
        first: an observation that misses one would prove nothing about undeclared nodes.

        Planned nodes whose configuration was not put into the state are asked for their state and
        their configuration; what they do not answer within a second stays unknown. Those that
        report no parameters, and of which some are planned, are asked for these (parameters.py).

        Raises:
            MiddlewareError: the graph can no longer be watched.
        """
        self._bind()
        planned = {node.full_name for node in plan.nodes}
        names = DeclaredNames.of(plan)
        while True:
            self._changed.clear()
            nodes, endpoints = self._discovery.snapshot(declared=planned, names=names)
            settling_s = self._discovery.settling_s()
            if settling_s <= 0:
                break
            # To look costs more than the moment in which the rest of a burst comes.
            if await set_within(self._changed, settling_s):
                await asyncio.sleep(min(self._quiet_s, settling_s))
        self._show(nodes, endpoints)
        given = self.state.given
        judged = {
            node.full_name: None
            if node.has_all_parameters
            else frozenset(each.name for each in node.expected_parameters)
            for node in plan.nodes
            if (node.expected_parameters or node.has_all_parameters)
            and node.full_name in self._seen - given.keys()
        }
        self._parameters.listen(judged)
        self._diagnostics.listen(
            {
                node.full_name: node.health.diagnostics
                for node in plan.nodes
                if node.health is not None and node.health.diagnostics
            }
        )
        answers = self._believed(plan, await self._ask_all(plan, nodes, planned, given))
        asked = {name: configuration for name, (_, configuration) in answers.items()}
        self._checksums = {name: each.checksum for name, each in asked.items() if each is not None}
        reporting = {
            name
            for name, each in {**self.state.given, **asked}.items()
            if each is not None and each.parameters is not None
        }
        if await self._parameters.follow(sorted(judged.keys() - reporting), reporting=reporting):
            return await self.observe(plan)  # each node is waited for once
        self.state.put_look(
            Look(
                nodes=nodes,
                endpoints=endpoints,
                answers=answers,
                parameters=self._parameters.latest,
                health=self._diagnostics.reports(),
            )
        )
        if not self._follows:
            # Else readings bring it, which put messages that come meanwhile on top of the answer.
            for configuration in asked.values():
                if configuration is not None:
                    self.state.learn(configuration)
        return self.state.observation()

    def expect_newcomers(self, *, everybody: bool = False) -> bool:
        """Have the next `observe` wait for who came lately; return whether there may be anybody.

        Args:
            everybody: wait also for what those have to say that are known: this process did not
                run for a while.
        """
        return self._discovery.expect_newcomers(everybody=everybody)

    def reread_parameters(self) -> bool:
        """Have the next `observe` read all parameters again; return whether it reads any."""
        return self._parameters.reread()

    async def wait_change(self) -> None:
        """Wait until a burst of changes has passed, if any came since this or `observe` was called.

        Discovery, a transition or a parameter of a node that is asked, or a message of one that
        changed makes a change; a configuration that is put into the state makes none.
        """
        loop = self._bind()
        await self._changed.wait()
        end = loop.time() + self._burst_s
        while (left_s := end - loop.time()) > 0:
            self._changed.clear()
            # Not at each change: while nodes come there is one for each of their endpoints.
            await asyncio.sleep(min(self._quiet_s, left_s))
            if not self._changed.is_set():
                break
        self._changed.clear()

    def close(self) -> None:
        """Look no more; again is harmless."""
        self._closed = True
        self._remove()
        self.state.close()
        if self._due is not None:
            self._due()
        self._parameters.close()

    async def _ask_all(
        self,
        plan: Plan,
        nodes: Iterable[ObservedNode],
        planned: Collection[str],
        given: Collection[str],
    ) -> dict[str, Answer]:
        answers = dict(
            await asyncio.gather(
                *(
                    self._ask(node)
                    for node in nodes
                    if node.full_name in planned and node.full_name not in given
                )
            )
        )
        if self._unplanned:
            answers.update(
                await asyncio.gather(
                    *(
                        self._ask_unplanned(node)
                        for node in nodes
                        if node.managed
                        and node.full_name not in planned
                        and not tolerating_pattern(node.full_name, plan.policy.tolerated_nodes)
                    )
                )
            )
        return answers

    def _believed(self, plan: Plan, answers: Mapping[str, Answer]) -> dict[str, Answer]:
        """Leave out what nodes say of themselves that are in no host of ours.

        On this machine a host shows that it is one. Of another machine's nodes those count that the
        plan has in a host: its supervisor started them there.
        """
        here = self._discovery.hosted(
            name for name, (_, configuration) in answers.items() if configuration is not None
        )
        elsewhere = {each.full_name: bool(each.run.python) for each in plan.nodes}
        return {
            name: (state, configuration if here.get(name, elsewhere.get(name, True)) else None)
            for name, (state, configuration) in answers.items()
        }

    async def _ask(self, node: ObservedNode) -> tuple[str, Answer]:
        name = node.full_name
        self._asked.add(name)
        if not node.managed:
            return name, (None, await self._ask_configuration(name))
        self._follow_transitions(name)
        state, configuration = await asyncio.gather(
            self._ask_state(name), self._ask_configuration(name)
        )
        return name, (state, configuration)

    async def _ask_unplanned(self, node: ObservedNode) -> tuple[str, Answer]:
        name = node.full_name
        configuration = await self._ask_configuration(name)
        if configuration is None:
            return name, (None, None)
        self._asked.add(name)
        self._follow_transitions(name)
        return name, (configuration.state, configuration)

    async def _ask_state(self, name: str) -> str | None:
        try:
            return await self._clients.get_state(name, timeout_s=_ASK_S)
        except MiddlewareError as error:
            _logger.info("state of %s unknown: %s", name, error)
            return None

    async def _ask_configuration(
        self, name: str, *, timeout_s: float = _ASK_S, expected: bool = False
    ) -> NodeConfiguration | None:
        try:
            return await self._clients.get_configuration(
                name, timeout_s=timeout_s, expected=expected
            )
        except MiddlewareError as error:
            _logger.info("configuration of %s unknown: %s", name, error)
            return None

    def _follow_transitions(self, name: str) -> None:
        self._clients.on_transition(name, functools.partial(self._moved, name))

    # -- what happened, from any thread

    def _discovery_changed(self) -> None:
        self._wake()
        if self._follows:
            self._events.scheduler.post(self._follow_soon)

    def _moved(self, name: str) -> None:
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
                self._loop.call_soon_threadsafe(self._parameters.reread, name)
        self._wake()
        if self._follows:
            self.state.reread(name)

    def _wake(self) -> None:
        # Before the first use there is no loop, and no waiter. What is to be noted is noted later
        # than this, so that it is noted once.
        if self._loop is not None and not self._to_note:
            self._to_note = True
            with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
                self._loop.call_soon_threadsafe(self._note)

    # -- what happens in the scheduler

    def _note(self) -> None:
        self._to_note = False
        self.changes += 1
        self._changed.set()

    def _message_received(self, message: GraphMessage) -> None:
        """Take it as a change, unless it reports only what is known of its node.

        A node whose configuration is put into the state reports its changes that way; a heartbeat
        is one if its checksum is new.
        """
        name = message.node
        checksum = message.checksum if isinstance(message, Heartbeat) else ""
        known = checksum and self._checksums.get(name) == checksum
        if self._loop is not None and not known and name not in self.state.given:
            self._note()

    def _follow_soon(self) -> None:
        if self._due is None and not self._closed:
            scheduler = self._events.scheduler
            self._due = scheduler.call_at(scheduler.now_s() + _TOGETHER_S, self._follow)
            self.state.retry()

    def _follow(self) -> None:
        """Compare who is there with who was."""
        self._due = None
        if not self._closed:
            self._show(*self._discovery.snapshot())

    def _show(self, nodes: Collection[ObservedNode], endpoints: Iterable[ObservedEndpoint]) -> None:
        """Have nodes join that discovery shows, and forget those that it shows no more."""
        present = frozenset(node.full_name for node in nodes)
        for name in sorted(self._seen - present):
            self._forget(name)
        for name in sorted(present - self._seen):
            if _counts(name) and not self._events.reports(name):
                self._events.report_seen(name)
        self._seen = present
        given = self.state.given
        silent: list[ObservedNode] = []
        for node in nodes:
            name = node.full_name
            if name in given or not _counts(name) or self._events.reports(name):
                self._shown.pop(name, None)
            else:
                silent.append(node)
        if not silent:
            return
        by_node: dict[str, list[ObservedEndpoint]] = {}
        for endpoint in endpoints:
            by_node.setdefault(endpoint.node, []).append(endpoint)
        hidden = sorted(name for name in present if name.rpartition("/")[2].startswith("_"))
        for node in silent:
            name = node.full_name
            space, _, base = name.rpartition("/")
            own = f"{space}/_{base}_"
            shown = _Shown(
                managed=bool(node.managed),
                serves=self._follows and self._discovery.offers(name, f"{name}/get_configuration"),
                endpoints=tuple(by_node.get(name, ())),
                beside=tuple(
                    (each, tuple(by_node.get(each, ()))) for each in hidden if each.startswith(own)
                ),
            )
            if self._shown.get(name) != shown:
                self._shown[name] = shown
                self.state.reread(name)

    def _forget(self, name: str) -> None:
        """Drop what is held for a node that was in the graph and is not any more."""
        self._shown.pop(name, None)
        self._parameters.forget(name)
        self.state.drop_configuration(name, "discovery does not show it any more")
        if name in self._asked:
            self._asked.discard(name)
            self._clients.forget(name)

    # -- configurations for the state

    def _read(self, name: str, done: Callable[[NodeConfiguration | None], None]) -> None:
        """Give the configuration of a node: its own if it serves one, else what is seen of it."""
        if not self._follows:
            done(self.state.given.get(name) or self._seen_configuration(name, ""))
        elif not self._closed:
            reading = asyncio.ensure_future(self._answer(name, done))
            self._readings.add(reading)
            reading.add_done_callback(self._readings.discard)

    async def _answer(self, name: str, done: Callable[[NodeConfiguration | None], None]) -> None:
        # Who sends messages serves one, even if the next look has yet to show it.
        reports = self._events.reports(name)
        shown = self._shown.get(name)
        self._asked.add(name)
        if shown is not None and shown.managed:
            self._follow_transitions(name)
        configuration = None
        if reports or shown is None or shown.serves:
            configuration = await self._ask_configuration(
                name, timeout_s=_READ_S, expected=reports or shown is not None
            )
        elif shown.managed:
            configuration = self._seen_configuration(name, await self._ask_state(name) or "")
        else:
            configuration = self._seen_configuration(name, "")
        done(configuration or self.state.given.get(name))

    def _seen_configuration(self, name: str, state: str) -> NodeConfiguration | None:
        shown = self._shown.get(name)
        if shown is None:
            return None
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
                EndpointReport(
                    kind=each.kind, name="", resolved=each.name, type=each.type, mapped=True
                )
                for each in shown.endpoints
            ),
        )

    def _bind(self) -> asyncio.AbstractEventLoop:
        if self._loop is None:
            self._loop = asyncio.get_running_loop()
        return self._loop


def _counts(name: str) -> bool:
    """Whether a node is part of a system: no tool's, no hidden one, and its name is known."""
    hidden = name.rpartition("/")[2].startswith("_")
    return bool(known_node(name)) and not hidden and not is_noise_node(name)
