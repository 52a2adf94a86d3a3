"""Datagrams with a flow's DSCP, over real sockets of this host."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Iterator, Mapping

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import UniqueHow, UniqueRequirement
from lifecycle.plan.model import Plan, PlannedFlow
from lifecycle.supervisor.nodes import marks as module
from lifecycle.supervisor.nodes.marks import Marks, carries_marks
from lifecycle.verify.observation import ArrivedMark
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import FlowReport
from tests.builders import link, nfe, node, planned, publisher, subscription

EF = 46
MACHINES = {"/camera": "robot", "/viewer": "desk"}


def flow(*addresses: str, carrier: str = "udpv4", dscp: int = EF) -> FlowReport:
    """The video from the robot to some addresses of the desk."""
    return FlowReport(
        topic="/video",
        publisher="/camera",
        subscription="/viewer",
        source=tuple(nfe(each, 40000, dscp=dscp) for each in ("0.0.0.0", "::")),
        destination=tuple(nfe(each, 7000) for each in addresses),
        unique=UniqueHow.STRONGLY,
        dscp=dscp,
        requirement=(UniqueRequirement.NOT_REQUIRED,) * 2,
        demanded=UniqueHow.NOT,
        outcome=Outcome.OK,
        effective_transport=carrier,
    )


class Two:
    """The supervisors of robot and desk, each of which knows where the other receives."""

    def __init__(self) -> None:
        self.robot, self.desk = Marks("r"), Marks("d")
        for one, name, other in (
            (self.robot, "desk", self.desk),
            (self.desk, "robot", self.robot),
        ):
            one.open()
            other.open()
            one.ports = {name: other.own_ports}
        self.desk.machines = {"r": ("robot",)}

    def follow(self, *flows: FlowReport) -> None:
        self.robot.follow(flows, MACHINES, ("robot",))
        self.desk.follow(flows, MACHINES, ("desk",))

    async def arrive(self) -> tuple[ArrivedMark, ...]:
        """What the desk says once what the robot sends now is there."""
        self.robot.send()
        await asyncio.sleep(0.05)
        return self.desk.arrived()


@contextlib.contextmanager
def both() -> Iterator[Two]:
    two = Two()
    yield two
    two.robot.close()
    two.desk.close()


def arrived(arrives_as: int | None, dscp: int = EF) -> tuple[ArrivedMark, ...]:
    return (ArrivedMark(machine="robot", dscp=dscp, arrives_as=arrives_as),)


@pytest.mark.parametrize("address", ["127.0.0.1", "::1"])
async def test_a_mark_arrives_as_it_was_sent(address: str) -> None:
    with both() as two:
        two.follow(flow(address, carrier="udpv6" if ":" in address else "udpv4"))
        assert two.desk.arrived() == ()
        assert await two.arrive() == arrived(EF)
        two.follow()
        assert await two.arrive() == ()


async def test_what_one_of_several_ways_does_not_keep_is_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with both() as two:
        two.follow(flow("127.0.0.1", "127.0.0.2"))
        assert await two.arrive() == arrived(EF)
        sent = socket.socket.sendto

        def through_a_router(made: socket.socket, data: bytes, to: tuple[str, int]) -> int:
            if to[0] == "127.0.0.2":
                made.setsockopt(socket.IPPROTO_IP, socket.IP_TOS, 0)
            return sent(made, data, to)

        with monkeypatch.context() as patched:
            patched.setattr(socket.socket, "sendto", through_a_router)
            assert await two.arrive() == arrived(0)
        assert await two.arrive() == arrived(EF)


async def test_what_does_not_arrive_is_overdue_after_a_while(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with both() as two:
        two.robot.ports = {"desk": (0, 0)}  # it does not say where it receives
        two.follow(flow("127.0.0.1"))
        assert await two.arrive() == ()
        with monkeypatch.context() as patched:
            patched.setattr(module, "OVERDUE_S", 0.01)
            assert await two.arrive() == arrived(None)
        two.robot.ports = {"desk": two.desk.own_ports}
        assert await two.arrive() == arrived(EF)
        monkeypatch.setattr(module, "OVERDUE_S", 0.01)  # they arrive no more
        assert two.desk.arrived() == arrived(None)


@pytest.mark.parametrize(
    "sent",
    [
        {},
        {"carrier": "shm"},  # it leaves no host
        {"carrier": "tcpv4"},
        {"dscp": 0},
    ],
)
async def test_only_flows_over_udp_with_a_dscp_are_followed(sent: Mapping[str, object]) -> None:
    with both() as two:
        two.follow(flow("127.0.0.1", **sent))
        assert (await two.arrive() == arrived(EF)) is (sent == {})


async def test_what_strangers_send_is_passed_over() -> None:
    with both() as two:
        two.follow(flow("127.0.0.1"))
        two.desk.machines = {}
        assert await two.arrive() == ()
        two.desk.machines = {"r": ("robot",)}
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            for data in (b"", b"\xff" * 300, b'{"run":"r","dscp":64,"to":"127.0.0.1"}', b"[]"):
                stranger.sendto(data, ("127.0.0.1", two.desk.own_ports[0]))
            stranger.sendto(
                b'{"run":"r","dscp":10,"to":"127.0.0.1"}', ("127.0.0.1", two.desk.own_ports[0])
            )
        assert await two.arrive() == arrived(EF)


def marked(*, dscp: int | None = EF, viewer: str = "desk") -> Plan:
    """The camera on the robot, whose video has a DSCP."""
    plan = planned(
        node("camera", publisher("/video"), machine="robot"),
        node("viewer", subscription("/video"), machine=viewer),
        links=[link("/video", "camera", "viewer")],
    )
    camera, *others = plan.nodes
    endpoints = tuple(replace(each, dscp=dscp) for each in camera.endpoints)
    return replace(plan, nodes=(replace(camera, endpoints=endpoints), *others))


def test_marks_are_for_flows_with_a_dscp_between_machines() -> None:
    assert carries_marks(marked())
    assert not carries_marks(marked(viewer="robot"))
    assert not carries_marks(marked(dscp=None))
    other = PlannedFlow(topic="/other", publisher="camera", subscription="viewer")
    assert not carries_marks(replace(marked(), flows=(other,)))
