"""Verifies the running system at every change: level-triggered, debounced, with a grace period.

Owns: when the system is judged again, how long a verdict that closes the gate is waited out, and
`GracePeriod`: which findings may pass by themselves while a system is watched, because the facts of
one change arrive one by one, and for how long a verdict that is worse by these alone is kept back.
The gate itself has no grace period. The graph, or a node over its control channel, notifies when to
verify again; only while what nobody notifies is missing, a match of a node that does not report its
own or a step of another supervisor's node, does it ask again. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Iterator
from typing import TYPE_CHECKING

from msgspec.structs import replace

from lifecycle.graph.loop import set_within
from lifecycle.manifest.model import EndpointKind
from lifecycle.middleware.fastdds.profiles import DEFAULT_LEASE_S
from lifecycle.plan.model import Plan
from lifecycle.supervisor.connections import discovery_server
from lifecycle.supervisor.control.protocol import ProcessState
from lifecycle.supervisor.gate.activation_guard import ActivationGuard
from lifecycle.supervisor.gate.gate import behind_s, closes
from lifecycle.supervisor.gate.standstill import Standstill
from lifecycle.supervisor.gate.violations import Violations
from lifecycle.supervisor.health.agreement import Agreement
from lifecycle.supervisor.health.answering import Answering
from lifecycle.supervisor.health.liveliness import NodeArrivals
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.processes.scope import unlimited
from lifecycle.supervisor.run.events import Emitter, Event, ProcessChanged, VerdictChanged
from lifecycle.supervisor.run.failure import ended
from lifecycle.verify.judge import verify, with_findings, with_only
from lifecycle.verify.observation import Observation
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import rule
from lifecycle.verify.rules.catalogue import About, Heals
from lifecycle.verify.rules.endpoints import DEFINITION_DIFFERS
from lifecycle.verify.rules.health import UNHEALTHY
from lifecycle.verify.rules.matching import SERVER_OF, UNKNOWN_PEER
from lifecycle.verify.rules.nodes import UNATTRIBUTED_ENDPOINT, UNDECLARED_NODE
from lifecycle.verify.rules.state import MISSING_REPORT
from lifecycle.verify.rules.time import SILENT_CLOCK
from lifecycle.verify.tool_filter import is_hidden_node
from lifecycle.verify.verdict import NOT_JUDGED, Finding, Stage, Verdict

if TYPE_CHECKING:
    from lifecycle.graph.graph import Graph
    from lifecycle.supervisor.connections.authority import ConnectionAuthority

PASSING_S = 1.0
"""Discovery shows a newcomer's endpoints before its name, measured 0.02–0.45 s earlier; what nodes
have only just been asked for, or have just made in code, is seen 0.01–0.1 s later."""

FORGOTTEN_S = DEFAULT_LEASE_S + 1.0
"""A participant that left without notice is in the graph no more, whoever made its profile."""

DISCOVERED_S = 3.5
"""A participant whose first announcements were lost is discovered with the next one, after 3 s by
default: a node of ours may be matched with it for so long before our participant knows it."""

_Key = tuple[str, str, str, EndpointKind | None]
_Place = tuple[object, ...]


class GracePeriod:
    """Knows since when something that may pass is wrong.

    Two kinds of findings may: an endpoint whose node is not known (yet), with what is not known of
    it for that reason; and whatever concerns an endpoint, a connection or a flow that must be there
    only since a moment ago, because the authority has just decided so.
    """

    def __init__(self) -> None:
        self._plan: Plan | None = None
        self._demanded: dict[tuple[_Place, str], float] = {}
        self._latest: dict[_Place, float] = {}
        self._unknown: dict[_Key, float] = {}

    def after(
        self, last: Verdict | None, verdict: Verdict, expected: Plan, now_s: float
    ) -> tuple[Verdict, float | None]:
        """Return the verdict that holds, and after how many seconds it has to be judged again.

        The seconds are None where what was found now holds.

        Args:
            last: the verdict that holds so far; None before the first.
            verdict: what was found now.
            expected: the plan that it was judged against.
            now_s: on any clock that only goes forward.
        """
        self._note(verdict, expected, now_s)
        before = set() if last is None else {_key(each) for each in last.findings}
        worse = [each for each in verdict.findings if _key(each) not in before]
        healed = before - {_key(each) for each in verdict.findings}
        if last is None or healed or not worse:
            return verdict, None
        left_s = [self._since(each) + PASSING_S - now_s for each in worse]
        if min(left_s) <= 0:
            return verdict, None
        return last, min(left_s)

    def _note(self, verdict: Verdict, expected: Plan, now_s: float) -> None:
        self._unknown = {
            _key(each): self._unknown.get(_key(each), now_s)
            for each in verdict.findings
            if _is_of_unknown_node(each)
        }
        if expected is self._plan:
            return
        since = float("-inf") if self._plan is None else now_s
        self._plan = expected
        self._demanded = {each: self._demanded.get(each, since) for each in _demands(expected)}
        self._latest = {}
        for (place, _), since in self._demanded.items():
            self._latest[place] = max(since, self._latest.get(place, since))

    def _since(self, finding: Finding) -> float:
        """Return since when a finding may pass; -inf if it may not."""
        if _is_of_unknown_node(finding):
            return self._unknown[_key(finding)]
        places: set[_Place] = {
            (finding.subject,),
            (finding.node, finding.endpoint, finding.subject),
        }
        if rule(finding.rule).about is About.CONNECTION:
            places.add(("connection", finding.node))
        return max(self._latest.get(place, float("-inf")) for place in places)


def _is_of_unknown_node(finding: Finding) -> bool:
    """Whether a finding says that it is not known whose an endpoint is, or no type hash of it.

    Of a hidden participant discovery may be ahead of its node's report.

    A client and a server of a service are two DDS endpoints each, which are seen one after the
    other as they come and as they go: until both are there, none of their hash is known.
    """
    if finding.rule == DEFINITION_DIFFERS.id:
        return not finding.node and finding.outcome is Outcome.UNVERIFIABLE
    if finding.rule == UNDECLARED_NODE.id:
        return is_hidden_node(finding.node)
    # Who publishes the time begins to once it is active.
    return finding.rule in (UNATTRIBUTED_ENDPOINT.id, SILENT_CLOCK.id)


def _is_of(finding: Finding, names: Collection[str]) -> bool:
    return any(each in names for each in (*finding.nodes, finding.subject))


def _key(finding: Finding) -> _Key:
    return finding.rule, finding.subject, finding.node, finding.endpoint


def _demands(plan: Plan) -> Iterator[tuple[_Place, str]]:
    """Yield what must be there: where a finding would say that it is not, and how it must be."""
    names = {each.key: each.full_name for each in plan.nodes}
    servers: dict[tuple[EndpointKind | None, str], list[str]] = {}
    for node in plan.nodes:
        for each in node.endpoints:
            servers.setdefault((each.kind, each.resolved), []).append(node.full_name)
    for node in plan.nodes:
        for each in node.endpoints:
            yield (node.full_name, each.kind, each.resolved), each.participant
            for server in servers.get((SERVER_OF.get(each.kind), each.resolved), ()):
                yield (f"{each.resolved}: {node.full_name} → {server}",), ""
        for one in node.participants:
            yield ("connection", node.full_name), f"{one.connection} {one.connections.urls}"
    for flow in plan.flows:
        ends = f"{names[flow.publisher]} → {names[flow.subscription]}"
        yield (f"{flow.topic}: {ends}",), flow.medium


QUIET_S = 0.005
"""Changes come in bursts: look again once it was quiet for so long ..."""

BURST_S = 0.05
"""... or a burst lasts longer than this."""

SETTLED_S = 0.5
"""A finding that time does not heal counts once it is unchanged for so long."""

UNWATCHED_S = 0.4
"""What happens to an active node while others are started or ended is reported within a second."""

HEALTH_S = 5.0
"""Who publishes its health does so within this time, or it counts as stale (graph/observer.py): a
node that must be healthy, and has not said how it is, is waited for no longer."""

UNVERIFIABLE_S = 3.5
"""What cannot be verified may be unseen yet; Fast DDS announces a late participant every 3 s."""

AGAIN_S = 5.0
"""For what changed behind an open gate to be judged clear where nobody is kept waiting for longer:
nodes that came again by policy are let through later. Fast DDS announces every 3 s."""

ASK_AGAIN_S = 0.02
"""Two other participants match without our graph changing, so while that is missing the nodes are
asked again: after this long, then twice as long each time, ..."""

ASK_AGAIN_AT_MOST_S = 0.5
"""... up to this."""


class ChangeCounter:
    """Counts the moments at which it is worth looking again: the graph's and the nodes'."""

    def __init__(self, system: System, observer: Graph) -> None:
        self._system = system
        self._observer = observer
        self._count = 0
        self._touches = 0
        self._event = asyncio.Event()
        self._tasks = (
            asyncio.ensure_future(self._follow_graph()),
            asyncio.ensure_future(self._follow_nodes()),
        )

    @property
    def count(self) -> int:
        """Changes so far."""
        return self._count

    @property
    def mark(self) -> tuple[int, int]:
        """A moment, as far as anything has changed: equal to a later one if nothing did since.

        It knows of a change as soon as it is noticed, where `count` lets a burst pass.
        """
        return self._observer.changes, self._touches + self._system.touched.is_set()

    async def beyond(self, count: int, timeout_s: float | None) -> bool:
        """Wait for a change after `count`; False if none came within `timeout_s`."""
        while self._count <= count:
            for task in self._tasks:
                if task.done():
                    task.result()
            if not await set_within(self._event, timeout_s):
                return False
        return True

    async def close(self) -> None:
        """Stop listening."""
        await ended(*self._tasks)

    async def _follow_graph(self) -> None:
        while True:
            await self._observer.wait_change()
            self._note()

    async def _follow_nodes(self) -> None:
        while True:
            await self._system.touched.wait()
            self._system.touched.clear()
            self._touches += 1
            self._note()

    def _note(self) -> None:
        self._count += 1
        self._event.set()
        self._event = asyncio.Event()


class VerificationLoop:
    """Judges one system.

    Attributes:
        latest: the verdict that holds; None before the first.
        seen: what was seen last.
        ahead: names of the nodes that an earlier gate let through, which are active before it.
        violations: what was violated while the system was held.
    """

    def __init__(
        self,
        system: System,
        observer: Graph,
        changes: ChangeCounter,
        emit: Emitter,
        *,
        strict: bool,
        verify_: Callable[..., Verdict] | None = None,
        looker: ConnectionAuthority | None = None,
        agreement: Agreement | None = None,
        guard: ActivationGuard | None = None,
        answering: Answering | None = None,
    ) -> None:
        self._system = system
        self._observer = observer
        self._changes = changes
        self._emit = emit
        self._strict = strict
        self._verify = verify_ or verify
        self._looker = looker
        self._agreement = agreement
        self._guard = guard
        self._answering = answering
        self.latest: Verdict | None = None
        self.violations = Violations()
        self._standstill = Standstill()
        self._mark: tuple[int, int] | None = None
        self._stills = 0
        self.seen = Observation()
        self._presence = NodeArrivals(emit)
        self._grace_period = GracePeriod()
        self._unsaid: dict[str, float] = {}
        self._asked_of: tuple[Plan, frozenset[str], Plan] | None = None
        self._left: dict[str, float] = {}  # topics of processes that ended, and until when
        self._unknown_peers: dict[_Key, float] = {}  # since when each is found
        self._again: asyncio.TimerHandle | None = None
        self.ahead: frozenset[str] = frozenset()

    async def once(self, stage: Stage) -> Verdict:
        """Look and judge now."""
        mark = self._changes.mark
        verdict = await self._look(stage)
        self._stands(stage, verdict)
        self._mark = mark
        return verdict

    def is_current(self, verdict: Verdict | None) -> bool:
        """Whether nothing changed since the look that `verdict`, the latest one, came from."""
        return (
            verdict is self.latest
            and self._mark == self._changes.mark
            and self._stills == self._standstill.count()
        )

    def on_event(self, event: Event) -> None:
        """Take an event of the system; of interest are ends of processes."""
        if not isinstance(event, ProcessChanged) or event.state is not ProcessState.EXITED:
            return
        process = self._system.processes.get(event.process)
        until_s = asyncio.get_running_loop().time() + FORGOTTEN_S
        for key in () if process is None else process.planned.nodes:
            if (node := self._system.nodes.get(key)) is not None:
                self._left.update({each.resolved: until_s for each in node.planned.endpoints})

    def _without_passing_peers(self, verdict: Verdict, stage: Stage) -> Verdict:
        """Return a verdict without peers that the graph cannot explain yet, or any longer.

        Over TCP an end counts a peer that was killed until its lease runs out, and nothing can
        take it away before. Behind the gate a newcomer has DISCOVERED_S to be discovered.
        """
        loop = asyncio.get_running_loop()
        now_s = loop.time()
        self._left = {topic: at for topic, at in self._left.items() if at > now_s}
        found = {_key(each): each for each in verdict.findings if each.rule == UNKNOWN_PEER.id}
        self._unknown_peers = {key: self._unknown_peers.get(key, now_s) for key in found}
        until_s = {}
        for key, since_s in self._unknown_peers.items():
            least_s = since_s + DISCOVERED_S if stage is Stage.ACTIVE else now_s
            until_s[key] = max(least_s, self._left.get(found[key].subject, now_s))
        passing = {key: at for key, at in until_s.items() if at > now_s}
        if not passing:
            return verdict
        if self._again is not None:
            self._again.cancel()
        self._again = loop.call_at(min(passing.values()), self._system.touched.set)
        findings = tuple(each for each in verdict.findings if _key(each) not in passing)
        return with_only(verdict, findings, self._system.expected.policy)

    def close(self) -> None:
        """Judge no more."""
        self._standstill.close()
        if self._again is not None:
            self._again.cancel()

    async def again(self, ahead: frozenset[str], deadline: float | None) -> Verdict:
        """Judge a system behind an open gate again because it changed.

        What heals with time has as long for it as before the gate: a host that is cut off in
        between, or a node of another host that takes long to activate, ends no bring-up that is
        within its time.

        Args:
            ahead: names of the nodes that were asked to activate since the gate opened.
            deadline: of what the gate was opened for, by the running loop's clock; None for
                AGAIN_S from now.

        Returns:
            The latest verdict; whether it keeps the gate open is the gate's to say.
        """
        self.ahead |= ahead
        timeout_s = AGAIN_S if deadline is None else behind_s(deadline)
        await self.until_clear(Stage.CONNECTED, timeout_s)
        assert self.latest is not None
        return self.latest

    async def settled(self, stage: Stage) -> tuple[Verdict, float | None]:
        """Look and judge now, and give what may pass by itself a moment to do so (GracePeriod).

        Returns:
            The verdict that holds, and after how many seconds it must be judged again if it is
            not what was found now.
        """
        mark = self._changes.mark
        found = await self._look(stage)
        now_s = asyncio.get_running_loop().time()
        verdict, again_s = self._grace_period.after(
            self.latest, found, self._system.expected, now_s
        )
        self._stands(stage, verdict)
        self._mark = mark if again_s is None else None
        return verdict, again_s

    async def keep_looking(
        self, ahead: Callable[[], frozenset[str]], away: Callable[[], frozenset[str]]
    ) -> None:
        """Judge at changes, until cancelled, who is active while others are started or ended.

        It is begun late and looks seldom: what is over soon is judged at its end anyway. The
        verdict changes only if it is worse by what is about none of those others. Nothing else may
        judge meanwhile.

        Args:
            ahead: returns the names of the nodes that are active now.
            away: returns the names of the nodes that are not as far as they should be.
        """
        loop = asyncio.get_running_loop()
        while True:
            await asyncio.sleep(UNWATCHED_S)
            count = self._changes.count
            self.ahead = ahead()
            found = await self._look(Stage.CONNECTED)
            _, again_s = self._grace_period.after(
                self.latest, found, self._system.expected, loop.time()
            )
            if again_s is None:
                if self._is_worse(found, away()):
                    self._stands(Stage.CONNECTED, found)
                again_s = self.violated(found, away())
            await self._changes.beyond(count, again_s)

    def violated(self, verdict: Verdict, away: frozenset[str]) -> float | None:
        """Take note of what is violated of nodes that are to be as planned, see Violations.

        Args:
            verdict: that holds.
            away: full names of nodes that are not up, or wait for a gate.
        """
        away |= self._system.dead()  # a process that ends is a failure, and counts as that
        if self._agreement is not None:
            away |= self._agreement.left()
        now_s = asyncio.get_running_loop().time()
        return self.violations.see(self.without_nodes_of(verdict, away), now_s)

    def without_nodes_of(self, verdict: Verdict, names: Collection[str]) -> Verdict:
        """Return a verdict without what is found of these nodes: they are away, or not let through.

        Args:
            verdict: of all nodes.
            names: fully qualified.
        """
        findings = tuple(each for each in verdict.findings if not _is_of(each, names))
        return with_only(verdict, findings, self._system.expected.policy) if names else verdict

    def _is_worse(self, found: Verdict, away: frozenset[str]) -> bool:
        known = () if self.latest is None else self.latest.findings
        return any(
            each.outcome is Outcome.VIOLATED and not _is_of(each, away)
            for each in found.findings
            if _key(each) not in {_key(one) for one in known}
        )

    def refuse(self, findings: tuple[Finding, ...]) -> Verdict:
        """Judge by what was found before anything was started; return the verdict."""
        verdict = with_findings(NOT_JUDGED, findings, self._system.expected.policy)
        self._stands(Stage.CONNECTED, verdict)
        return verdict

    def _stands(self, stage: Stage, verdict: Verdict) -> None:
        if verdict != self.latest:
            self.latest = verdict
            self._emit(VerdictChanged(stage=stage, verdict=verdict))

    async def _look(self, stage: Stage) -> Verdict:
        if self._stills != (stills := self._standstill.count()):
            # What arrived meanwhile was not taken in: who came has to be asked for.
            self._stills = stills
            self._observer.expect_newcomers(everybody=True)
        await self._system.refresh(self._observer, marks=stage is Stage.CONNECTED)
        asked = self._asked()
        observation = without(await self._observer.observe(asked), self._system.dead())
        self.seen = observation
        self._presence.see(observation)
        self._system.present = self._presence.present
        if self._looker is not None:
            self._looker.look(observation)
        if self._guard is not None:
            self._guard.look(observation)
        expected, machines = self._system.expected, self._system.machines
        ahead, over = self.ahead, self._system.over()
        verdict = self._verify(
            expected, observation, stage=stage, machines=machines, ahead=ahead, over=over
        )
        verdict = self._without_passing_peers(verdict, stage)
        policy = expected.policy
        if self._looker is not None:
            verdict = with_findings(verdict, self._looker.findings(), policy)
        if self._guard is not None:
            verdict = with_findings(verdict, self._guard.findings(), policy)
        verdict = with_findings(verdict, self._system.liveliness.findings(), policy)
        limits = unlimited(each.planned for each in self._system.processes.values())
        verdict = with_findings(verdict, limits, policy)
        if self._agreement is not None:
            verdict = self._agreement.explained(verdict)
            verdict = with_findings(verdict, self._agreement.findings(observation), policy)
        return with_findings(verdict, discovery_server.findings(self._system), policy)

    def _asked(self) -> Plan:
        """Return the plan without silent nodes; the same object while that is the same."""
        of = self._system.plan, frozenset(self._system.liveliness.silent)
        if self._asked_of is None or self._asked_of[0] is not of[0] or self._asked_of[1] != of[1]:
            self._asked_of = (*of, without_nodes(*of))
        return self._asked_of[2]

    async def until_clear(
        self, stage: Stage, timeout_s: float, *, unchanged_s: float | None = None
    ) -> Verdict:
        """Judge until the gate may open, a finding that cannot heal persists, or time is up.

        Args:
            stage: what the system has reached.
            timeout_s: seconds, for all of it.
            unchanged_s: seconds after which findings count that have not changed, even if they
                could heal; None waits for these until time is up.

        Returns:
            The last verdict; whether it opens the gate is the gate's to say.
        """
        loop = asyncio.get_running_loop()
        deadline = loop.time() + timeout_s
        newcomers_until = min(deadline, loop.time() + UNVERIFIABLE_S)
        stable: frozenset[tuple[str, str]] = frozenset()
        since = loop.time()
        again = ASK_AGAIN_S
        is_read_again = stage is not Stage.CONNECTED
        while True:
            count = self._changes.count
            verdict = await self.once(stage)
            now = loop.time()
            if not closes(verdict, strict=self._strict):
                if not is_read_again:
                    is_read_again = True
                    has_asked = await self._had_to_ask(deadline - now)
                    # Nodes of others need not say that their parameters changed, or that they hang.
                    if (now < deadline and self._observer.reread_parameters()) or has_asked:
                        continue
                lately = stage is Stage.CONNECTED and now < newcomers_until
                if lately and self._observer.expect_newcomers():
                    continue  # the next look waits for them
                unsaid_s = min(self._unsaid_s(verdict, now), deadline - now)
                if unsaid_s <= 0 or stage is not Stage.CONNECTED:
                    return verdict
                if await self._changes.beyond(count, unsaid_s):
                    await self.quiet()
                continue
            found = frozenset((each.rule, each.subject) for each in verdict.findings)
            if found != stable:
                stable, since = found, now
            patience = _patience(verdict)
            if unchanged_s is not None:
                patience = unchanged_s if patience is None else min(patience, unchanged_s)
            until = deadline if patience is None else min(deadline, since + patience)
            if now >= until or (self._guard is not None and self._guard.has_given_up):
                return verdict
            wait_s = until - now
            if self.asks_again(verdict):
                wait_s, again = min(wait_s, again), min(again * 2, ASK_AGAIN_AT_MOST_S)
            if await self._changes.beyond(count, wait_s):
                await self.quiet()

    async def _had_to_ask(self, timeout_s: float) -> bool:
        """Have nodes that are in no host of ours asked; return whether any was waited for."""
        return self._answering is not None and await self._answering.asked(timeout_s)

    def _unsaid_s(self, verdict: Verdict, now: float) -> float:
        """Return for how long the health is waited for of nodes that have not said how they are.

        Once for each: who says nothing for so long is taken on trust, if the policy allows it.
        """
        unsaid = {
            each.node
            for each in verdict.findings
            if each.rule == UNHEALTHY.id and each.outcome is Outcome.UNVERIFIABLE
        }
        self._unsaid = {node: self._unsaid.get(node, now) for node in unsaid}
        return max((since + HEALTH_S - now for since in self._unsaid.values()), default=0.0)

    @property
    def is_reconciling(self) -> bool:
        """Whether the authority has still to make what running nodes lack."""
        return self._looker is not None and self._looker.is_at_work()

    async def reconciled(self, stage: Stage, timeout_s: float) -> None:
        """Look until the authority has made what running nodes lack, gives it up, or time is up.

        What a verdict would find until then is on its way.
        """
        loop = asyncio.get_running_loop()
        deadline = loop.time() + timeout_s
        while self._looker is not None:
            count = self._changes.count
            await self._look(stage)
            left_s = deadline - loop.time()
            if not self.is_reconciling or left_s <= 0:
                return
            if await self._changes.beyond(count, min(left_s, ASK_AGAIN_AT_MOST_S)):
                await self.quiet()

    def asks_again(self, verdict: Verdict) -> bool:
        """Whether something is missing that nobody would report once it is there."""
        return self._waits_for_match(verdict) or self._waits_for_others(verdict)

    def _waits_for_match(self, verdict: Verdict) -> bool:
        """Whether a match is missing that no node would report: hosts report theirs.

        What a node of another machine said of it may be from when the link was cut.
        """
        others = {each.name for each in self._system.remote.values()}
        reporting = {each.name for each in self._system.nodes.values() if each.reports_changes}
        return any(
            each.outcome is Outcome.VIOLATED
            and rule(each.rule).about is About.MATCH
            and (reporting.isdisjoint(each.nodes) or not others.isdisjoint(each.nodes))
            for each in verdict.findings
        )

    def _waits_for_others(self, verdict: Verdict) -> bool:
        """Whether a node that another supervisor brings up has a step to go: no report comes."""
        others = {each.name for each in self._system.remote.values()}
        return any(
            rule(each.rule).about is About.PROGRESS and each.node in others
            for each in verdict.findings
        )

    async def quiet(self) -> None:
        """Let a burst of changes pass."""
        loop = asyncio.get_running_loop()
        end = loop.time() + BURST_S
        while loop.time() < end and await self._changes.beyond(self._changes.count, QUIET_S):
            pass


def without(observation: Observation, dead: frozenset[str]) -> Observation:
    """Return `observation` without the ghosts of dead nodes; a second node of the name stays."""
    if not dead:
        return observation
    alive = {
        node.full_name for node in observation.nodes if node.full_name in dead and node.count > 1
    }
    gone = dead - alive
    return Observation(
        nodes=tuple(
            replace(node, count=node.count - 1) if node.full_name in alive else node
            for node in observation.nodes
            if node.full_name not in gone
        ),
        endpoints=tuple(each for each in observation.endpoints if each.node not in gone),
        configurations=tuple(each for each in observation.configurations if each.name not in gone),
        parameters=tuple(each for each in observation.parameters if each.node not in gone),
    )


def without_nodes(plan: Plan, silent: Collection[str]) -> Plan:
    """Return `plan` without the nodes that would not answer, so that they are not waited for."""
    if not silent:
        return plan
    nodes = tuple(each for each in plan.nodes if each.full_name not in silent)
    return replace(plan, nodes=nodes)


def _patience(verdict: Verdict) -> float | None:
    """How long the findings of `verdict` may stay unchanged; None for as long as there is time."""
    violated = [rule(each.rule) for each in verdict.findings if each.outcome is Outcome.VIOLATED]
    if any(each.heals is not Heals.WITH_TIME for each in violated):
        return SETTLED_S
    if all(each.awaits is MISSING_REPORT for each in violated):
        # A foreign node may report yet, or never will: that is not worth the whole time.
        stays = any(rule(each.rule).heals is Heals.NEVER for each in verdict.findings)
        return SETTLED_S if stays and not violated else UNVERIFIABLE_S
    return None
