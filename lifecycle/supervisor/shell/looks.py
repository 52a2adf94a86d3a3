"""Looks at the running system when the core asks for it, and judges what is there: Look.

Owns: what a look asks and reads, what findings of others (the authority, other hosts, silent nodes)
join the verdict, which verdicts of a held system are kept back for a moment, when to look again
although nobody says that something changed, and what is seen of nodes that do not report. What a
verdict means is the core's. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import TYPE_CHECKING

from msgspec.structs import replace

from lifecycle.graph.loop import set_within
from lifecycle.manifest.model import Condition, EndpointKind
from lifecycle.measure.sample import SLOT_S
from lifecycle.plan.model import PlannedNode
from lifecycle.supervisor.core import advance, gate, messages
from lifecycle.supervisor.core.state import HOLDS, NEVER_S, Level
from lifecycle.supervisor.nodes.driver import ACTIVE, INACTIVE
from lifecycle.supervisor.nodes.liveliness import arrivals
from lifecycle.supervisor.nodes.system import reached
from lifecycle.supervisor.processes.process import unlimited
from lifecycle.supervisor.shell.settling import Passing, Standstill
from lifecycle.verify.judge import verify, with_findings, without_measured
from lifecycle.verify.observation import HealthReport, NodeConfiguration, Observation, shown
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import rule
from lifecycle.verify.rules.catalogue import About
from lifecycle.verify.rules.measured import decided_by_clocks
from lifecycle.verify.rules.state import UNHEALTHY, health_of
from lifecycle.verify.tool_filter import PREFIX_DIGITS
from lifecycle.verify.verdict import Stage, Verdict

if TYPE_CHECKING:
    from lifecycle.supervisor.core.state import Passage
    from lifecycle.supervisor.nodes.system import NodeRun
    from lifecycle.supervisor.processes.process import ManagedProcess
    from lifecycle.supervisor.shell.supervisor import Supervisor

QUIET_S = 0.005
"""Changes come in bursts: look again once it was quiet for so long ..."""

BURST_S = 0.05
"""... or a burst lasts longer than this."""

ASK_AGAIN_S = 0.02
"""Two other participants match without our graph changing, so while that is missing the nodes are
asked again: after this long, then twice as long each time, ..."""

ASK_AGAIN_AT_MOST_S = 0.5
"""... up to this."""

MEASURED_S = 1.0
"""What has arrived is compared with what is declared so often; in the probation twice as often."""

REMOTE_S = 0.2
"""A remote node is asked again so long after, because the event that it connected may be missed:
its announcer may not be matched yet."""

SHOWN_S = 0.5
"""The graph shows the state of a node of others within so long after it changed."""

HEALTH_S = 5.0
"""Who publishes its health does so within this time, or it counts as stale (graph/graph.py): a
node that must be healthy, and has not said how it is, is waited for no longer."""


class Looks:
    """Looks at the system of one supervisor.

    Args:
        shell: gets the inputs.

    Attributes:
        seen: what was seen last.
    """

    def __init__(self, shell: Supervisor) -> None:
        self._shell = shell
        self._system = shell.system
        self._graph = shell.means.participant.graph
        self._passing = Passing()
        self._judged = False
        self._was_stale = False
        self._again_s = ASK_AGAIN_S
        self._asked: Passage | None = None
        self._seen_last: messages.Saw | None = None
        self._activated_s: dict[str, float] = {}
        self._standstill = Standstill()
        self._stills = 0
        self._decided: frozenset[object] = frozenset()  # by clocks, as they were confirmed
        self.seen = Observation()
        # Nodes that are not our hosts' and their participants' prefixes, and since when.
        self._active: dict[tuple[str, str], float] = {}

    @property
    def is_behind(self) -> bool:
        """Whether this process stood still since the last look began."""
        return self._stills != self._standstill.count()

    def close(self) -> None:
        """Judge no more."""
        self._standstill.close()

    async def look(self, _: messages.Look) -> None:
        """Look and judge, once a burst of changes is over."""
        run = self._system.run
        loop = asyncio.get_running_loop()
        # While an open gate lets one level of nodes through after the other, each is looked at at
        # once; what the last of them report is on the way.
        passes = run.held_s is None and gate.allows(run) and not self._was_stale
        if self._judged and not (passes and advance.stage_of(run) is Stage.CONNECTED):
            until_s = loop.time() + BURST_S
            while loop.time() < until_s and await set_within(self._shell.changed, QUIET_S):
                pass
        newcomers_until_s = loop.time() + gate.UNVERIFIABLE_S
        is_read_again = False
        while True:
            self._shell.catch_up()
            mark, stage, away = run.mark, advance.stage_of(run), run.away
            began = dict(self._system.processes)
            found = await self.judge(stage)
            closes = gate.closes(found, strict=run.options.strict)
            passage = run.passage
            is_waited_for = (passage is not None and passage.at_gate) or advance.waiting(run)
            if closes or stage is not Stage.CONNECTED or not is_waited_for:
                break
            if not is_read_again:
                is_read_again = True
                # Nodes of others need not say that their parameters changed, or that they hang.
                passage = run.asked or run.opening
                left_s = 0.0 if passage is None else passage.until_s - self._shell.now_s()
                has_asked = await self._shell.answering.asked(left_s)
                if self._graph.reread_parameters() or has_asked:
                    continue
            lately = loop.time() < newcomers_until_s
            if not (lately and self._graph.discovery.settling.expect_newcomers()):
                break  # else the next look waits for them
        self._saw(self.seen, began)
        self._was_stale = run.mark != mark
        self._shell.give(self._verified(mark, stage, away, found))

    def _verified(
        self, mark: int, stage: Stage, away: frozenset[str], found: Verdict
    ) -> messages.Verified:
        run, authority = self._system.run, self._shell.authority
        now_s, self._judged = asyncio.get_running_loop().time(), True
        watched = run.held_s is not None and run.asked is None and run.opening is None
        verdict, passes_s = self._passing.without(
            found, self._system.expected, now_s, stage=stage, watched=watched
        )
        awaited_s = [passes_s] if watched and verdict is not found else []
        again_s = [passes_s]
        if watched and run.plan.bounds and stage is Stage.ACTIVE:
            again_s.append(MEASURED_S if run.decided_s is not None else SLOT_S)
        if not gate.closes(found, strict=run.options.strict) and stage is Stage.CONNECTED:
            # Who says nothing for so long is taken on trust, if the policy allows it.
            unsaid = (each for each in found.findings if each.rule == UNHEALTHY.id)
            left_s = (self._passing.since_s(each) + HEALTH_S - now_s for each in unsaid)
            awaited_s += [each for each in left_s if each > 0]
        if self._asks_again(found):
            if run.asked is not self._asked:
                self._asked, self._again_s = run.asked, ASK_AGAIN_S
            again_s.append(ASK_AGAIN_AT_MOST_S if watched else self._again_s)
            self._again_s = min(self._again_s * 2, ASK_AGAIN_AT_MOST_S)
        if authority is not None:
            again_s.append(authority.again_s)
            if run.change is not None and authority.is_at_work():
                # The authority has still to make what running nodes lack.
                awaited_s.append(ASK_AGAIN_AT_MOST_S)
        return messages.Verified(
            mark=mark,
            verdict=verdict,
            again_s=min(*awaited_s, *again_s, NEVER_S),
            waits=bool(awaited_s),
            away=away,
        )

    # One verdict

    async def judge(self, stage: Stage) -> Verdict:
        """Look and judge now."""
        if self._stills != (stills := self._standstill.count()):
            # What arrived meanwhile was not taken in: who came has to be asked for.
            self._stills = stills
            self._graph.discovery.settling.expect_newcomers(everybody=True)
            self._graph.measure_anew()
        system = self._system
        await system.refresh(self._graph, marks=stage is Stage.CONNECTED)
        awake = {each.full_name for each in system.plan.nodes} - system.liveliness.silent.keys()
        observation = await self._graph.observe(system.plan, only=awake, machines=system.machines)
        run = system.run
        is_measured = run.held_s is not None and run.passage is None
        if is_measured:
            observation = replace(
                observation, clocks=self._shell.peers.clocks(), marks=self._shell.peers.marks()
            )
        observation = self._with_activity(observation)
        self.seen = observation
        system.present = arrivals(system.present or (), observation, system.emit)
        if self._shell.authority is not None:
            self._shell.authority.look(observation)
        expected = system.expected

        def verified(observation: Observation) -> Verdict:
            return verify(
                expected,
                observation,
                stage=stage,
                machines=system.machines,
                ahead=system.run.ahead,  # as of now: some are activated meanwhile
                over=system.over(),
            )

        verdict = verified(observation)
        if not decided_by_clocks(verdict.measured) <= self._decided:
            await self._shell.peers.compare_clocks()
            self.seen = replace(observation, clocks=self._shell.peers.clocks())
            verdict = verified(self.seen)
        self._decided = decided_by_clocks(verdict.measured)
        self._shell.peers.follow(verdict.flows)
        # Where nothing is declared, hosts do not report what they count.
        if not is_measured or not (expected.bounds or observation.marks):
            verdict = without_measured(verdict, expected.policy)
        limits = unlimited(each.planned for each in system.run.processes.values())
        wiring = () if self._shell.authority is None else self._shell.authority.findings()
        verdict = with_findings(
            verdict, (*wiring, *system.liveliness.findings(), *limits), expected.policy
        )
        verdict = self._shell.peers.explained(verdict)
        return with_findings(verdict, self._shell.peers.findings(observation), expected.policy)

    def _with_activity(self, observation: Observation) -> Observation:
        """Return what was seen, with how long nodes are seen to be active that are not our hosts'.

        A process that replaced another, which has a participant of its own, is seen anew.
        """
        ours = {each.name for each in self._system.nodes.values() if each.is_hosted}
        states = {each.full_name: each.state for each in observation.nodes}
        states |= {each.name: each.state for each in observation.configurations}
        participants: dict[str, set[str]] = {}
        for end in observation.endpoints:
            if end.kind is EndpointKind.PUBLISHER:
                participants.setdefault(end.node, set()).add(end.gid[:PREFIX_DIGITS])
        now_s = asyncio.get_running_loop().time()
        active = [
            (name, prefix)
            for name in (each.full_name for each in self._system.plan.nodes)
            if name not in ours and states.get(name, "absent") in (None, "", ACTIVE)
            for prefix in participants.get(name, {""})
        ]
        self._active = {each: self._active.get(each, now_s) for each in active}
        since_s: dict[str, float] = {}
        for (name, _), seen_s in self._active.items():
            since_s[name] = max(seen_s, since_s.get(name, seen_s))
        times = tuple((name, now_s - each) for name, each in since_s.items())
        return replace(observation, active_s=times)

    def _asks_again(self, verdict: Verdict) -> bool:
        """Whether something is missing that nobody would report once it is there.

        A match that no node would report: hosts report theirs, and what a node of another machine
        said of it may be from when the link was cut. Or a step of another supervisor's node.
        """
        others = {each.full_name for each in self._system.remote.values()}
        reporting = {each.name for each in self._system.nodes.values() if each.is_hosted}
        return any(
            (rule(each.rule).about is About.PROGRESS and each.node in others)
            or (
                each.outcome is Outcome.VIOLATED
                and rule(each.rule).about is About.MATCH
                and (reporting.isdisjoint(each.nodes) or not others.isdisjoint(each.nodes))
            )
            for each in verdict.findings
        )

    # Nodes that do not report

    async def follow(self) -> None:
        """Look at nodes of others, and at ours that others may drive, while no verdict is made."""
        while True:
            changed = self._shell.changed
            asked = self._followed()
            system, run = self._system, self._system.run
            is_looked_at = run.judged.looking or run.is_watched or advance.is_at_gate(run)
            if (asked or system.plan.awaited) and not is_looked_at:
                began = dict(system.processes)
                seen = await self._graph.observe(system.plan, only=asked, machines=system.machines)
                self._saw(seen, began)
            remote = any(run.elsewhere.values())
            await set_within(changed, REMOTE_S if remote else None)

    def _followed(self) -> frozenset[str]:
        """Return the names of the nodes that are asked."""
        run, ready = self._system.run, self._system.plan.awaited
        afters = [after for each in run.nodes.values() for after in each.planned.after]
        healthy = {each.node for each in afters if each.condition is Condition.HEALTHY}
        keys = {each.node for each in afters if each.node in run.elsewhere}
        for key, node in self._system.nodes.items():
            foreign = node.planned.managed and not node.is_hosted
            reads = any(not each.by.kinds for each in ready.get(key, ()))
            if foreign or reads or (key in healthy and not node.reports_health):
                keys.add(key)
        return frozenset(each.full_name for each in run.plan.nodes if each.key in keys)

    def _saw(self, seen: Observation, began: Mapping[str, ManagedProcess]) -> None:
        """Say what is seen of nodes that do not report to us, where that is new.

        `began`: the processes when the look began: of one that has died since it shows nothing.
        """
        nodes, awaited = self._system.nodes, self._system.plan.awaited
        states = {each.full_name: each.state for each in seen.nodes}
        own = {each.name: own_health(each) for each in seen.configurations}
        published = {each.full_name: each.health for each in seen.nodes}
        levels, health = {}, {}
        for key, node in nodes.items():
            if self._is_news(node, states.get(node.name)):
                levels[key] = Level.ACTIVE
                node.report(ACTIVE, connected=True)
            if not node.reports_health:
                node.health = own.get(node.name), published.get(node.name)
            health[key] = node.is_healthy
        elsewhere = {
            key: conditions(each, seen) | shown(awaited.get(key, ()), each, seen)
            for key, each in self._system.remote.items()
        }
        ready = {
            key: shown(awaited[key], node.planned, seen)
            for key, node in nodes.items()
            if key in awaited and node.process is began.get(node.core.process)
        }
        saw = messages.Saw(levels=levels, health=health, shown=ready, elsewhere=elsewhere)
        if saw != self._seen_last or levels:
            self._seen_last = saw
            self._shell.give(saw)

    def _is_news(self, node: NodeRun, state: str | None) -> bool:
        """Whether a node of others is seen to have been activated since it was seen so before."""
        now_s, key = asyncio.get_running_loop().time(), node.core.key
        if node.is_hosted or not node.planned.managed or state != ACTIVE:
            self._activated_s.pop(key, None)
            return False
        if node.core.level is Level.ACTIVE:
            return False
        # The graph may show for a moment what it was before it was deactivated.
        is_news = now_s - self._activated_s.get(key, -SHOWN_S) >= SHOWN_S
        if is_news:
            self._activated_s[key] = now_s
            asyncio.get_running_loop().call_later(SHOWN_S, self._system.touch)
        return is_news


def own_health(report: NodeConfiguration | None) -> HealthReport | None:
    """Return what a node says of itself; what it said while it was inactive is no answer."""
    return None if report is None or report.state == INACTIVE else report.health


def conditions(planned: PlannedNode, seen: Observation) -> frozenset[Condition]:
    """Return the conditions that a node of another supervisor is seen to have reached."""
    name = planned.full_name
    observed = next((each for each in seen.nodes if each.full_name == name), None)
    if observed is None:
        return frozenset()
    report = next((each for each in seen.configurations if each.name == name), None)
    state = observed.state or (report.state if report is not None else "")
    level = Level.ACTIVE
    if planned.managed:
        # A node that is not ours makes its data layer in configure, and has no such report.
        level = reached(state, connected=report is None or report.connected)
    found = {condition for condition, least in HOLDS.items() if least <= level}
    if not health_of(planned, own_health(report), observed.health).ok:
        found.discard(Condition.HEALTHY)
    return frozenset(found)
