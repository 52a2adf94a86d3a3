"""Looks at a running system, started by us or by others: verdicts, pictures and captures.

Owns: `judge_running`, which looks from outside, as one more participant, until the verdict is ok or
the time is up; where the observation of a picture comes from and when the next picture is due; and
`capture_running`, which looks at a system of any nodes until nothing new is discovered: when
discovery has settled, and what each node is asked. What is drawn is export's. Must not import rclpy
at module level.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import msgspec
from msgspec.structs import replace

from lifecycle.errors import MiddlewareError, UsageError
from lifecycle.export.captured import CapturedParameter, CapturedSystem, capture
from lifecycle.export.picture import Picture, Supervised, build_picture
from lifecycle.manifest.model import DiscoveryRange, EndpointPolicy
from lifecycle.middleware.fastdds.discovery import peers_environment
from lifecycle.middleware.process.control import check_memory
from lifecycle.middleware.process.process_table import note_ended
from lifecycle.plan.discovery import reached_hosts
from lifecycle.plan.model import Plan
from lifecycle.run_directory import is_held, run_name, run_roots, running, runtime_root
from lifecycle.supervisor.connections.instructions import expected_by_onlooker, is_negotiated
from lifecycle.supervisor.control.protocol import follow, look
from lifecycle.supervisor.control.server import SupervisorSnapshot
from lifecycle.supervisor.core.gate import closes
from lifecycle.supervisor.nodes.liveliness import ANSWER_S, TRIES, not_answering
from lifecycle.supervisor.processes.process import unlimited
from lifecycle.supervisor.run.options import onlooker_connections, own_machines
from lifecycle.supervisor.shell.settling import Passing
from lifecycle.verify.judge import apart_from_numbers, verify, with_findings, with_measured
from lifecycle.verify.observation import NodeConfiguration, Observation, ObservedNode
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import rule
from lifecycle.verify.rules.catalogue import Heals
from lifecycle.verify.rules.measured import PROBATION_S
from lifecycle.verify.tool_filter import tolerating_pattern
from lifecycle.verify.verdict import Stage, Verdict

if TYPE_CHECKING:
    from lifecycle.supervisor.nodes.observer_participant import ObserverParticipant


T = TypeVar("T")

_ASK_AGAIN_S = 0.5
"""Nodes are asked again so long after: their matched counts change without a graph change."""

_EACH_S = 1.0
"""Who follows a system looks at it so often."""


class JudgedSystem(msgspec.Struct, frozen=True, kw_only=True):
    """What was seen of a running system, and how it was judged.

    Attributes:
        plan: what it was judged against: with the connections that its nodes negotiated.
        observation: what was there.
        verdict: of an active system.
        where: where it was looked if nothing at all was there, else empty.
        limits: which installed libraries are not known, and what that costs; empty if all are.
    """

    plan: Plan
    observation: Observation
    verdict: Verdict
    where: str = ""
    limits: str = ""

    @property
    def picture(self) -> Picture:
        """What was seen, drawn."""
        return build_picture(self.plan, self.observation, self.verdict)

    @property
    def notices(self) -> tuple[str, ...]:
        """What has to be known beside the verdict."""
        return tuple(each for each in (self.limits, self.where) if each)


def judge_running(plan: Plan, *, timeout_s: float, strict: bool) -> JudgedSystem:
    """Judge what runs against the plan, as an active system.

    Args:
        plan: what should run.
        timeout_s: seconds, > 0, to wait for a verdict that is ok.
        strict: wait for what is unverifiable too.

    Raises:
        MiddlewareError: no participant can be made.
    """

    async def judge(participant: ObserverParticipant) -> JudgedSystem:
        loop = asyncio.get_running_loop()
        began = loop.time()
        while True:
            observation = await participant.graph.observe(plan)
            # One that is not there may be yet to come.
            seen = _judged(plan, observation, participant, may_be_over=False)
            left_s = began + timeout_s - loop.time()
            if left_s <= 0 or not _worth_waiting(seen.verdict, strict=strict):
                unanswered = await _unanswering(plan, observation, participant)
                return _judged(plan, observation, participant, unanswered=unanswered)
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(participant.graph.wait_change(), min(left_s, _ASK_AGAIN_S))

    return asyncio.run(_with_participant(plan, judge))


def with_supervisors_numbers(seen: JudgedSystem) -> JudgedSystem:
    """Return what was seen with what supervisors on this host measured, who compare clocks."""
    numbers = [str(each) for each in seen.plan.bounds]
    others = (
        each.verdict
        for each in (_supervisors(seen.plan) if numbers else ())
        if each.verdict is not None and [str(one) for one in each.plan.bounds] == numbers
    )
    return replace(seen, verdict=with_measured(seen.verdict, others, seen.plan.policy))


def follow_running(
    plan: Plan, on_change: Callable[[JudgedSystem], None], *, each_s: float | None = None
) -> None:
    """Judge what runs whenever it changes, and give it to `on_change`, until interrupted.

    What may pass by itself is given a moment to do so, see `Passing`.

    Args:
        plan: what should run.
        on_change: takes what was seen.
        each_s: seconds, > 0, after which what is measured is a change; None if it never is.
    """

    async def follow(participant: ObserverParticipant) -> None:
        passing, clock = Passing(), asyncio.get_running_loop().time
        last: JudgedSystem | None = None
        while True:
            seen = _judged(plan, await participant.graph.observe(plan), participant)
            verdict, _ = passing.without(seen.verdict, seen.plan, clock(), stage=Stage.ACTIVE)
            seen = replace(seen, verdict=verdict)
            before, last = last, _apart_from_numbers(seen)
            if last != before or (each_s is not None and verdict.measured):
                on_change(seen)
            await asyncio.sleep(each_s or _EACH_S)

    asyncio.run(_with_participant(plan, follow))


def _apart_from_numbers(seen: JudgedSystem) -> JudgedSystem:
    """Return what was seen without what is another number each time it is measured."""
    configurations = (replace(each, measured=None) for each in seen.observation.configurations)
    observation = replace(
        seen.observation, configurations=tuple(configurations), measured=None, active_s=()
    )
    return replace(seen, observation=observation, verdict=apart_from_numbers(seen.verdict))


def _enter_domain(domain_id: int, discovery_range: DiscoveryRange) -> None:
    """Have participants of this process be made in a domain, if there is room for one."""
    os.environ["ROS_DOMAIN_ID"] = str(domain_id)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = discovery_range.name
    check_memory()


async def _with_participant(plan: Plan, look: Callable[[ObserverParticipant], Awaitable[T]]) -> T:
    with _looking(plan) as participant:
        return await look(participant)


def _looking(plan: Plan) -> ObserverParticipant:
    """Observe a plan's domain; also nodes that are not planned, where they are negotiated with."""
    _enter_domain(plan.domain_id, plan.discovery_range)
    hosts = reached_hosts(plan, own_machines(plan, ""))
    os.environ.update(peers_environment(hosts, os.environ))
    is_open = plan.policy.undeclared_nodes is EndpointPolicy.OPEN
    reported = (one for each in _supervisors(plan) for one in each.observation.configurations)
    from lifecycle.supervisor.nodes.observer_participant import ObserverParticipant

    return ObserverParticipant.open(
        plan.domain_id,
        onlooker_connections(plan, tuple(reported)),
        unplanned=is_open and is_negotiated(plan),
        settle_s=plan.discovery.settle_s,
    )


def _supervisors(plan: Plan) -> Iterator[SupervisorSnapshot]:
    """Yield what the supervisors of the system on this host know."""
    wanted = run_name(plan, "")
    for path in running(*run_roots(os.environ)):
        if path.name == wanted or path.name.startswith(f"{wanted}."):
            # One that ends just now, or is too busy to answer, knows nothing that must be known.
            with contextlib.suppress(UsageError, TimeoutError):
                yield look(path)


def _judged(
    plan: Plan,
    observation: Observation,
    observer_participant: ObserverParticipant,
    *,
    may_be_over: bool = True,
    unanswered: Iterable[str] = (),
) -> JudgedSystem:
    """Judge what was seen; a node that may end by itself, and is not there, may have ended."""
    expected, unconnected = expected_by_onlooker(plan, observation)
    over = {each.full_name: "" for each in expected.nodes if each.may_end and may_be_over}
    verdict = verify(expected, observation, stage=Stage.ACTIVE, over=over)
    own = own_machines(plan, "")
    ours = (each for each in plan.processes if each.machine in own)
    found = (
        *unconnected,
        *unlimited(ours),
        *(not_answering(name, TRIES * ANSWER_S) for name in unanswered),
    )
    return JudgedSystem(
        plan=expected,
        observation=observation,
        verdict=with_findings(verdict, found, expected.policy),
        where=_where(plan, observation, observer_participant.rmw),
        limits=observer_participant.unknown_versions,
    )


def _where(plan: Plan, observation: Observation, rmw: str) -> str:
    """Say where an empty graph was looked at: what usually differs when nodes are not found."""
    tools, names = plan.policy.tolerated_nodes, (each.full_name for each in observation.nodes)
    if any(not tolerating_pattern(each, tools) for each in names):
        return ""
    return (
        f"no node in the graph; looked in ROS domain {plan.domain_id} with {rmw}, "
        f"discovery range {plan.discovery_range.value}"
    )


async def _unanswering(
    plan: Plan, observation: Observation, observer_participant: ObserverParticipant
) -> tuple[str, ...]:
    """Return the declared nodes that are there and answer no request; who reported has answered."""
    there = {each.full_name for each in observation.nodes}
    silent = there - {each.name for each in observation.configurations}
    nodes = tuple(each for each in plan.nodes if each.full_name in silent)
    for _ in range(TRIES):
        answers = await asyncio.gather(
            *(
                observer_participant.clients.answers(
                    each.full_name, managed=each.managed, timeout_s=ANSWER_S
                )
                for each in nodes
            ),
            return_exceptions=True,  # who cannot be asked is in the verdict by other rules
        )
        nodes = tuple(node for node, answer in zip(nodes, answers, strict=True) if answer is False)
    return tuple(each.full_name for each in nodes)


def _worth_waiting(verdict: Verdict, *, strict: bool) -> bool:
    """Whether another look may change the result: what is not measured stays so."""
    if verdict.is_measuring(PROBATION_S):
        return True
    heals = [rule(each.rule).heals is not Heals.NEVER for each in verdict.findings]
    if verdict.verdict is Outcome.UNVERIFIABLE and closes(verdict, strict=strict):
        return all(heals)
    return any(heals)


def supervisor_of(environment: Mapping[str, str], plan: Plan, machine: str) -> Path | None:
    """Return the run directory of the supervisor of a plan on this host; None without one."""
    path = runtime_root(environment) / run_name(plan, machine)
    return path if is_held(path) else None


def supervised_pictures(path: Path) -> Iterator[Picture]:
    """Yield what a supervisor sees, again whenever it differs, until the supervisor ends."""
    last: Picture | None = None
    for seen in follow(path):
        picture = picture_of(seen)
        if picture != last:
            last = picture
            yield picture


def picture_of(seen: SupervisorSnapshot) -> Picture:
    """Return what a supervisor sees; before its first verdict the plan, and what nodes do."""
    supervised = {
        each.node: Supervised(
            pid=each.pid,
            dead=bool(each.died),
            silent=bool(each.silent),
            doing=each.doing or each.silent,
        )
        for each in seen.status.nodes
    }
    return build_picture(
        seen.plan, seen.observation, seen.verdict, phase=seen.status.phase, supervised=supervised
    )


_logger = logging.getLogger(__name__)
_ASK_S = 2.0
"""A node that answers at all answers within milliseconds."""


def capture_running(
    *,
    system: str,
    domain_id: int,
    discovery_range: DiscoveryRange,
    wait_s: float,
    attach: bool,
) -> CapturedSystem:
    """Return what runs in a domain now.

    Args:
        system: name to give it.
        domain_id: 0–232.
        discovery_range: how far to look.
        wait_s: seconds, > 0, that discovery may take to settle.
        attach: do not look how the processes of this host were started.

    Raises:
        MiddlewareError: no participant can be made.
    """
    from lifecycle.graph.graph import Graph
    from lifecycle.supervisor.nodes.observer_participant import settled

    environment = dict(os.environ)
    _enter_domain(domain_id, discovery_range)

    async def look() -> CapturedSystem:
        with Graph.in_loop(domain_id) as graph:
            (nodes, endpoints), unsettled = await settled(graph.discovery, wait_s)
            # Before anything is asked: a program may end meanwhile.
            programs = {} if attach else graph.discovery.programs(environment)
            clients = graph.clients
            said: dict[str, tuple[str | None, NodeConfiguration | None]] = {}
            parameters: dict[str, tuple[CapturedParameter, ...] | None] = {}

            async def ask(node: ObservedNode) -> None:
                name = node.full_name
                serves = graph.discovery.offers(name, f"{name}/list_parameters")
                state, configuration, found = await asyncio.gather(
                    _or_none(clients.get_state(name, timeout_s=_ASK_S) if node.managed else None),
                    _or_none(clients.get_configuration(name, timeout_s=_ASK_S)),
                    _or_none(clients.get_parameters(name, timeout_s=_ASK_S) if serves else None),
                )
                said[name] = state, configuration
                if serves:
                    parameters[name] = found

            await asyncio.gather(*map(ask, nodes))
            return capture(
                graph.state.observation(nodes, endpoints, said),
                parameters,
                system=system,
                domain_id=domain_id,
                discovery_range=discovery_range,
                unsettled=unsettled,
                programs=note_ended(programs),
            )

    return asyncio.run(look())


async def _or_none(asked: Awaitable[T] | None) -> T | None:
    """Return an answer; None where nothing is asked or answered, which becomes a gap."""
    try:
        return None if asked is None else await asked
    except MiddlewareError as error:
        _logger.info("not told: %s", error)
        return None
