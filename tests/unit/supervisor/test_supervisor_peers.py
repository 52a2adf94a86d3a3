"""Other supervisors: lost, found, shut down, and what they planned."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import DiscoveryRange, Machine, Quantity, RunKind
from lifecycle.manifest.names import supervisor_alive_topic
from lifecycle.node.host.control import Operation
from lifecycle.plan.comparison import decode, encode, notice_of
from lifecycle.plan.model import Plan, PlannedFlow
from lifecycle.supervisor.nodes.liveliness import Cause
from lifecycle.supervisor.nodes.peers import ANNOUNCED_S, EXCHANGED_S, Peers
from lifecycle.supervisor.processes.control_channel import ControlChannel
from lifecycle.supervisor.run.events import MachineConnection, NodeAlive, NodeSilent
from lifecycle.verify.observation import Observation, ObservedNode
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.nodes import MISSING_NODE
from lifecycle.verify.verdict import Verdict
from tests.builders import HERE, plan_of, planned_node
from tests.unit.supervisor.fakes import World, host_spec, run
from tests.unit.supervisor.session_world import FakeAir

DESK = supervisor_alive_topic("robot", "desk")
VIEWER = Observation(nodes=(ObservedNode(full_name="/viewer"),))
NOBODY = Observation()
NS = 10**9


def two_machines(system: str = "robot", *, log_level: str = "") -> Plan:
    nodes = [
        replace(planned_node(key), machine=machine, log_level=log_level)
        for key, machine in (("camera", "robot"), ("viewer", "desk"), ("lamp", "desk"))
    ]
    machines = (
        Machine(name="robot", address="10.0.0.1", at=HERE),
        Machine(name="desk", address="10.0.0.2", at=HERE),
    )
    return replace(
        plan_of(*nodes), system=system, machines=machines, discovery_range=DiscoveryRange.SUBNET
    )


class Robot(World):
    """The supervisor of machine `robot`, and what reaches it of others."""

    def __init__(self, directory: Path, plan: Plan | None = None) -> None:
        plan = two_machines() if plan is None else plan
        elsewhere = {each.key for each in plan.nodes if each.machine not in ("robot", "")}
        own = [each for each in plan.processes if each.name not in elsewhere]
        super().__init__(plan, directory, processes=own)
        self.touched = asyncio.Event()
        self.system.touch = self.touched.set
        self.system.liveliness.listen(self.touched.set)
        self.air = FakeAir()
        self.peers = Peers(self.system, self.air)
        self.peers.open()

    @property
    def desk(self) -> SimpleNamespace:
        return self.air.watched[DESK]

    def said(self) -> list[tuple[str, bool | str]]:
        return [
            (each.kind, each.established if isinstance(each, MachineConnection) else each.node)
            for each in self.events
            if isinstance(each, (MachineConnection, NodeSilent, NodeAlive))
        ]

    async def alive(self, is_alive: bool) -> None:
        self.desk.alive(is_alive)
        await settle()

    async def receives(self, of: Plan, machine: str = "desk", **changed: Any) -> None:
        """Receive the notice of a supervisor on another host."""
        notice = notice_of(of, run="2", host="h2", machines=(machine,))
        assert self.air.arrives is not None
        self.air.arrives(encode(replace(notice, **changed)))
        await settle()

    def found(self, observation: Observation = VIEWER) -> list[tuple[str, Outcome]]:
        return [(each.rule, each.outcome) for each in self.peers.findings(observation)]


async def settle() -> None:
    """Let what was called from another thread arrive."""
    for _ in range(5):
        await asyncio.sleep(0)


UP, GONE = ("connection", True), ("connection", False)
LOST = [("silent", "/viewer"), ("silent", "/lamp")]
FOUND = [("alive", "/viewer"), ("alive", "/lamp")]


@pytest.mark.parametrize(
    ("happens", "said"),
    [
        ([True, False, True], [UP, GONE, *LOST, UP, *FOUND]),
        ([False], []),  # it was never there, and so is not lost
        ([True, None], [UP, GONE]),  # it left properly
        ([True, False, None], [UP, GONE, *LOST]),  # that DDS forgets it changes nothing
    ],
)
async def test_with_a_machine_its_nodes_are_lost_and_found(
    tmp_path: Path, happens: list[bool | None], said: list[tuple[str, bool | str]]
) -> None:
    robot = Robot(tmp_path)
    for each in happens:
        if each is None:
            robot.desk.left()
        else:
            robot.desk.alive(each)
        await settle()
    assert robot.said() == said
    # Which are lost to us is not said to others.
    await asyncio.sleep(1)
    assert list(robot.air.announced.values()) == [[]]
    await robot.peers.close()
    assert robot.air.watched == {}


async def test_a_node_is_not_called_alive_that_has_not_started_or_is_not_in_the_graph(
    tmp_path: Path,
) -> None:
    robot = Robot(tmp_path)
    # Stopped in the middle of an import, and continued: it has not begun to live.
    robot.system.liveliness.note(["/camera"], Cause.STOPPED, "it was stopped")
    robot.system.liveliness.note(["/camera"], Cause.STOPPED, "")
    # A supervisor that was started anew has not started its nodes yet.
    await robot.alive(True)
    await robot.alive(False)
    robot.system.present = frozenset({"/lamp"})
    await robot.alive(True)
    alive = robot.heard(NodeAlive)
    assert {each.node: each.there for each in alive} == {
        "/camera": False,
        "/viewer": False,
        "/lamp": True,
    }


async def test_silence_is_said_again_and_again_and_that_of_others_is_taken_over(
    tmp_path: Path,
) -> None:
    robot = Robot(tmp_path)
    robot.desk.silent({"/viewer": "a callback hangs", "/camera": "not theirs to say"})
    await settle()
    assert dict(robot.system.liveliness.silent) == {"/viewer": "a callback hangs"}
    robot.desk.silent({})
    await settle()
    assert robot.said() == [("silent", "/viewer"), ("alive", "/viewer")]
    robot.system.liveliness.note(["/camera"], Cause.HUNG, "it hangs")
    await asyncio.sleep(1)
    robot.system.liveliness.note(["/camera"], Cause.HUNG, "")
    await asyncio.sleep(1)
    (said,) = robot.air.announced.values()
    assert said[-6:] == [{"/camera": "it hangs"}] * 3 + [{}] * 3


@pytest.mark.parametrize("came_back", [True, False])
async def test_a_loss_has_us_and_our_hosts_prepare_and_after_it_say_our_names_anew(
    tmp_path: Path, came_back: bool
) -> None:
    robot = Robot(tmp_path)
    (planned,) = [each for each in robot.system.plan.processes if each.name == "camera"]
    process = robot.system.processes["camera"] = robot.system.make_process(planned)
    spec = host_spec(robot.system.plan.nodes[0])
    await process.spawn(robot.hosts, ControlChannel(spec, robot.system.on_host_event))
    await process.channel.ready()
    await robot.alive(True)
    await asyncio.sleep(1)
    assert robot.air.done == []
    await robot.alive(False)
    await asyncio.sleep(1)
    done = ["send_again_soon"]
    assert robot.air.done == done
    if came_back:
        await robot.alive(True)
        await asyncio.sleep(1)
        done.append("republish_names")
    assert robot.air.done == done
    operations = (Operation.SEND_AGAIN_SOON, Operation.REPUBLISH_NAMES)
    asked = [each for each in operations if f"/camera {each.value}" in robot.hosts.log]
    assert [each.value for each in asked] == done
    await robot.peers.close()
    process.signal(9)
    await process.release()


DIFFER = ("run.plans-differ", Outcome.VIOLATED)
WAITS = ("run.plan-unknown", Outcome.VIOLATED)
UNKNOWN = ("run.plan-unknown", Outcome.UNVERIFIABLE)


async def test_who_planned_the_same_is_no_finding_and_who_did_not_is_named(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    await robot.receives(two_machines())
    assert robot.found() == []
    await robot.receives(two_machines(log_level="debug"))
    assert robot.found() == [DIFFER]
    assert robot.touched.is_set()
    (finding,) = robot.peers.findings(VIEWER)
    assert finding.subject == "the supervisor of machine 'desk'"
    await robot.receives(two_machines())
    await robot.receives(two_machines(log_level="debug"), "far", run="3", host="h3")
    assert robot.found() == [DIFFER]


async def test_each_machine_that_does_not_say_what_it_planned_is_waited_for_and_then_unverifiable(
    tmp_path: Path,
) -> None:
    plan = two_machines()
    far = replace(planned_node("arm"), machine="far")
    plan = replace(plan_of(*plan.nodes, far), discovery_range=DiscoveryRange.SUBNET)
    robot = Robot(tmp_path, plan)
    loop = asyncio.get_running_loop()
    # Nobody is there: that its nodes are missing is for others to say.
    assert robot.found(NOBODY) == []
    await robot.alive(True)
    assert robot.found(NOBODY) == [WAITS]
    await asyncio.sleep(0.9 * ANNOUNCED_S)
    both = Observation(nodes=(ObservedNode(full_name="/arm"),))
    assert robot.found(both) == [WAITS, WAITS]
    for looked_s, found in (
        (ANNOUNCED_S, [UNKNOWN, WAITS]),
        (1.9 * ANNOUNCED_S, [UNKNOWN, UNKNOWN]),
    ):
        robot.touched.clear()
        await robot.touched.wait()
        assert loop.time() == pytest.approx(looked_s)
        assert robot.found(both) == found
    # It went, and came again.
    assert robot.found(NOBODY) == [UNKNOWN]
    assert robot.found(both) == [UNKNOWN, WAITS]
    await robot.receives(plan, machines=("desk", "far"))
    assert robot.found(both) == []


async def test_a_node_without_a_machine_or_attached_has_no_supervisor_to_wait_for(
    tmp_path: Path,
) -> None:
    lidar = replace(planned_node("lidar", kind=RunKind.ATTACH), machine="bench")
    plan = plan_of(planned_node("nowhere"), *two_machines().nodes, lidar)
    robot = Robot(tmp_path, replace(plan, discovery_range=DiscoveryRange.SUBNET))
    names = [each.full_name for each in plan.nodes]
    everybody = Observation(nodes=tuple(ObservedNode(full_name=each) for each in names))

    def waited_for() -> list[str]:
        return sorted(each.subject for each in robot.peers.findings(everybody))

    supervisors = [f"the supervisor of machine {each!r}" for each in ("bench", "desk")]
    assert waited_for() == supervisors[1:]
    # Who started an attached node is not known; that its supervisor is connected is.
    robot.air.watched[supervisor_alive_topic("robot", "bench")].alive(True)
    await settle()
    assert waited_for() == supervisors


async def test_who_was_shut_down_is_the_reason_of_its_missing_nodes(tmp_path: Path) -> None:
    missing = MISSING_NODE.finding(
        outcome=Outcome.VIOLATED,
        subject="/viewer",
        expected="node in the graph",
        observed="no such node",
        message="there is no node /viewer in domain 7",
        node="/viewer",
    )
    verdict = Verdict(verdict=Outcome.VIOLATED, blocking=True, findings=(missing,), flows=())

    robot = Robot(tmp_path)
    await robot.receives(two_machines())
    assert (robot.peers.explained(verdict), robot.peers.left()) == (verdict, frozenset())
    await robot.receives(two_machines(), left=True, reason="lifecycle down")
    (explained,) = robot.peers.explained(verdict).findings
    assert explained.message == (
        "there is no node /viewer in domain 7: machine 'desk' was shut down by its supervisor "
        "(lifecycle down)"
    )
    assert robot.peers.left() == {"/viewer", "/lamp"}
    await robot.receives(two_machines(), run="3")
    assert (robot.peers.explained(verdict), robot.peers.left()) == (verdict, frozenset())
    # A run that failed is missed; and of what it says, so much is shown.
    reason = f"failed: {'r' * 80}"
    await robot.receives(two_machines(), left=True, run="3", reason=reason)
    assert robot.peers.left() == frozenset()
    (explained,) = robot.peers.explained(verdict).findings
    assert explained.message.endswith(f" by its supervisor ({reason[:80]})")


async def test_our_own_plan_is_announced_and_again_when_it_changes_or_ends(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    await robot.receives(two_machines(log_level="debug"))
    robot.system.run.first = two_machines(log_level="debug")
    robot.peers.announce()
    assert robot.found() == []
    robot.peers.leave("lifecycle  down")
    said = [decode(each) for each in robot.air.plans]
    assert [(each.machines, each.left, each.reason) for each in said] == [
        (("robot",), False, ""),
        (("robot",), False, ""),
        (("robot",), True, "lifecycle down"),
    ]


@pytest.mark.parametrize(
    ("where", "several", "announced"),
    [
        (DiscoveryRange.SUBNET, False, 1),
        (DiscoveryRange.LOCALHOST, False, 0),
        (DiscoveryRange.OFF, False, 0),
        (DiscoveryRange.LOCALHOST, True, 1),
    ],
)
async def test_a_plan_is_announced_where_another_supervisor_may_be(
    tmp_path: Path, where: DiscoveryRange, several: bool, announced: int
) -> None:
    plan = two_machines() if several else plan_of(planned_node("camera"))
    robot = Robot(tmp_path, replace(plan, discovery_range=where))
    robot.peers.announce()
    robot.peers.leave("lifecycle down")
    assert len(robot.air.plans) == 3 * announced


def test_what_is_no_notice_or_comes_after_the_end_changes_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def test() -> Callable[[str], None]:
        robot = Robot(tmp_path)
        arrives = robot.air.arrives
        assert arrives is not None
        arrives("no notice")
        assert robot.found(VIEWER) == [WAITS]
        await settle()
        await robot.peers.close()
        assert robot.air.arrives is None
        arrives(encode(notice_of(two_machines("rover"), run="2", host="", machines=("desk",))))
        await asyncio.sleep(2 * ANNOUNCED_S)
        assert not robot.touched.is_set()
        return arrives

    with caplog.at_level(logging.WARNING):
        arrives = run(test())
    (record,) = caplog.records
    assert record.getMessage().startswith("passed over: cannot read a plan notice: ")
    arrives("{}")  # from another thread, after the loop was closed: no error


async def test_what_does_not_concern_us_was_received_before_or_left_before_wakes_nobody(
    tmp_path: Path,
) -> None:
    robot = Robot(tmp_path)

    async def woken_by(of: Plan, **changed: Any) -> bool:
        robot.touched.clear()
        await robot.receives(of, **changed)
        return robot.touched.is_set()

    other = replace(plan_of(planned_node("rover")), system="rover")
    assert not await woken_by(other)
    assert not await woken_by(two_machines(), left=True)
    assert not await woken_by(two_machines(), machine="robot", run=decode(robot.air.plans[0]).run)
    assert await woken_by(two_machines())
    assert not await woken_by(two_machines())
    assert not await woken_by(two_machines(), left=True, run="3")
    assert await woken_by(two_machines(), left=True)


async def test_the_newest_64_supervisors_are_kept(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    for number in range(66):
        # Each in place of nobody: another run, host, system and machine.
        plan = two_machines(f"robot_{number}")
        await robot.receives(plan, f"machine_{number}", run=f"{number}", host=f"h{number}")
    subjects = [each.subject.rpartition("_")[2] for each in robot.peers.findings(NOBODY)]
    assert subjects == [f"{number}'" for number in range(2, 66)]


def with_delay(plan: Plan) -> Plan:
    """The plan with data from the robot to the desk that have to be there in time."""
    number = Quantity(name="max_delay_ms", value=5.0, at=HERE)
    flow = PlannedFlow(
        topic="/video", publisher="camera", subscription="viewer", quantities=(number,)
    )
    return replace(plan, flows=(flow,))


async def test_clocks_are_compared_once_a_second_while_a_delay_between_machines_is_declared(
    tmp_path: Path,
) -> None:
    robot = Robot(tmp_path)
    await asyncio.sleep(1.1 * EXCHANGED_S)
    assert robot.air.received == []  # no delay between machines is declared
    robot.system.run.first = with_delay(two_machines())
    robot.peers.announce()
    assert robot.air.received == [{}]
    now_ns = time.time_ns()
    robot.desk.times(now_ns + NS, now_ns, {})
    await settle()
    assert robot.peers.clocks() == ()  # it has not received ours yet
    await asyncio.sleep(1.1 * EXCHANGED_S)
    assert robot.air.received[1:] == [{"desk": (now_ns + NS, now_ns, 0)}]
    # It got ours after 1 ms, and its answer was here after 1 ms, by a clock that is 1 s ahead.
    sent_ns = now_ns + NS // 10
    ours = {"robot": (sent_ns, sent_ns + NS + NS // 1000, 0), "other": (1, 2, 0)}
    robot.desk.times(sent_ns + 2 * NS, sent_ns + NS + NS // 1000, ours)
    await settle()
    ((machine, offset),) = robot.peers.clocks()
    assert machine == "desk"
    assert abs(offset.offset_ms - 1000) <= offset.uncertainty_ms < 2
    robot.system.run.first = two_machines()
    robot.peers.announce()
    await asyncio.sleep(1.1 * EXCHANGED_S)
    assert len(robot.air.received) == 2


async def test_clocks_are_compared_at_once_with_who_begins_to_listen(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    robot.air.newcomers[0]()
    await settle()
    assert robot.air.asks == 0  # no delay between machines is declared
    robot.system.run.first = with_delay(two_machines())
    robot.peers.announce()
    robot.air.newcomers[0]()
    await settle()
    assert robot.air.asks == 1
    await robot.peers.close()


async def test_who_asks_for_a_comparison_of_clocks_is_answered_at_once_and_only_once(
    tmp_path: Path,
) -> None:
    robot = Robot(tmp_path, with_delay(two_machines()))
    now_ns = time.time_ns()
    for asks, answered in ((0, []), (1, [1]), (1, []), (2, [2])):
        before = len(robot.air.received)
        robot.desk.times(now_ns, now_ns, {}, asks)
        await settle()
        answers = [each["desk"][2] for each in robot.air.received[before:]]
        assert answers == answered
    await robot.peers.close()


@pytest.mark.parametrize(
    ("answers", "compared_s"),
    [
        ([(0.1, 1)], 0.1),
        ([(0.1, 0), (0.2, 1)], 0.2),  # the first was on its way before we asked
        ([(0.3, 1)], 0.3),  # it was asked again meanwhile
        ([(0.6, 3)], 0.6),  # what asked before was lost
        ([], 1.0),
    ],
)
async def test_clocks_are_compared_by_an_exchange_that_begins_now_if_there_is_an_answer(
    tmp_path: Path, answers: list[tuple[float, int]], compared_s: float
) -> None:
    robot = Robot(tmp_path, with_delay(two_machines()))
    loop, began_s = asyncio.get_running_loop(), asyncio.get_running_loop().time()
    await robot.peers.compare_clocks()
    assert loop.time() == began_s  # nobody is there
    await robot.alive(True)
    now_ns = time.time_ns()
    robot.desk.times(now_ns, now_ns, {"robot": (now_ns, now_ns, robot.air.asks)})
    await settle()
    before = robot.air.asks
    for after_s, number in answers:
        echo = {"robot": (now_ns, now_ns, before + number)}
        loop.call_later(after_s, robot.desk.times, now_ns, now_ns, echo)
    began_s = loop.time()
    await robot.peers.compare_clocks()
    assert loop.time() - began_s == pytest.approx(compared_s)
    await robot.peers.close()
