"""Silent nodes: what becomes of what is noticed, without processes, ROS or waiting."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Mapping
from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.cli.up_output import describe
from lifecycle.manifest.model import DiscoveryRange, Machine, Run, RunKind, Timeouts
from lifecycle.middleware.process.busy_sign import BusySign, Overdue
from lifecycle.node.host.control import HostSpec, Operation
from lifecycle.plan.model import Plan
from lifecycle.supervisor.core.state import install
from lifecycle.supervisor.health.liveliness import Cause, SilenceMonitor
from lifecycle.supervisor.health.peer_supervisors import Listener, PeerSupervisors
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.processes.control_channel import ChannelClosedError, ControlChannel
from lifecycle.supervisor.run.events import (
    Emitter,
    Event,
    MachineConnection,
    NodeAlive,
    NodeSilent,
)
from tests.builders import HERE, plan_of, planned_node
from tests.unit.supervisor.fakes import World


class Ears:
    """A liveliness with everything it told."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.changes = 0
        emit = Emitter()
        emit.listen(self.events.append)
        self.liveliness = SilenceMonitor(emit, self._changed)

    def _changed(self) -> None:
        self.changes += 1

    @property
    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]


def test_a_silent_node_is_told_once_and_alive_when_its_last_cause_is_gone() -> None:
    ears = Ears()
    ears.liveliness.fell_silent(["/camera"], Cause.STOPPED, "it was stopped")
    ears.liveliness.fell_silent(["/camera"], Cause.HUNG, "it hangs")
    ears.liveliness.came_back(["/camera"], Cause.STOPPED)
    assert ears.kinds == ["silent"]
    ears.liveliness.came_back(["/camera"], Cause.HUNG)
    assert ears.kinds == ["silent", "alive"]
    assert ears.liveliness.silent == {}
    assert ears.changes == 4


async def test_a_node_is_not_called_alive_that_has_not_started_or_is_not_in_the_graph(
    tmp_path: Path,
) -> None:
    desk = Desk(tmp_path)
    # Stopped in the middle of an import, and continued: it has not begun to live.
    desk.system.liveliness.fell_silent(["/camera"], Cause.STOPPED, "it was stopped")
    desk.system.liveliness.came_back(["/camera"], Cause.STOPPED)
    # A supervisor that was started anew has not started its nodes yet.
    desk.desk.alive(True)
    await settle()
    desk.desk.alive(False)
    await settle()
    desk.system.present = frozenset({"/lamp"})
    desk.desk.alive(True)
    await settle()
    alive = [each for each in desk.events if isinstance(each, NodeAlive)]
    assert {each.node: each.there for each in alive} == {
        "/camera": False,
        "/viewer": False,
        "/lamp": True,
    }
    assert [describe(replace(each, silent_s=2.0)) for each in alive] == [
        "/camera: not silent any more after 2.0 s, but not there yet",
        "/viewer: not silent any more after 2.0 s, but not there yet",
        "/lamp: alive again after 2.0 s",
    ]
    await desk.peer_supervisors.close()


def test_who_hangs_may_come_back_and_who_is_stopped_or_lost_is_out_of_reach() -> None:
    ears = Ears()
    for node, cause in (("/a", Cause.HUNG), ("/b", Cause.STOPPED), ("/c", Cause.LOST)):
        ears.liveliness.fell_silent([node], cause, "it is")
    reached = {node: not ears.liveliness.is_out_of_reach(node) for node in ("/a", "/b", "/c", "/d")}
    assert reached == {"/a": True, "/b": False, "/c": False, "/d": True}


class FakeEar:
    def __init__(self, listener: Listener, air: FakeAir) -> None:
        self.listener = listener
        self._air = air

    def destroy(self) -> None:
        self._air.destroyed += 1


class FakeVoice:
    def __init__(self) -> None:
        self.told: list[Mapping[str, str]] = []

    def notify(self, silent: Mapping[str, str]) -> None:
        self.told.append(dict(silent))

    def destroy(self) -> None:
        """Nothing to destroy."""


class FakeAir:
    """Carries nothing, and remembers who wanted to hear and be heard."""

    def __init__(self) -> None:
        self.ears: dict[str, FakeEar] = {}
        self.voices: dict[str, FakeVoice] = {}
        self.done: list[str] = []
        self.destroyed = 0

    def announce_machine(self, system: str, machine: str) -> FakeVoice:
        return self.voices.setdefault(f"{system}/{machine}", FakeVoice())

    def watch_machine(self, system: str, machine: str, to: Listener) -> FakeEar:
        return self.ears.setdefault(f"{system}/{machine}", FakeEar(to, self))

    def watch_node(self, node: str, to: Listener) -> FakeEar:
        return self.ears.setdefault(node, FakeEar(to, self))

    def send_again_soon(self) -> None:
        self.done.append("send_again_soon")

    def republish_names(self) -> None:
        self.done.append("republish_names")


def two_machines() -> Plan:
    nodes = [
        replace(planned_node(key), machine=machine)
        for key, machine in (("camera", "robot"), ("viewer", "desk"), ("lamp", "desk"))
    ]
    plan = plan_of(*nodes)
    machines = (
        Machine(name="robot", address="10.0.0.1", at=HERE),
        Machine(name="desk", address="10.0.0.2", at=HERE),
    )
    return replace(plan, machines=machines)


class Desk:
    """The supervisor of machine `robot`, which hears `desk`."""

    def __init__(self, directory: Path) -> None:
        plan = two_machines()
        self.events: list[Event] = []
        emit = Emitter()
        emit.listen(self.events.append)
        own = [each for each in plan.processes if each.name == "camera"]
        self.system = System(plan, emit=emit, logs=directory, processes=own)
        self.air = FakeAir()
        self.peer_supervisors = PeerSupervisors(self.system, self.air)
        self.peer_supervisors.open()

    @property
    def desk(self) -> Listener:
        return self.air.ears["robot/desk"].listener

    def told(self) -> list[tuple[str, bool | str]]:
        return [
            (each.kind, each.established if isinstance(each, MachineConnection) else each.node)
            for each in self.events
            if isinstance(each, (MachineConnection, NodeSilent, NodeAlive))
        ]


async def settle() -> None:
    """Let what was called from another thread arrive."""
    for _ in range(5):
        await asyncio.sleep(0)


UP, GONE = ("connection", True), ("connection", False)
LOST = [("silent", "/viewer"), ("silent", "/lamp")]
FOUND = [("alive", "/viewer"), ("alive", "/lamp")]


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ([True, False, True], [UP, GONE, *LOST, UP, *FOUND]),
        ([False], []),  # it was never heard, and so is not lost
        ([True, None], [UP, GONE]),  # it left properly
        ([True, False, None], [UP, GONE, *LOST]),  # that DDS forgets it changes nothing
    ],
)
async def test_with_a_machine_its_nodes_are_lost_and_found(
    tmp_path: Path, said: list[bool | None], told: list[tuple[str, bool | str]]
) -> None:
    desk = Desk(tmp_path)
    for each in said:
        if each is None:
            desk.desk.left()
        else:
            desk.desk.alive(each)
        await settle()
    assert desk.told() == told
    # Who is lost to us is not told to others.
    await asyncio.sleep(1)
    assert desk.air.voices["robot/robot"].told == []
    await desk.peer_supervisors.close()


async def test_what_another_supervisor_says_of_its_nodes_is_taken_over(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    desk.desk.silent({"/viewer": "a callback hangs", "/camera": "not theirs to say"})
    await settle()
    assert dict(desk.system.liveliness.silent) == {"/viewer": "a callback hangs"}
    desk.desk.silent({})
    await settle()
    assert desk.told() == [("silent", "/viewer"), ("alive", "/viewer")]
    await desk.peer_supervisors.close()


async def test_our_own_silent_nodes_are_told_again_and_again_until_it_is_over(
    tmp_path: Path,
) -> None:
    desk = Desk(tmp_path)
    desk.system.liveliness.fell_silent(["/camera"], Cause.HUNG, "it hangs")
    await asyncio.sleep(1)
    desk.system.liveliness.came_back(["/camera"], Cause.HUNG)
    await asyncio.sleep(1)
    assert desk.air.voices["robot/robot"].told == [{"/camera": "it hangs"}] * 3 + [{}] * 3
    await desk.peer_supervisors.close()


async def test_a_system_of_one_machine_neither_speaks_nor_listens(tmp_path: Path) -> None:
    plan = plan_of(planned_node("camera"))
    system = System(plan, emit=Emitter(), logs=tmp_path, processes=plan.processes)
    air = FakeAir()
    peer_supervisors = PeerSupervisors(system, air)
    peer_supervisors.open()
    assert (air.ears, air.voices) == ({}, {})
    await peer_supervisors.close()


def attached(*keys: str) -> Plan:
    """A camera of ours, and nodes that others run."""
    others = [replace(planned_node(each), run=Run(kind=RunKind.ATTACH)) for each in keys]
    plan = plan_of(planned_node("camera"), *others)
    processes = tuple(
        replace(each, run=Run(kind=RunKind.ATTACH)) if each.name in keys else each
        for each in plan.processes
    )
    return replace(plan, processes=processes)


async def test_a_reloaded_plan_has_its_own_attached_nodes_followed_and_no_others(
    tmp_path: Path,
) -> None:
    plan = attached("lidar", "radar")
    system = System(plan, emit=Emitter(), logs=tmp_path, processes=plan.processes)
    air = FakeAir()
    peer_supervisors = PeerSupervisors(system, air)
    peer_supervisors.open()
    assert set(air.ears) == {"/lidar", "/radar"}
    old = dict(air.ears)
    for each in old.values():
        each.listener.alive(True)
    peer_supervisors.renew()
    assert air.destroyed == 0  # the same nodes: nobody is heard anew
    old["/lidar"].listener.alive(False)
    await settle()
    assert set(system.liveliness.silent) == {"/lidar"}

    plan = attached("radar", "sonar")
    install(system.run, plan)
    system.follow()
    air.ears.clear()
    peer_supervisors.renew()
    assert air.destroyed == 2
    assert set(air.ears) == {"/radar", "/sonar"}
    # Who is not planned any more is not missed, whatever was on the way.
    old["/radar"].listener.alive(False)
    await settle()
    assert dict(system.liveliness.silent) == {}
    air.ears["/sonar"].listener.alive(True)
    air.ears["/sonar"].listener.alive(False)
    await settle()
    assert set(system.liveliness.silent) == {"/sonar"}
    await peer_supervisors.close()


@pytest.mark.parametrize("came_back", [True, False])
async def test_a_loss_has_us_and_our_hosts_prepare_and_after_it_tell_our_names_anew(
    tmp_path: Path, came_back: bool
) -> None:
    plan = two_machines()
    world = World(plan, tmp_path)
    world.system.remote = dict(Desk(tmp_path).system.remote)
    air = FakeAir()
    peer_supervisors = PeerSupervisors(world.system, air)
    peer_supervisors.open()
    (planned,) = plan.processes[:1]
    process = world.system.processes[planned.name] = world.system.make_process(planned)
    spec = HostSpec(
        system="robot",
        process=planned.name,
        domain_id=0,
        discovery_range=DiscoveryRange.LOCALHOST,
        nodes=plan.nodes[:1],
    )
    await process.spawn(world.spawner, ControlChannel(spec, world.system.on_host_event))
    await process.channel.ready()
    listener = air.ears["robot/desk"].listener
    listener.alive(True)
    await asyncio.sleep(1)
    assert air.done == []
    listener.alive(False)
    await asyncio.sleep(1)
    done = ["send_again_soon"]
    assert air.done == done
    if came_back:
        listener.alive(True)
        await asyncio.sleep(1)
        done.append("republish_names")
    assert air.done == done
    operations = (Operation.SEND_AGAIN_SOON, Operation.REPUBLISH_NAMES)
    asked = [each for each in operations if f"/camera {each.value}" in world.log]
    assert [each.value for each in asked] == done
    await peer_supervisors.close()
    process.signal(9)
    await process.release()


def test_a_process_that_was_killed_while_it_was_busy_does_not_hang() -> None:
    """Its nodes may run again in another one, when the limit of the first is over."""

    async def test() -> None:
        node = planned_node("camera", timeouts=Timeouts(silent_s=0.05))
        spec = HostSpec(
            system="robot",
            process="p",
            domain_id=0,
            discovery_range=DiscoveryRange.LOCALHOST,
            nodes=(node,),
        )
        told: asyncio.Queue[Overdue | None] = asyncio.Queue()
        channel = ControlChannel(spec, lambda _: None, told.put_nowait)
        theirs = await channel.open()
        _, descriptors, _, _ = socket.recv_fds(theirs, 1, 1)
        sign = BusySign(*descriptors)
        sign.begin()
        theirs.close()
        with pytest.raises(ChannelClosedError):
            await asyncio.wait_for(channel.ready(), 10)
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(told.get(), 10 * sign.limit_s)
        sign.close()
        await channel.close()

    asyncio.run(test())
