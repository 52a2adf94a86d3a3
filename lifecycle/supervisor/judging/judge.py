"""Looks at the running system once, and judges what is there.

Owns: `Judge`: what a look asks and reads, what findings of others (the authority, other hosts,
silent nodes) join the verdict, and which peers of a report may not be discovered yet. When it looks
is the shell's, what a verdict means the core's. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING

from msgspec.structs import replace

from lifecycle.measure.sample import Measured
from lifecycle.middleware.fastdds.profiles import FORGOTTEN_S
from lifecycle.plan.model import Plan
from lifecycle.supervisor.connections import discovery_server
from lifecycle.supervisor.health.liveliness import arrivals
from lifecycle.supervisor.judging.standstill import Standstill
from lifecycle.supervisor.nodes.driver import ACTIVE
from lifecycle.supervisor.processes.scope import unlimited
from lifecycle.verify.judge import verify, with_findings, without_findings, without_measured
from lifecycle.verify.observation import Observation
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import rule
from lifecycle.verify.rules.catalogue import About
from lifecycle.verify.rules.health import UNHEALTHY
from lifecycle.verify.rules.matching import UNKNOWN_PEER
from lifecycle.verify.rules.measured import decided_by_clocks
from lifecycle.verify.verdict import FindingKey, Stage, Verdict

if TYPE_CHECKING:
    from lifecycle.graph.graph import Graph
    from lifecycle.supervisor.connections.authority import ConnectionAuthority
    from lifecycle.supervisor.health.peers import Peers
    from lifecycle.supervisor.nodes.system import System

DISCOVERED_S = 3.5
"""A participant whose first announcements were lost is discovered with the next one, after 3 s by
default: a node of ours may be matched with it for so long before our participant knows it."""

HEALTH_S = 5.0
"""Who publishes its health does so within this time, or it counts as stale (graph/observer.py): a
node that must be healthy, and has not said how it is, is waited for no longer."""


class Judge:
    """Judges one system.

    Args:
        system: which.
        observer: sees the graph.
        looker: learns of each look how nodes are connected; None where nodes connect themselves.
        peers: the supervisors of other hosts.

    Attributes:
        seen: what was seen last.
    """

    def __init__(
        self,
        system: System,
        observer: Graph,
        *,
        looker: ConnectionAuthority | None,
        peers: Peers,
    ) -> None:
        self._system = system
        self._observer = observer
        self._looker = looker
        self._peers = peers
        self._standstill = Standstill()
        self._stills = 0
        self._decided: frozenset[object] = frozenset()  # by clocks, as they were confirmed
        self.seen = Observation()
        self._unsaid: dict[str, float] = {}
        self._asked_of: tuple[Plan, frozenset[str], Plan] | None = None
        self._left: dict[str, float] = {}  # topics of processes that ended, and until when
        self._unknown_peers: dict[FindingKey, float] = {}  # since when each is found
        self._active_far: dict[str, float] = {}  # nodes of other machines, and since when
        self._again: asyncio.TimerHandle | None = None

    @property
    def is_behind(self) -> bool:
        """Whether this process stood still since the last look began."""
        return self._stills != self._standstill.count()

    def left(self, topics: Iterable[str]) -> None:
        """Note that a process with endpoints of these topics has ended."""
        until_s = asyncio.get_running_loop().time() + FORGOTTEN_S
        self._left.update(dict.fromkeys(topics, until_s))

    def close(self) -> None:
        """Judge no more."""
        self._standstill.close()
        if self._again is not None:
            self._again.cancel()

    async def look(self, stage: Stage) -> Verdict:
        """Look and judge now.

        Args:
            stage: what the system has reached.
        """
        if self._stills != (stills := self._standstill.count()):
            # What arrived meanwhile was not taken in: who came has to be asked for.
            self._stills = stills
            self._observer.discovery.settling.expect_newcomers(everybody=True)
        system = self._system
        await system.refresh(self._observer, marks=stage is Stage.CONNECTED)
        seen = await self._observer.observe(self._asked(), machines=system.machines)
        observation = without(seen, system.dead())
        run = system.run
        is_measured = run.held_s is not None and run.passage is None
        if is_measured:
            observation = replace(
                observation, clocks=self._peers.clocks(), marks=self._peers.marks()
            )
        observation = self._with_far_activity(observation)
        self.seen = observation
        system.present = arrivals(system.present or (), observation, system.emit)
        if self._looker is not None:
            self._looker.look(observation)
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
            await self._peers.compare_clocks()
            self.seen = replace(observation, clocks=self._peers.clocks())
            verdict = verified(self.seen)
        self._decided = decided_by_clocks(verdict.measured)
        self._peers.follow(verdict.flows)
        # Where nothing is declared, hosts do not report what they count.
        if not is_measured or not (expected.bounds or observation.marks):
            verdict = without_measured(verdict, expected.policy)
        verdict = self._without_passing_peers(verdict, stage)
        limits = unlimited(each.planned for each in system.run.processes.values())
        wiring = () if self._looker is None else self._looker.findings()
        verdict = with_findings(
            verdict, (*wiring, *system.liveliness.findings(), *limits), expected.policy
        )
        verdict = self._peers.explained(verdict)
        more = (*self._peers.findings(observation), *discovery_server.findings(system))
        return with_findings(verdict, more, expected.policy)

    def _with_far_activity(self, observation: Observation) -> Observation:
        """Return what was seen, with how long nodes of other machines are seen to be active."""
        far = {each.full_name for each in self._system.remote.values()}
        seen, now_s = observation.configurations, asyncio.get_running_loop().time()
        active = [each.name for each in seen if each.name in far and each.state in ("", ACTIVE)]
        self._active_far = {name: self._active_far.get(name, now_s) for name in active}
        timed = (
            replace(each, measured=Measured(active_s=now_s - self._active_far[each.name]))
            if each.name in self._active_far
            else each
            for each in seen
        )
        return replace(observation, configurations=tuple(timed)) if active else observation

    def _asked(self) -> Plan:
        """Return the plan without silent nodes; the same object while that is the same."""
        of = self._system.plan, frozenset(self._system.liveliness.silent)
        if self._asked_of is None or self._asked_of[0] is not of[0] or self._asked_of[1] != of[1]:
            self._asked_of = (*of, without_nodes(*of))
        return self._asked_of[2]

    def _without_passing_peers(self, verdict: Verdict, stage: Stage) -> Verdict:
        """Return a verdict without peers that the graph cannot explain yet, or any longer.

        Over TCP an end counts a peer that was killed until its lease runs out, and nothing can
        take it away before. Behind the gate a newcomer has DISCOVERED_S to be discovered.
        """
        loop = asyncio.get_running_loop()
        now_s = loop.time()
        self._left = {topic: at for topic, at in self._left.items() if at > now_s}
        found = {each.key: each for each in verdict.findings if each.rule == UNKNOWN_PEER.id}
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
        self._again = loop.call_at(min(passing.values()), self._system.touch)
        dropped = [found[key] for key in passing]
        return without_findings(verdict, dropped, self._system.expected.policy)

    def unsaid_s(self, verdict: Verdict) -> float:
        """Return for how long the health is waited for of nodes that have not said how they are.

        Once for each: who says nothing for so long is taken on trust, if the policy allows it.
        """
        now_s = asyncio.get_running_loop().time()
        unsaid = {
            each.node
            for each in verdict.findings
            if each.rule == UNHEALTHY.id and each.outcome is Outcome.UNVERIFIABLE
        }
        self._unsaid = {node: self._unsaid.get(node, now_s) for node in unsaid}
        return max((since + HEALTH_S - now_s for since in self._unsaid.values()), default=0.0)

    @property
    def is_reconciling(self) -> bool:
        """Whether the authority has still to make what running nodes lack."""
        return self._looker is not None and self._looker.is_at_work()

    def asks_again(self, verdict: Verdict) -> bool:
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


def without(observation: Observation, dead: frozenset[str]) -> Observation:
    """Return `observation` without the ghosts of dead nodes; a second node of the name stays."""
    if not dead:
        return observation
    alive = {
        node.full_name for node in observation.nodes if node.full_name in dead and node.count > 1
    }
    gone = dead - alive
    return replace(
        observation,
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
