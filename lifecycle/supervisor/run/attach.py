"""Verifies a system that runs already, started by us or by others.

Owns: `judge_running`: looks from outside, as one more participant, until the verdict is ok or the
time is up. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import os
from collections.abc import Callable

from lifecycle.errors import UsageError
from lifecycle.manifest import EndpointPolicy
from lifecycle.middleware import peers_environment
from lifecycle.plan import Plan, reached_hosts
from lifecycle.run_directory import run_name, runtime_root
from lifecycle.supervisor.connections.negotiation import Expectation, is_negotiated
from lifecycle.supervisor.control.client import look, running
from lifecycle.supervisor.gate.gate import closes
from lifecycle.supervisor.gate.verification_loop import GracePeriod, with_findings
from lifecycle.supervisor.nodes.observer_participant import ObserverParticipant
from lifecycle.supervisor.run.options import onlooker_connections, own_machines
from lifecycle.verify import (
    Heals,
    NodeConfiguration,
    Observation,
    Outcome,
    Stage,
    Verdict,
    rule,
    tolerating_pattern,
    verify,
)

_ASK_AGAIN_S = 0.5
"""Nodes are asked again so long after: their matched counts change without a graph change ..."""

_ASK_AT_MOST_S = 8.0
"""... a moment after one, so an outside observer asks half as often each time, down to this: it is
not notified that a node hangs or was reconfigured."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class JudgedSystem:
    """What was seen of a running system, and how it was judged.

    Attributes:
        plan: what it was judged against: with the connections that its nodes negotiated.
        observation: what was there.
        verdict: of an active system.
        rmw: name of the RMW implementation it was looked at with.
    """

    plan: Plan
    observation: Observation
    verdict: Verdict
    rmw: str = ""

    @property
    def where(self) -> str:
        """Where it was looked if nothing at all was there, else an empty text."""
        tools = self.plan.policy.tolerated_nodes
        names = (each.full_name for each in self.observation.nodes)
        somebody = any(not tolerating_pattern(each, tools) for each in names)
        return "" if somebody else where(self.plan, self.rmw)


def judge_running(plan: Plan, *, timeout_s: float, strict: bool) -> JudgedSystem:
    """Judge what runs against the plan, as an active system.

    Args:
        plan: what should run.
        timeout_s: seconds, > 0, to wait for a verdict that is ok.
        strict: wait for what is unverifiable too.

    Raises:
        MiddlewareError: no participant can be made.
    """
    with _looking(plan) as observer_participant:
        return asyncio.run(_judge(plan, observer_participant, timeout_s, strict=strict))


async def following(plan: Plan, on_look: Callable[[JudgedSystem], None]) -> None:
    """Look at every change and give what was seen and its verdict, until cancelled.

    What may pass by itself is given a moment to do so, see `GracePeriod`.
    """
    grace_period = GracePeriod()
    last: Verdict | None = None
    clock = asyncio.get_running_loop().time
    pause_s = _ASK_AGAIN_S
    with _looking(plan) as observer_participant:
        while True:
            seen = await _see(plan, observer_participant)
            now, again_s = grace_period.standing(last, seen.verdict, seen.plan, clock())
            if now != last or again_s is not None:
                pause_s = _ASK_AGAIN_S
            last = now
            on_look(dataclasses.replace(seen, verdict=last))
            if await _change(observer_participant, pause_s):
                pause_s = _ASK_AGAIN_S
            else:
                pause_s = min(pause_s * 2, _ASK_AT_MOST_S)


def follow_running(plan: Plan, on_verdict: Callable[[Verdict], None]) -> None:
    """Judge what runs and report each verdict that differs from the last, until interrupted."""
    last: Verdict | None = None

    def take(seen: JudgedSystem) -> None:
        nonlocal last
        if seen.verdict != last:
            last = seen.verdict
            on_verdict(last)

    asyncio.run(following(plan, take))


def where(plan: Plan, rmw: str) -> str:
    """Say where an empty graph was looked at: what usually differs when nodes are not found."""
    return (
        f"no node in the graph; looked in ROS domain {plan.domain_id} with {rmw}, "
        f"discovery range {plan.discovery_range.value}"
    )


def _looking(plan: Plan) -> ObserverParticipant:
    """Observe a plan's domain; also guests, where they are negotiated with."""
    os.environ["ROS_DOMAIN_ID"] = str(plan.domain_id)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = plan.discovery_range.name
    hosts = reached_hosts(plan, own_machines(plan, ""))
    os.environ.update(peers_environment(hosts, os.environ))
    is_open = plan.policy.undeclared_nodes is EndpointPolicy.OPEN
    return ObserverParticipant.open(
        plan.domain_id,
        onlooker_connections(plan, _heard(plan)),
        guests=is_open and is_negotiated(plan),
    )


def _heard(plan: Plan) -> tuple[NodeConfiguration, ...]:
    """Return what the supervisors of the system on this host know of its nodes."""
    root = runtime_root(os.environ)
    wanted = run_name(plan, "")
    found: list[NodeConfiguration] = []
    for name in running(root):
        if name == wanted or name.startswith(f"{wanted}."):
            # One that ends just now, or is too busy to answer, knows nothing that must be known.
            with contextlib.suppress(UsageError, TimeoutError):
                found += look(root / name).observation.configurations
    return tuple(found)


async def _see(plan: Plan, observer_participant: ObserverParticipant) -> JudgedSystem:
    observation = await observer_participant.observe(plan)
    expected = Expectation.of(plan, observation)
    verdict = verify(expected.plan, observation, stage=Stage.ACTIVE)
    return JudgedSystem(
        plan=expected.plan,
        observation=observation,
        verdict=with_findings(verdict, expected.findings),
        rmw=observer_participant.rmw,
    )


async def _judge(
    plan: Plan, observer_participant: ObserverParticipant, timeout_s: float, *, strict: bool
) -> JudgedSystem:
    loop = asyncio.get_running_loop()
    deadline = loop.time() + timeout_s
    while True:
        seen = await _see(plan, observer_participant)
        left_s = deadline - loop.time()
        if left_s <= 0 or not _worth_waiting(seen.verdict, strict=strict):
            return seen
        await _change(observer_participant, min(left_s, _ASK_AGAIN_S))


def _worth_waiting(verdict: Verdict, *, strict: bool) -> bool:
    """Whether another look may change the result: what is not measured stays so."""
    heals = [rule(each.rule).heals is not Heals.NEVER for each in verdict.findings]
    if verdict.verdict is Outcome.UNVERIFIABLE and closes(verdict, strict=strict):
        return all(heals)
    return any(heals)


async def _change(observer_participant: ObserverParticipant, timeout_s: float) -> bool:
    """Wait for a change of the graph; False when it is time to ask the nodes again without one."""
    try:
        await asyncio.wait_for(observer_participant.wait_change(), timeout_s)
    except asyncio.TimeoutError:
        return False
    return True


__all__ = ["JudgedSystem", "follow_running", "following", "judge_running", "where"]
