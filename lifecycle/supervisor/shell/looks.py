"""Looks when the core asks for it, and says what is seen of nodes that do not report: Look.

Owns: what is asked once more before a gate opens, which verdicts of a held system are kept back for
a moment, and when to look again although nobody says that something changed.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import TYPE_CHECKING

from lifecycle.graph.loop import set_within
from lifecycle.manifest.model import Condition
from lifecycle.measure.sample import SLOT_S
from lifecycle.plan.model import PlannedNode
from lifecycle.supervisor.core import advance, effects, gate, inputs
from lifecycle.supervisor.core.state import HOLDS, NEVER_S, Level
from lifecycle.supervisor.judging.grace_period import GracePeriod
from lifecycle.supervisor.judging.judge import without
from lifecycle.supervisor.nodes.driver import ACTIVE, INACTIVE
from lifecycle.supervisor.nodes.system import reached
from lifecycle.verify.observation import HealthReport, NodeConfiguration, Observation
from lifecycle.verify.readiness import shown
from lifecycle.verify.rules.health import health_of
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


class Looks:
    """Looks at the system of one supervisor.

    Args:
        shell: gets the inputs.
    """

    def __init__(self, shell: Supervisor) -> None:
        self._shell = shell
        self._system = shell.system
        self._graph = shell.means.participant.graph
        self._grace_period = GracePeriod()
        self._latest: Verdict | None = None
        self._was_stale = False
        self._again_s = ASK_AGAIN_S
        self._asked: Passage | None = None
        self._seen_last: inputs.Saw | None = None
        self._activated_s: dict[str, float] = {}

    async def look(self, _: effects.Look) -> None:
        """Look and judge, once a burst of changes is over."""
        run, judge = self._system.run, self._shell.judge
        loop = asyncio.get_running_loop()
        # While an open gate lets one level of nodes through after the other, each is looked at at
        # once; what the last of them report is on the way.
        passes = run.held_s is None and gate.allows(run) and not self._was_stale
        if self._latest is not None and not (passes and advance.stage_of(run) is Stage.CONNECTED):
            await self._quiet()
        newcomers_until_s = loop.time() + gate.UNVERIFIABLE_S
        is_read_again = False
        while True:
            self._shell.catch_up()
            mark, stage, away = run.mark, advance.stage_of(run), run.away
            began = dict(self._system.processes)
            found = await judge.look(stage)
            closes = gate.closes(found, strict=run.options.strict)
            if closes or stage is not Stage.CONNECTED or not self._is_waited_for():
                break
            if not is_read_again:
                is_read_again = True
                # Nodes of others need not say that their parameters changed, or that they hang.
                has_asked = await self._shell.answering.asked(self._left_s())
                if self._graph.reread_parameters() or has_asked:
                    continue
            lately = loop.time() < newcomers_until_s
            if not (lately and self._graph.discovery.settling.expect_newcomers()):
                break  # else the next look waits for them
        self._saw(judge.seen, began)
        self._was_stale = run.mark != mark
        self._shell.give(self._verified(mark, stage, away, found))

    def _is_waited_for(self) -> bool:
        run = self._system.run
        at_gate = run.passage is not None and run.passage.at_gate
        return at_gate or bool(advance.waiting(run))

    def _left_s(self) -> float:
        run = self._system.run
        passage = run.asked or run.opening
        return 0.0 if passage is None else max(0.0, passage.until_s - self._shell.now_s())

    def _verified(
        self, mark: int, stage: Stage, away: frozenset[str], found: Verdict
    ) -> inputs.Verified:
        run, judge = self._system.run, self._shell.judge
        now_s = asyncio.get_running_loop().time()
        verdict, awaited_s, again_s = found, list[float](), list[float]()
        watched = run.held_s is not None and run.asked is None and run.opening is None
        if watched:
            verdict, kept_s = self._grace_period.after(
                self._latest, found, self._system.expected, now_s
            )
            awaited_s += [] if kept_s is None else [kept_s]
            if run.plan.bounds and stage is Stage.ACTIVE:
                again_s.append(MEASURED_S if run.decided_s is not None else SLOT_S)
        self._latest = verdict
        closes = gate.closes(found, strict=run.options.strict)
        if not closes and stage is Stage.CONNECTED and (left_s := judge.unsaid_s(found)) > 0:
            awaited_s.append(left_s)
        if judge.asks_again(found):
            if run.asked is not self._asked:
                self._asked, self._again_s = run.asked, ASK_AGAIN_S
            again_s.append(ASK_AGAIN_AT_MOST_S if watched else self._again_s)
            self._again_s = min(self._again_s * 2, ASK_AGAIN_AT_MOST_S)
        if run.change is not None and judge.is_reconciling:
            awaited_s.append(ASK_AGAIN_AT_MOST_S)
        return inputs.Verified(
            mark=mark,
            verdict=verdict,
            again_s=min((*awaited_s, *again_s), default=NEVER_S),
            waits=bool(awaited_s),
            away=away,
        )

    async def _quiet(self) -> None:
        """Let a burst of changes pass."""
        loop = asyncio.get_running_loop()
        until_s = loop.time() + BURST_S
        while loop.time() < until_s and await set_within(self._shell.changed, QUIET_S):
            pass

    # Nodes that do not report

    async def follow(self) -> None:
        """Look at nodes of others, and at ours that others may drive, while no verdict is made."""
        while True:
            changed = self._shell.changed
            asked, looks = self._followed()
            if looks and not self._is_looked_at():
                began = dict(self._system.processes)
                system = self._system
                seen = await self._graph.observe(system.plan, only=asked, machines=system.machines)
                self._saw(seen, began)
            remote = any(self._system.run.elsewhere.values())
            await set_within(changed, REMOTE_S if remote else None)

    def _is_looked_at(self) -> bool:
        run = self._system.run
        return run.judged.looking or run.is_watched or advance.is_at_gate(run)

    def _followed(self) -> tuple[frozenset[str], bool]:
        """Return the names of the nodes that are asked, and whether it is to be looked at all."""
        run, ready = self._system.run, self._system.plan.awaited
        awaited = {after.node for each in run.nodes.values() for after in each.planned.after}
        healthy = {
            after.node
            for each in run.nodes.values()
            for after in each.planned.after
            if after.condition is Condition.HEALTHY
        }
        keys = {key for key in run.elsewhere if key in awaited}
        for key, node in self._system.nodes.items():
            foreign = node.planned.managed and not node.is_hosted
            reads = any(not each.by.kinds for each in ready.get(key, ()))
            if foreign or reads or (key in healthy and not node.reports_health):
                keys.add(key)
        names = frozenset(each.full_name for each in run.plan.nodes if each.key in keys)
        return names, bool(names or ready)

    def _saw(self, seen: Observation, began: Mapping[str, ManagedProcess]) -> None:
        """Say what is seen of nodes that do not report to us, where that is new.

        Args:
            seen: by one look.
            began: the processes when it began: of one that has died since it shows nothing.
        """
        nodes, awaited = self._system.nodes, self._system.plan.awaited
        seen = without(seen, self._system.dead())
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
        saw = inputs.Saw(levels=levels, health=health, shown=ready, elsewhere=elsewhere)
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
