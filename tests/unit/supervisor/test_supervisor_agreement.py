"""Supervisors that compare their plans: what a difference, or a plan not announced, comes to."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import DiscoveryRange, Machine, RunKind
from lifecycle.plan.comparison import decode, encode, notice_of
from lifecycle.plan.model import Plan
from lifecycle.supervisor.health.agreement import ANNOUNCED_S, Agreement
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.run.events import Emitter
from lifecycle.verify.observation import Observation, ObservedNode
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.matching import UNMATCHED_FLOW
from lifecycle.verify.rules.nodes import MISSING_NODE, UNDECLARED_NODE
from lifecycle.verify.verdict import Finding, Verdict
from tests.builders import HERE, plan_of, planned_node
from tests.unit.supervisor.fakes import run

VIEWER = Observation(nodes=(ObservedNode(full_name="/viewer"),))
NOBODY = Observation()


def two_machines(system: str = "robot", *, log_level: str = "") -> Plan:
    nodes = [
        replace(planned_node(key), machine=machine, log_level=log_level)
        for key, machine in (("camera", "left"), ("viewer", "right"))
    ]
    machines = tuple(Machine(name=each, address="", at=HERE) for each in ("left", "right"))
    return replace(
        plan_of(*nodes), system=system, machines=machines, discovery_range=DiscoveryRange.SUBNET
    )


class Air:
    """Carries what is announced to nobody."""

    def __init__(self) -> None:
        self.taken_part = self.destroyed = 0
        self.said: list[str] = []
        self.arrives: Callable[[str], None] = lambda _: None

    def plan_notices(self, on_notice: Callable[[str], None]) -> Air:
        self.taken_part += 1
        self.arrives = on_notice
        return self

    def announce(self, text: str) -> None:
        self.said.append(text)

    def destroy(self) -> None:
        self.destroyed += 1


class Left:
    """The supervisor of machine `left`."""

    def __init__(
        self, directory: Path, plan: Plan | None = None, own: frozenset[str] = frozenset({"camera"})
    ) -> None:
        self.plan = two_machines() if plan is None else plan
        processes = [each for each in self.plan.processes if each.name in own]
        self.system = System(self.plan, emit=Emitter(), logs=directory, processes=processes)
        self.touched = asyncio.Event()
        self.system.on_change = self.touched.set
        self.machines: frozenset[str] = frozenset()
        self.air = Air()
        self.agreement = Agreement(self.system, self.air, self)
        self.agreement.open()

    async def hears(self, of: Plan, machine: str = "right", **changed: object) -> None:
        """Receive the notice of a supervisor on another host."""
        notice = notice_of(of, run="2", host="h2", machines=(machine,))
        await self.receives(encode(replace(notice, **changed)))  # type: ignore[arg-type]

    async def receives(self, text: str) -> None:
        self.air.arrives(text)
        for _ in range(5):
            await asyncio.sleep(0)

    def found(self, observation: Observation = VIEWER) -> list[tuple[str, Outcome]]:
        return [(each.rule, each.outcome) for each in self.agreement.findings(observation)]


DIFFER = ("run.plans-differ", Outcome.VIOLATED)
WAITS = ("run.plan-unknown", Outcome.VIOLATED)
UNKNOWN = ("run.plan-unknown", Outcome.UNVERIFIABLE)


async def test_who_planned_the_same_is_no_finding_and_who_did_not_is_named(tmp_path: Path) -> None:
    left = Left(tmp_path)
    await left.hears(two_machines())
    assert left.found() == []
    await left.hears(two_machines(log_level="debug"))
    assert left.found() == [DIFFER]
    assert left.touched.is_set()
    (finding,) = left.agreement.findings(VIEWER)
    assert finding.subject == "the supervisor of machine 'right'"
    await left.hears(two_machines())
    assert left.found() == []


async def test_a_machine_that_does_not_say_what_it_planned_is_waited_for_and_then_unverifiable(
    tmp_path: Path,
) -> None:
    left = Left(tmp_path)
    # Nobody is there: that its nodes are missing is for others to say.
    assert left.found(NOBODY) == []
    left.machines = frozenset({"right"})
    assert left.found(NOBODY) == [WAITS]
    left.touched.clear()
    await asyncio.wait_for(left.touched.wait(), 2 * ANNOUNCED_S)
    assert left.found(NOBODY) == [UNKNOWN]
    await left.hears(two_machines())
    assert left.found(NOBODY) == left.found(VIEWER) == []


async def test_who_planned_something_else_is_found_behind_one_that_planned_the_same(
    tmp_path: Path,
) -> None:
    left = Left(tmp_path)
    await left.hears(two_machines())
    await left.hears(two_machines(log_level="debug"), "far", run="3", host="h3")
    assert left.found(VIEWER) == [DIFFER]


async def test_who_was_shut_down_is_the_reason_of_its_missing_nodes(tmp_path: Path) -> None:
    missing = _missing("/viewer")

    left = Left(tmp_path)
    await left.hears(two_machines())
    assert left.agreement.explained(_verdict(missing)) == _verdict(missing)
    await left.hears(two_machines(), left=True, reason="lifecycle down")
    (told,) = left.agreement.explained(_verdict(missing)).findings
    assert told.message == (
        "cannot find node /viewer in domain 7: machine 'right' was shut down by its supervisor "
        "(lifecycle down)"
    )
    assert told.hint == missing.hint
    await left.hears(two_machines(), run="3")
    assert left.agreement.explained(_verdict(missing)) == _verdict(missing)


async def test_only_the_absence_of_who_was_shut_down_is_how_a_system_of_several_hosts_ends(
    tmp_path: Path,
) -> None:
    unmatched = UNMATCHED_FLOW.finding(
        outcome=Outcome.VIOLATED,
        subject="/video: /camera → /viewer",
        ends=("/camera", "/viewer"),
        expected="matched",
        observed="the subscription is missing",
        message="cannot see /camera → /viewer matched on /video: the subscription is missing",
    )
    intruder = UNDECLARED_NODE.finding(
        outcome=Outcome.VIOLATED,
        subject="/viewer",
        expected="no such node",
        observed="node",
        message="cannot allow node /viewer",
        node="/viewer",
    )

    left = Left(tmp_path)
    await left.hears(two_machines())
    absent = _verdict(_missing("/viewer"), unmatched)
    assert not left.agreement.follows_from_shut_down(absent)
    await left.hears(two_machines(), left=True, reason="failed: rolling back")
    assert not left.agreement.follows_from_shut_down(absent)
    await left.hears(two_machines(), left=True, reason="lifecycle down")
    assert left.agreement.follows_from_shut_down(absent)
    for worse in (_missing("/camera"), intruder):
        assert not left.agreement.follows_from_shut_down(_verdict(*absent.findings, worse))
    assert not left.agreement.follows_from_shut_down(_verdict())


async def test_our_own_plan_is_announced_and_again_when_it_changes_or_ends(tmp_path: Path) -> None:
    left = Left(tmp_path)
    await left.hears(two_machines(log_level="debug"))
    left.agreement.announce(two_machines(log_level="debug"))
    assert left.found() == []
    left.agreement.leave("lifecycle down")
    said = [decode(each) for each in left.air.said]
    assert [(each.machines, each.left, each.reason) for each in said] == [
        (("left",), False, ""),
        (("left",), False, ""),
        (("left",), True, "lifecycle down"),
    ]
    # What we said ourselves comes back, and is nothing new.
    left.air.arrives(left.air.said[0])
    await asyncio.sleep(0)
    assert left.found() == []


async def test_a_plan_is_announced_where_another_supervisor_may_be(tmp_path: Path) -> None:
    both = frozenset({"camera", "viewer"})
    for where, own, announced in (
        (DiscoveryRange.SUBNET, both, 1),
        (DiscoveryRange.LOCALHOST, both, 0),
        (DiscoveryRange.OFF, both, 0),
        (DiscoveryRange.LOCALHOST, frozenset({"camera"}), 1),
    ):
        plan = replace(two_machines(), discovery_range=where)
        left = Left(tmp_path, plan, own)
        assert (left.air.taken_part, len(left.air.said)) == (announced, announced)
        # A change or an end of the plan is no reason to announce it either.
        left.agreement.announce(plan)
        left.agreement.leave("lifecycle down")
        assert len(left.air.said) == 3 * announced
        left.agreement.close()
        assert left.air.destroyed == announced


def test_after_it_was_closed_nothing_is_announced_taken_or_woken(tmp_path: Path) -> None:
    left: list[Left] = []

    async def test() -> None:
        left.append(Left(tmp_path))
        assert left[0].found(VIEWER) == [WAITS]
        left[0].agreement.close()
        left[0].touched.clear()
        left[0].agreement.announce(two_machines())
        left[0].agreement.leave("lifecycle down")
        await left[0].hears(two_machines(log_level="debug"))
        await asyncio.sleep(2 * ANNOUNCED_S)
        assert (len(left[0].air.said), left[0].air.destroyed) == (1, 1)
        assert not left[0].touched.is_set()
        left[0].agreement.close()
        assert left[0].air.destroyed == 1

    run(test())
    left[0].air.arrives("{}")  # from another thread, after the loop was closed: no error


def test_what_is_no_notice_is_passed_over_and_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def test() -> None:
        left = Left(tmp_path)
        await left.receives("no notice")
        assert not left.touched.is_set()
        left.agreement.close()

    with caplog.at_level(logging.WARNING):
        run(test())
    (record,) = caplog.records
    assert record.getMessage().startswith("passed over: cannot read a plan notice: ")


async def test_what_does_not_concern_us_was_received_before_or_left_before_wakes_nobody(
    tmp_path: Path,
) -> None:
    left = Left(tmp_path)
    touched = left.touched

    async def woken_by(of: Plan, **changed: object) -> bool:
        touched.clear()
        await left.hears(of, **changed)  # type: ignore[arg-type]
        return touched.is_set()

    other = replace(plan_of(planned_node("rover")), system="rover")
    assert not await woken_by(other)
    assert not await woken_by(two_machines(), left=True)
    assert not await woken_by(two_machines(), machine="left", run=decode(left.air.said[0]).run)
    assert await woken_by(two_machines())
    assert not await woken_by(two_machines())
    assert not await woken_by(two_machines(), left=True, run="3")
    assert await woken_by(two_machines(), left=True)


async def test_the_newest_64_supervisors_are_kept(tmp_path: Path) -> None:
    left = Left(tmp_path)
    for number in range(66):
        # Each in place of nobody: another run, host, system and machine.
        await left.hears(
            two_machines(f"robot_{number}"),
            f"machine_{number}",
            run=f"{number}",
            host=f"h{number}",
        )
    machines = [each.observed for each in left.agreement.findings(NOBODY)]
    assert len(machines) == 64
    subjects = [each.subject for each in left.agreement.findings(NOBODY)]
    assert subjects[0].endswith("on machine 'machine_2'")
    assert subjects[-1].endswith("on machine 'machine_65'")


async def test_we_look_when_the_first_of_several_machines_had_its_time_and_then_the_next(
    tmp_path: Path,
) -> None:
    plan = two_machines()
    far = replace(planned_node("arm"), machine="far")
    plan = replace(plan_of(*plan.nodes, far), discovery_range=DiscoveryRange.SUBNET)
    left = Left(tmp_path, plan)
    loop = asyncio.get_running_loop()
    left.machines = frozenset({"right"})
    assert left.found(NOBODY) == [WAITS]
    await asyncio.sleep(0.9 * ANNOUNCED_S)
    left.machines = frozenset({"right", "far"})
    assert left.found(NOBODY) == [WAITS, WAITS]
    for finding in left.agreement.findings(NOBODY):
        assert finding.observed == "not announced yet"
        assert finding.message.endswith(": it has not said so yet")
    for looked_s, found in (
        (ANNOUNCED_S, [UNKNOWN, WAITS]),
        (1.9 * ANNOUNCED_S, [UNKNOWN, UNKNOWN]),
    ):
        left.touched.clear()
        await left.touched.wait()
        assert loop.time() == pytest.approx(looked_s)
        assert left.found(NOBODY) == found
    # There is nothing more to wait for.
    left.touched.clear()
    await asyncio.sleep(10 * ANNOUNCED_S)
    assert not left.touched.is_set()


async def test_a_machine_that_comes_has_its_time_to_announce_and_we_look_when_it_is_over(
    tmp_path: Path,
) -> None:
    left = Left(tmp_path)
    loop = asyncio.get_running_loop()
    assert left.found(VIEWER) == [WAITS]
    await asyncio.sleep(0.75 * ANNOUNCED_S)
    assert left.found(VIEWER) == [WAITS]
    left.touched.clear()
    await left.touched.wait()
    assert loop.time() == pytest.approx(ANNOUNCED_S)
    assert left.found(VIEWER) == [UNKNOWN]
    # It went, and came again.
    assert left.found(NOBODY) == []
    assert left.found(VIEWER) == [WAITS]
    left.touched.clear()
    await left.touched.wait()
    assert loop.time() == pytest.approx(2 * ANNOUNCED_S)


async def test_every_machine_is_waited_for_by_itself_and_a_node_without_one_or_attached_is_none(
    tmp_path: Path,
) -> None:
    far = replace(planned_node("arm"), machine="far")
    attached = planned_node("lidar", kind=RunKind.ATTACH)
    attached = replace(attached, machine="bench")
    plan = two_machines()
    plan = replace(
        plan_of(planned_node("nowhere"), *plan.nodes, attached, far),
        discovery_range=DiscoveryRange.SUBNET,
    )
    left = Left(tmp_path, plan)
    seen = [f"/{each.key}" for each in plan.nodes]
    everybody = Observation(nodes=tuple(ObservedNode(full_name=each) for each in seen))

    def waited_for() -> list[str]:
        return [each.subject for each in left.agreement.findings(everybody)]

    supervisor = "the supervisor of machine"
    assert waited_for() == [f"{supervisor} 'right'", f"{supervisor} 'far'"]
    # Who started an attached node is not known; that its supervisor is connected is.
    left.machines = frozenset({"bench"})
    assert sorted(waited_for()) == [f"{supervisor} {each!r}" for each in ("bench", "far", "right")]
    await left.hears(plan)
    assert sorted(waited_for()) == [f"{supervisor} {each!r}" for each in ("bench", "far")]


async def test_shut_down_are_the_machines_of_our_system_whose_supervisor_says_so(
    tmp_path: Path,
) -> None:
    left = Left(tmp_path)
    await left.hears(two_machines())
    assert left.agreement.shut_down == {}
    await left.hears(two_machines(), left=True, reason="r" * 81, machines=("right", "far"))
    assert left.agreement.shut_down == {"right": "r" * 80, "far": "r" * 80}
    other = Left(tmp_path)
    await other.hears(two_machines("robbie"))
    await other.hears(two_machines("robbie"), left=True)
    assert other.agreement.shut_down == {}


def _missing(node: str) -> Finding:
    return MISSING_NODE.finding(
        outcome=Outcome.VIOLATED,
        subject=node,
        expected="node in the graph",
        observed="no such node",
        message=f"cannot find node {node} in domain 7",
        node=node,
    )


def _verdict(*findings: Finding) -> Verdict:
    outcome = Outcome.worst(each.outcome for each in findings)
    return Verdict(verdict=outcome, blocking=bool(findings), findings=findings, flows=())
