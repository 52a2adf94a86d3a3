"""Judging: when to look again, how long to wait, and when waiting is pointless."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, Policy
from lifecycle.node.host.control import Event
from lifecycle.plan.model import Plan
from lifecycle.supervisor.control.protocol import ProcessState, Reach
from lifecycle.supervisor.gate.hold import Watch
from lifecycle.supervisor.gate.verification_loop import (
    HEALTH_S,
    PASSING_S,
    ChangeCounter,
    VerificationLoop,
    without,
)
from lifecycle.supervisor.gate.violations import LASTS_S
from lifecycle.supervisor.health.liveliness import Cause
from lifecycle.supervisor.health.process_monitor import first_death
from lifecycle.supervisor.nodes.driver import NodeCondition
from lifecycle.supervisor.nodes.system import RemoteNode, System
from lifecycle.supervisor.processes.process import ManagedProcess, ProcessExit
from lifecycle.supervisor.run.events import NodeJoined, VerdictChanged
from lifecycle.verify.judge import with_findings
from lifecycle.verify.observation import (
    NodeConfiguration,
    NodeParameters,
    Observation,
    ObservedEndpoint,
    ObservedNode,
)
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Finding, Stage, Verdict
from tests.builders import plan_of, planned_node
from tests.unit.supervisor.fakes import FakeGraph, World, interface_of, verdict_of
from tests.unit.supervisor.test_supervisor_negotiation import plan_of as negotiated_plan

OK = verdict_of(Outcome.OK)
MISSING = verdict_of(Outcome.VIOLATED, "graph.missing-node")
UNDECLARED = verdict_of(Outcome.VIOLATED, "graph.undeclared-publisher")
UNMATCHED = verdict_of(Outcome.VIOLATED, "graph.unmatched-link")
UNATTRIBUTED = verdict_of(Outcome.UNVERIFIABLE, "graph.unattributed-endpoint")
UNPROVEN = verdict_of(Outcome.VIOLATED, "flow.unverifiable")
UNMEASURED = verdict_of(Outcome.UNVERIFIABLE, "flow.not-measured", blocking=True)
UNKNOWN = verdict_of(Outcome.UNVERIFIABLE, "state.unverifiable", blocking=True)


class _AskedGraph(FakeGraph):
    """Remembers the plan that it was asked for last."""

    asked: Plan | None = None

    async def observe(self, plan: Plan) -> Observation:
        self.asked = plan
        return await super().observe(plan)


class _Bench:
    """A judge over a graph whose verdicts are given: one for each number of nodes seen."""

    def __init__(self, tmp_path: Path, *verdicts: Verdict, **options: Any) -> None:
        self.world = World(plan_of(planned_node("camera")), tmp_path)
        self.graph = _AskedGraph()
        self.verdicts = verdicts
        self.looks: list[float] = []
        self.judged: list[dict[str, object]] = []
        self.changes = ChangeCounter(self.world.system, self.graph)
        self.judge = VerificationLoop(
            self.world.system,
            self.graph,
            self.changes,
            self.world.emit,
            verify_=self._verify,
            **{"strict": False, **options},
        )

    def _verify(
        self,
        plan: object,
        observation: Observation,
        *,
        stage: Stage,
        machines: frozenset[str] | None = None,
        ahead: frozenset[str] = frozenset(),
        over: object = None,
    ) -> Verdict:
        self.looks.append(self.now)
        self.judged.append(
            {
                "plan": plan,
                "observation": observation,
                "stage": stage,
                "machines": machines,
                "ahead": ahead,
            }
        )
        return self.verdicts[min(len(observation.nodes), len(self.verdicts) - 1)]

    @property
    def now(self) -> float:
        return asyncio.get_running_loop().time()

    def grow(self) -> None:
        nodes = self.graph.observation.nodes
        added = ObservedNode(full_name=f"/node_{len(nodes)}")
        self.graph.observation = Observation(nodes=(*nodes, added))
        self.graph.changed.set()

    def match(self) -> None:
        self.verdicts = (OK,)

    def later(self, delay_s: float, what: Callable[[], object]) -> None:
        asyncio.get_running_loop().call_later(delay_s, what)

    async def hold(self, seconds: float) -> None:
        """Watch the active system for so long."""
        watching = asyncio.ensure_future(Watch(self.judge, self.changes, Stage.ACTIVE).run())
        await asyncio.sleep(seconds)
        watching.cancel()

    def told(self) -> list[Verdict]:
        return [event.verdict for event in self.world.heard(VerdictChanged)]


@contextlib.asynccontextmanager
async def judging(tmp_path: Path, *of: Verdict, **options: Any) -> AsyncIterator[_Bench]:
    bench = _Bench(tmp_path, *of, **options)
    try:
        yield bench
    finally:
        await bench.changes.close()


def _both(one: Verdict, other: Verdict) -> Verdict:
    return replace(one, findings=(*one.findings, *other.findings))


@pytest.mark.parametrize(
    ("verdict", "options", "waits_s", "looks"),
    [
        pytest.param(OK, {}, 0.0, 1, id="nothing is wrong"),
        pytest.param(MISSING, {}, 30.0, 2, id="what may come, for all the time"),
        pytest.param(UNDECLARED, {}, 0.5, None, id="what time does not heal"),
        pytest.param(UNPROVEN, {}, 3.5, None, id="what only a report could prove"),
        pytest.param(UNMEASURED, {}, 0.5, None, id="what was never measured"),
        pytest.param(UNKNOWN, {}, 3.5, None, id="what may be unseen for one discovery period"),
        pytest.param(verdict_of(Outcome.VIOLATED), {}, 3.5, None, id="no finding is to blame"),
        pytest.param(UNATTRIBUTED, {}, 0.0, None, id="unverifiable and allowed"),
        pytest.param(UNATTRIBUTED, {"strict": True}, 3.5, None, id="unverifiable and strict"),
        pytest.param(_both(UNPROVEN, MISSING), {}, 30.0, None, id="a violation beside a report"),
        pytest.param(_both(UNKNOWN, UNMEASURED), {}, 0.5, None, id="one that does not heal"),
        pytest.param(_both(UNPROVEN, UNMEASURED), {}, 3.5, None, id="a report beside it"),
    ],
)
async def test_how_long_a_verdict_is_waited_out(
    tmp_path: Path, verdict: Verdict, options: dict[str, Any], waits_s: float, looks: int | None
) -> None:
    async with judging(tmp_path, verdict, **options) as bench:
        assert await bench.judge.until_clear(Stage.CONNECTED, 30.0) == verdict
        assert bench.now == pytest.approx(waits_s, abs=0.1 if waits_s > 1 else 0.05)
        assert looks in (None, len(bench.looks))


async def test_a_node_that_must_be_healthy_is_given_time_to_say_how_it_is_once(
    tmp_path: Path,
) -> None:
    unsaid = verdict_of(Outcome.UNVERIFIABLE, "node.unhealthy")
    async with judging(tmp_path, unsaid, OK) as bench:
        bench.later(1.0, bench.grow)
        assert await bench.judge.until_clear(Stage.CONNECTED, 20.0) is OK
        assert bench.now == pytest.approx(1.0, abs=0.1)
    async with judging(tmp_path, unsaid) as bench:
        began = bench.now
        for _ in range(2):
            assert await bench.judge.until_clear(Stage.CONNECTED, 20.0) is unsaid
            assert bench.now - began == pytest.approx(HEALTH_S)


async def test_it_stands_although_the_graph_goes_on_changing(tmp_path: Path) -> None:
    async with judging(tmp_path, UNDECLARED) as bench:

        async def noise() -> None:
            while True:
                await asyncio.sleep(0.1)
                bench.graph.changed.set()

        noisy = asyncio.ensure_future(noise())
        assert await bench.judge.until_clear(Stage.CONNECTED, 30.0) == UNDECLARED
        noisy.cancel()
        assert bench.now < 0.8


async def test_an_unmatched_pair_is_asked_again_because_its_match_changes_no_graph(
    tmp_path: Path,
) -> None:
    async with judging(tmp_path, UNMATCHED) as bench:
        bench.later(0.1, bench.match)
        assert await bench.judge.until_clear(Stage.CONNECTED, 30.0) == OK
        assert bench.now < 0.3
        assert len(bench.looks) <= 5


async def test_a_node_that_tells_of_its_matches_is_not_asked_for_them(tmp_path: Path) -> None:
    finding = replace(UNMATCHED.findings[0], ends=("/camera", "/viewer"))
    unmatched = replace(UNMATCHED, findings=(finding,))
    async with judging(tmp_path, unmatched) as bench:
        bench.world.system.nodes["camera"].reports_changes = True

        def match() -> None:
            bench.verdicts = (OK,)
            event = Event(kind="configuration", node="/camera", configuration=None)
            bench.world.system.on_host_event(event)

        bench.later(5.0, match)
        assert await bench.judge.until_clear(Stage.CONNECTED, 30.0) == OK
        assert bench.now < 5.1
        assert len(bench.looks) == 2  # the first, and the one after it told


async def test_a_reply_does_not_undo_what_was_told_after_it(tmp_path: Path) -> None:
    def of(*, matched: bool) -> NodeConfiguration:
        told = interface_of("/camera", "service_clients/ask")
        (end,) = told.endpoints
        end = replace(end, server_matched=matched)
        return replace(told, endpoints=(end,))

    async with judging(tmp_path, OK) as bench:
        system = bench.world.system
        node = system.nodes["camera"]
        before, after = of(matched=False), of(matched=True)
        reply = Event(kind="reply", node="/camera", state="inactive", configuration=before)
        system.on_host_event(reply)
        assert node.configuration == before
        system.on_host_event(replace(reply, kind="configuration", configuration=after))
        # Who awaited the reply goes on only now.
        node.advance(Reach.CONNECTED, NodeCondition(state="inactive", configuration=before))
        assert node.configuration is not None
        assert node.configuration.endpoints == after.endpoints


async def test_a_reply_in_the_place_of_a_report_has_the_system_judged_again(tmp_path: Path) -> None:
    async with judging(tmp_path, OK) as bench:
        system = bench.world.system
        node = system.nodes["camera"]
        node.reports_changes = False
        await asyncio.sleep(0)
        system.touched.clear()
        told = interface_of("/camera", "service_clients/ask")
        reply = Event(kind="reply", node="/camera", state="inactive", configuration=told)
        system.on_host_event(reply)
        assert (node.reports_changes, system.touched.is_set()) == (False, False)
        system.on_host_event(replace(reply, reports=True))
        assert (node.reports_changes, system.touched.is_set()) == (True, True)


@pytest.mark.parametrize(("client", "server"), [("/viewer", "/camera"), ("/camera", "/viewer")])
async def test_of_a_server_that_is_matched_only_its_client_tells(
    tmp_path: Path, client: str, server: str
) -> None:
    finding = replace(
        UNMATCHED.findings[0],
        rule="graph.unmatched-client",
        subject=f"/calibrate: {client} → {server}",
        node=client,
    )
    async with judging(tmp_path, replace(UNMATCHED, findings=(finding,))) as bench:
        bench.world.system.nodes["camera"].reports_changes = True

        def tell() -> None:
            event = Event(kind="configuration", node="/camera", configuration=None)
            bench.world.system.on_host_event(event)

        bench.later(0.1, bench.match)
        bench.later(5.0, tell)
        assert await bench.judge.until_clear(Stage.CONNECTED, 30.0) == OK
        told = client == "/camera"
        assert (bench.now > 4.9, len(bench.looks) == 2) == (told, told)


async def test_a_burst_of_changes_is_one_look(tmp_path: Path) -> None:
    async with judging(tmp_path, MISSING) as bench:
        for index in range(10):
            bench.later(1.0 + index / 1000, bench.grow)
        await bench.judge.until_clear(Stage.CONNECTED, 2.0)
        assert len(bench.looks) == 3


def test_a_dead_node_is_gone_although_discovery_shows_it_for_the_whole_lease() -> None:
    def of(name: str, count: int = 1) -> ObservedNode:
        return ObservedNode(full_name=name, count=count)

    endpoint = ObservedEndpoint(
        kind=EndpointKind.PUBLISHER, node="/dead", name="/topic", type="std_msgs/msg/String"
    )
    kept = replace(endpoint, node="/twice")
    parameter = NodeParameters(node="/dead")
    seen = Observation(
        nodes=(of("/dead"), of("/other"), of("/twice", 2)),
        endpoints=(endpoint, kept),
        configurations=(interface_of("/dead"), interface_of("/other")),
        parameters=(parameter, replace(parameter, node="/twice")),
    )
    assert without(seen, frozenset({"/dead", "/twice"})) == Observation(
        nodes=(of("/other"), of("/twice")),
        endpoints=(kept,),
        configurations=(interface_of("/other"),),
        parameters=(replace(parameter, node="/twice"),),
    )
    assert without(seen, frozenset()) is seen


async def test_nodes_that_are_silent_are_not_asked_for_and_judged_silent(tmp_path: Path) -> None:
    async with judging(tmp_path, OK) as bench:
        system = bench.world.system
        await bench.judge.once(Stage.CONNECTED)
        assert bench.graph.asked is system.plan
        system.liveliness.fell_silent(("/camera",), Cause.HUNG, "a callback has been running")
        verdict = await bench.judge.once(Stage.CONNECTED)
        assert bench.graph.asked == replace(system.plan, nodes=())
        assert bench.judged[-1]["plan"] is system.expected
        assert (verdict.verdict, verdict.blocking) == (Outcome.VIOLATED, True)
        assert verdict.findings == system.liveliness.findings()


class _Looker:
    """Notes what it sees, and finds one thing wrong."""

    def __init__(self) -> None:
        self.seen: list[Observation] = []
        self.wrong = verdict_of(Outcome.VIOLATED, "connection.missing").findings

    def look(self, observation: Observation) -> None:
        self.seen.append(observation)

    def findings(self) -> tuple[Finding, ...]:
        return self.wrong if self.seen else ()


class _Agreement:
    """Explains every finding, and finds one thing unverifiable in what was seen."""

    def __init__(self) -> None:
        self.seen: list[Observation] = []
        self.unknown = verdict_of(Outcome.UNVERIFIABLE, "run.plan-unknown").findings

    def explained(self, verdict: Verdict) -> Verdict:
        return replace(
            verdict,
            findings=tuple(replace(each, observed="explained") for each in verdict.findings),
        )

    def findings(self, observation: Observation) -> tuple[Finding, ...]:
        self.seen.append(observation)
        return self.unknown


async def test_what_is_seen_is_judged_against_what_is_expected_with_what_others_find(
    tmp_path: Path,
) -> None:
    looker, guard, agreement = _Looker(), _Looker(), _Agreement()
    guard.wrong = verdict_of(Outcome.VIOLATED, "state.activated-at-closed-gate").findings
    async with judging(
        tmp_path, UNATTRIBUTED, looker=looker, agreement=agreement, guard=guard
    ) as bench:
        system, judge = bench.world.system, bench.judge
        assert (judge.latest, judge.seen, judge.ahead) == (None, Observation(), frozenset())
        system.expected = plan_of(planned_node("camera"), planned_node("negotiated"))
        system.machines = frozenset({"left"})
        judge.ahead = frozenset({"/first"})
        seen = Observation(nodes=(ObservedNode(full_name="/camera"),))
        bench.graph.observation = seen
        verdict = await judge.once(Stage.CONNECTED)
        assert bench.judged == [
            {
                "plan": system.expected,
                "observation": seen,
                "stage": Stage.CONNECTED,
                "machines": frozenset({"left"}),
                "ahead": frozenset({"/first"}),
            }
        ]
        assert looker.seen == guard.seen == agreement.seen == [judge.seen] == [seen]
        assert system.present == frozenset({"/camera"})
        assert [each.node for each in bench.world.heard(NodeJoined)] == ["/camera"]
        told = tuple(
            replace(each, observed="explained")
            for each in (*guard.wrong, *looker.wrong, *UNATTRIBUTED.findings)
        )
        assert verdict == Verdict(
            verdict=Outcome.VIOLATED, blocking=True, findings=(*agreement.unknown, *told), flows=()
        )
        assert judge.latest == verdict
        (changed,) = bench.world.heard(VerdictChanged)
        assert (changed.stage, changed.verdict) == (Stage.CONNECTED, verdict)


def test_what_the_supervisor_finds_comes_first_and_makes_a_verdict_worse_never_better() -> None:
    for outcome, blocking in ((Outcome.VIOLATED, True), (Outcome.UNVERIFIABLE, False)):
        (finding,) = verdict_of(outcome, "run.plan-unknown").findings
        assert with_findings(UNATTRIBUTED, (finding,), Policy()) == replace(
            UNATTRIBUTED,
            verdict=outcome,
            blocking=blocking,
            findings=(finding, *UNATTRIBUTED.findings),
        )
        assert with_findings(MISSING, (finding,), Policy()).verdict is Outcome.VIOLATED
        assert with_findings(MISSING, (finding,), Policy()).blocking
    assert with_findings(MISSING, (), Policy()) is MISSING


def test_the_policy_holds_for_what_the_supervisor_finds_too() -> None:
    (finding,) = verdict_of(Outcome.UNVERIFIABLE, "run.not-answering").findings
    blocked = with_findings(OK, (finding,), Policy(unverifiable_blocks=True))
    assert (blocked.verdict, blocked.blocking) == (Outcome.UNVERIFIABLE, True)
    trusts = Policy(unverifiable_blocks=True, trust=(finding.rule,))
    trusted = with_findings(OK, (finding,), trusts)
    assert (trusted.verdict, trusted.blocking, trusted.findings) == (Outcome.OK, False, (finding,))


async def test_of_a_process_that_ended_the_nodes_are_left_out_and_of_the_server_it_is_told(
    tmp_path: Path,
) -> None:
    async with judging(tmp_path, OK) as bench:
        system = bench.world.system
        bench.graph.observation = Observation(
            nodes=tuple(ObservedNode(full_name=each) for each in ("/camera", "/viewer"))
        )
        await bench.judge.once(Stage.ACTIVE)
        assert system.present == frozenset({"/camera", "/viewer"})
        _end(system.processes["camera"])
        await bench.judge.once(Stage.ACTIVE)
        assert bench.judge.seen == Observation(nodes=(ObservedNode(full_name="/viewer"),))
        assert system.present == frozenset({"/viewer"})
        system.server = system.make_process(
            replace(system.plan.processes[0], name="discovery_server", nodes=())
        )
        _end(system.server)
        verdict = await bench.judge.once(Stage.ACTIVE)
        assert [(each.rule, each.subject) for each in verdict.findings] == [
            ("run.process-died", "discovery_server")
        ]


def _end(process: ManagedProcess, state: ProcessState = ProcessState.EXITED) -> None:
    process.state = state
    process.ended.set_result(ProcessExit(signal=11))


async def test_the_configurations_of_nodes_are_read_before_each_look(tmp_path: Path) -> None:
    async with judging(tmp_path, OK) as bench:
        node = bench.world.system.nodes["camera"]
        node.driver = object()  # type: ignore[assignment]
        node.reports_changes = True
        node.reach = Reach.CONNECTED
        node.configuration = interface_of("/camera")
        await bench.judge.once(Stage.CONNECTED)
        assert bench.graph.put == [interface_of("/camera")]


async def test_what_is_held_is_judged_at_its_stage_against_what_is_expected(tmp_path: Path) -> None:
    async with judging(tmp_path, OK) as bench:
        chatter = ("/chatter", "/camera")
        bench.verdicts = (OK, _missing_endpoint(*chatter))
        system = bench.world.system
        assert await bench.judge.settled(Stage.ACTIVE) == (OK, None)
        system.expected = _with_publisher(system.plan, chatter[0])
        bench.grow()
        # It is expected only since a moment ago.
        assert await bench.judge.settled(Stage.ACTIVE) == (OK, PASSING_S)
        await asyncio.sleep(PASSING_S + 0.01)
        assert await bench.judge.settled(Stage.ACTIVE) == (bench.verdicts[1], None)
        assert [each["stage"] for each in bench.judged] == [Stage.ACTIVE] * 3
        assert {each.stage for each in bench.world.heard(VerdictChanged)} == {Stage.ACTIVE}


def _with_publisher(plan: Plan, topic: str) -> Plan:
    node = replace(plan.nodes[0], endpoints=negotiated_plan().nodes[0].endpoints[:1])
    (end,) = node.endpoints
    end = replace(end, kind=EndpointKind.PUBLISHER, resolved=topic)
    return replace(plan, nodes=(replace(node, endpoints=(end,)),))


def _missing_endpoint(topic: str, node: str) -> Verdict:
    (finding,) = verdict_of(Outcome.VIOLATED, "graph.missing-endpoint").findings
    finding = replace(finding, subject=topic, node=node, endpoint=EndpointKind.PUBLISHER)
    return replace(MISSING, findings=(finding,))


async def test_changes_are_counted_and_waited_for_within_a_time(tmp_path: Path) -> None:
    async with judging(tmp_path, OK) as bench:
        loop = asyncio.get_running_loop()
        assert bench.changes.count == 0
        assert not await bench.changes.beyond(0, 2.0)
        assert bench.now == pytest.approx(2.0)
        loop.call_later(1.0, bench.graph.changed.set)
        loop.call_later(2.0, bench.world.system.touched.set)
        assert await bench.changes.beyond(0, None)
        assert (bench.changes.count, bench.now) == (1, pytest.approx(3.0))
        assert await bench.changes.beyond(0, 0.0)
        assert await bench.changes.beyond(1, 2.0)
        assert (bench.changes.count, bench.now) == (2, pytest.approx(4.0))


async def test_a_verdict_is_current_until_something_is_noticed_after_its_look_began(
    tmp_path: Path,
) -> None:
    async with judging(tmp_path, OK) as bench:
        judge = bench.judge
        assert not judge.is_current(OK)
        verdict = await judge.once(Stage.CONNECTED)
        assert judge.is_current(verdict)
        assert not judge.is_current(replace(verdict))
        for notice in 2 * (bench.graph.changed.set, bench.world.system.touched.set):
            notice()
            noticed = bench.changes.mark
            assert not judge.is_current(verdict)
            await asyncio.sleep(1.0)
            assert bench.changes.mark == noticed
            assert not judge.is_current(verdict)
            await judge.once(Stage.CONNECTED)
            assert judge.is_current(verdict)

        async def observe(plan: Plan) -> Observation:
            bench.graph.changed.set()
            return Observation()

        bench.graph.observe = observe  # type: ignore[method-assign]
        await judge.once(Stage.CONNECTED)
        assert not judge.is_current(verdict)


@pytest.mark.parametrize(("left_s", "judged_s"), [(None, 5.0), (12.0, 12.0), (0.5, 2.0)])
async def test_behind_an_open_gate_it_is_judged_in_time_who_was_let_through_being_ahead(
    tmp_path: Path, left_s: float | None, judged_s: float
) -> None:
    async with judging(tmp_path, MISSING) as bench:
        bench.judge.ahead = frozenset({"/radar"})
        deadline = None if left_s is None else bench.now + left_s
        found = await bench.judge.again(frozenset({"/camera"}), deadline)
        assert found is bench.judge.latest
        assert found == MISSING
        assert bench.now == pytest.approx(judged_s, abs=0.1)
        assert {each["stage"] for each in bench.judged} == {Stage.CONNECTED}
        assert {each["ahead"] for each in bench.judged} == {frozenset({"/radar", "/camera"})}


async def test_an_observer_that_fails_fails_whoever_waits_for_a_change(tmp_path: Path) -> None:
    async with judging(tmp_path, OK) as bench:

        async def fail() -> None:
            raise RuntimeError("the observer failed")

        bench.graph.wait_change = fail  # type: ignore[method-assign]
        await bench.changes.close()
        changes = ChangeCounter(bench.world.system, bench.graph)
        with pytest.raises(RuntimeError, match="the observer failed"):
            await changes.beyond(0, 1.0) or await changes.beyond(0, 1.0)
        await changes.close()


async def test_after_the_end_of_listening_nothing_is_a_change(tmp_path: Path) -> None:
    async with judging(tmp_path, OK) as bench:
        await bench.changes.close()
        bench.graph.changed.set()
        bench.world.system.touched.set()
        await asyncio.sleep(1.0)
        assert bench.changes.count == 0


async def test_findings_that_could_heal_are_given_up_once_unchanged_for_so_long_as_is_asked(
    tmp_path: Path,
) -> None:
    async with judging(tmp_path, MISSING) as bench:
        # A change of the graph that changes no finding, and one that does.
        bench.verdicts = (MISSING, MISSING, UNMATCHED)
        for delay_s in (2.0, 4.0):
            bench.later(delay_s, bench.grow)
        assert await bench.judge.until_clear(Stage.CONNECTED, 30.0, unchanged_s=5.0) == UNMATCHED
        assert bench.now == pytest.approx(9.0, abs=0.1)
        bench.verdicts = (MISSING,)
        assert await bench.judge.until_clear(Stage.CONNECTED, 3.0, unchanged_s=5.0) == MISSING
        assert bench.now == pytest.approx(12.0, abs=0.1)


async def test_what_time_does_not_heal_is_not_waited_for_longer_because_more_time_was_asked(
    tmp_path: Path,
) -> None:
    async with judging(tmp_path, UNDECLARED) as bench:
        await bench.judge.until_clear(Stage.CONNECTED, 30.0, unchanged_s=5.0)
        assert bench.now == pytest.approx(0.5, abs=0.05)


async def test_what_healed_and_broke_again_has_its_time_anew(tmp_path: Path) -> None:
    async with judging(tmp_path, UNKNOWN) as bench:
        bench.verdicts = (UNKNOWN, MISSING, UNKNOWN)
        for delay_s in (2.0, 3.0):
            bench.later(delay_s, bench.grow)
        assert await bench.judge.until_clear(Stage.CONNECTED, 30.0) == UNKNOWN
        assert bench.now == pytest.approx(6.5, abs=0.1)


async def test_nodes_are_asked_for_a_match_at_growing_intervals_up_to_half_a_second(
    tmp_path: Path,
) -> None:
    async with judging(tmp_path, UNMATCHED) as bench:
        await bench.judge.until_clear(Stage.CONNECTED, 3.0)
        assert bench.looks == pytest.approx(
            [0.0, 0.02, 0.06, 0.14, 0.3, 0.62, 1.12, 1.62, 2.12, 2.62, 3.0]
        )
        assert {each["stage"] for each in bench.judged} == {Stage.CONNECTED}


async def test_while_held_a_match_with_a_node_of_another_machine_is_asked_for_until_it_is_there(
    tmp_path: Path,
) -> None:
    finding = replace(UNMATCHED.findings[0], ends=("/camera", "/viewer"))
    unmatched = replace(UNMATCHED, findings=(finding,))
    async with judging(tmp_path, unmatched) as bench:
        bench.world.system.remote = {"viewer": RemoteNode(planned_node("viewer"))}
        bench.world.system.nodes["camera"].reports_changes = True
        bench.later(5.0, bench.match)
        watching = asyncio.ensure_future(Watch(bench.judge, bench.changes, Stage.ACTIVE).run())
        await asyncio.sleep(5.6)
        assert bench.judge.latest == OK
        looks = len(bench.looks)
        await asyncio.sleep(60.0)
        assert len(bench.looks) == looks
        watching.cancel()


async def test_a_match_that_is_only_unverifiable_is_not_asked_for(tmp_path: Path) -> None:
    async with judging(
        tmp_path, verdict_of(Outcome.UNVERIFIABLE, "graph.unmatched-link", blocking=True)
    ) as bench:
        await bench.judge.until_clear(Stage.CONNECTED, 3.0)
        assert bench.looks == pytest.approx([0.0, 3.0])


@pytest.mark.parametrize("rule", ["state.wrong-state", "config.missing-report"])
@pytest.mark.parametrize(("node", "asked"), [("/viewer", True), ("/camera", False)])
async def test_a_node_of_another_supervisor_that_has_a_step_to_go_is_asked_again(
    tmp_path: Path, rule: str, node: str, asked: bool
) -> None:
    (finding,) = verdict_of(Outcome.VIOLATED, rule).findings
    late = replace(MISSING, findings=(replace(finding, node=node),))
    async with judging(tmp_path, late) as bench:
        bench.world.system.remote = {"viewer": RemoteNode(planned_node("viewer"))}
        await bench.judge.until_clear(Stage.CONNECTED, 1.0)
        assert (len(bench.looks) > 2) is asked


async def test_a_node_of_another_supervisor_that_is_missing_announces_itself(
    tmp_path: Path,
) -> None:
    (finding,) = MISSING.findings
    missing = replace(MISSING, findings=(replace(finding, node="/viewer"),))
    async with judging(tmp_path, missing) as bench:
        bench.world.system.remote = {"viewer": RemoteNode(planned_node("viewer"))}
        await bench.judge.until_clear(Stage.CONNECTED, 1.0)
        assert len(bench.looks) == 2


async def test_a_burst_that_does_not_end_is_looked_at_every_50_ms(tmp_path: Path) -> None:
    async with judging(tmp_path, MISSING) as bench:

        async def burst() -> None:
            while True:
                await asyncio.sleep(0.003)
                bench.graph.changed.set()

        bursting = asyncio.ensure_future(burst())
        await bench.judge.until_clear(Stage.CONNECTED, 0.5)
        bursting.cancel()
        gaps = [later - one for one, later in zip(bench.looks, bench.looks[1:], strict=False)]
        assert all(0.05 <= each <= 0.062 for each in gaps[:-1])


def _system(tmp_path: Path) -> System:
    system = World(plan_of(planned_node("camera"), planned_node("viewer")), tmp_path).system
    system.server = system.make_process(
        replace(system.plan.processes[0], name="discovery_server", nodes=())
    )
    return system


async def test_the_first_process_that_ends_is_told_and_each_only_once(tmp_path: Path) -> None:
    system = _system(tmp_path)
    assert system.server is not None
    camera, viewer = system.processes["camera"], system.processes["viewer"]
    known: set[str] = set()
    for process in (viewer, system.server, camera):
        death = asyncio.ensure_future(first_death(system, known))
        await asyncio.sleep(1.0)
        assert not death.done()
        _end(process)
        assert await asyncio.wait_for(death, 1.0) is process
        assert process.name in known
    # All have ended: there is nothing to wait for but the end of the waiting.
    death = asyncio.ensure_future(first_death(system, known))
    await asyncio.sleep(60.0)
    assert not death.done()
    death.cancel()


async def test_a_process_that_is_started_again_did_not_die(tmp_path: Path) -> None:
    system = _system(tmp_path)
    system.server = None
    death = asyncio.ensure_future(first_death(system, set()))
    _end(system.processes["camera"], ProcessState.BACKOFF)
    await asyncio.sleep(1.0)
    assert not death.done()
    _end(system.processes["viewer"])
    assert await asyncio.wait_for(death, 1.0) is system.processes["viewer"]


async def test_while_held_a_passing_violation_is_told_but_does_not_count(tmp_path: Path) -> None:
    async with judging(tmp_path, OK, UNDECLARED, OK) as bench:
        for delay_s in (1.0, 1.0 + 0.9 * LASTS_S):
            bench.later(delay_s, bench.grow)
        await bench.hold(5.0)
        assert bench.told() == [OK, UNDECLARED, OK]
        assert not bench.judge.violations.counted
        assert bench.judge.violations.passed().endswith(
            "not counted: /camera (graph.undeclared-publisher)"
        )


async def test_while_held_a_violation_that_stands_counts_and_nothing_is_polled(
    tmp_path: Path,
) -> None:
    async with judging(tmp_path, OK, UNDECLARED) as bench:
        bench.later(1.0, bench.grow)
        await bench.hold(60.0)
        assert bench.judge.violations.counted == "wrong: /camera (graph.undeclared-publisher)"
        assert not bench.judge.violations.passed()
        # At the start, at the change, once it has lasted; and then nothing is polled.
        assert len(bench.looks) == 3
        assert {each["stage"] for each in bench.judged} == {Stage.ACTIVE}
        assert {each.stage for each in bench.world.heard(VerdictChanged)} == {Stage.ACTIVE}


async def test_while_held_a_violation_counts_however_busy_the_graph_is(tmp_path: Path) -> None:
    async with judging(tmp_path, OK, *[UNDECLARED] * 15, OK) as bench:
        for tenth in range(10, 40):
            bench.later(tenth / 10, bench.grow)
        await bench.hold(5.0)
        assert bench.judge.violations.counted == "wrong: /camera (graph.undeclared-publisher)"


async def test_while_held_violations_that_relieve_each_other_do_not_count(tmp_path: Path) -> None:
    async with judging(tmp_path, OK, UNDECLARED, UNMATCHED, MISSING, OK) as bench:
        for times in range(4):
            bench.later(1.0 + 0.8 * times, bench.grow)
        await bench.hold(6.0)
        assert not bench.judge.violations.counted
        assert "(graph.undeclared-publisher), " in bench.judge.violations.passed()


async def test_while_held_a_newcomer_that_is_not_known_by_name_yet_is_not_told(
    tmp_path: Path,
) -> None:
    async with judging(tmp_path, OK, UNATTRIBUTED, OK) as bench:
        for delay_s in (1.0, 1.0 + 0.9 * PASSING_S):
            bench.later(delay_s, bench.grow)
        await bench.hold(60.0)
        assert bench.told() == [OK]


async def test_while_held_a_newcomer_that_stays_unknown_is_told_after_a_bounded_time(
    tmp_path: Path,
) -> None:
    async with judging(tmp_path, OK, UNATTRIBUTED) as bench:
        bench.later(1.0, bench.grow)
        await bench.hold(60.0)
        assert bench.told() == [OK, UNATTRIBUTED]
        # At the start, at the change, once its time is over; and then nothing is polled.
        assert bench.looks == pytest.approx([0.0, 1.0, 1.0 + PASSING_S], abs=0.1)


async def test_before_the_gate_a_newcomer_that_is_not_known_by_name_is_told_at_once(
    tmp_path: Path,
) -> None:
    async with judging(tmp_path, OK, UNATTRIBUTED) as bench:
        await bench.judge.once(Stage.CONNECTED)
        bench.grow()
        assert await bench.judge.once(Stage.CONNECTED) == UNATTRIBUTED
