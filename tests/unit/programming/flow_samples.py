"""Flow rules, and flow reports with their plan, for every export test."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, Machine, UniqueHow
from lifecycle.network.nfe import TransportProtocol, UniqueRequirement
from lifecycle.plan.model import Plan
from lifecycle.programming.rules import FlowRule
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import FlowReport
from tests.builders import at, need, nfe, node, planned, publisher, shared_memory, subscription

EXPECTED = Path(__file__).parent / "expected"


def rule(topic: str, source: str, destination: str, **rest: object) -> FlowRule:
    """A rule from and to `address:port`; `*` for a source address that is not known."""
    protocol = TransportProtocol(rest.pop("protocol", "udp"))
    source_address, _, source_port = source.rpartition(":")
    destination_address, _, destination_port = destination.rpartition(":")
    return FlowRule(
        key=f"{topic} /robot/camera → /viewer udp {destination_address}",
        names=((topic, "/robot/camera", "/viewer"),),
        transport_protocol=protocol,
        source_address="" if source_address == "*" else source_address,
        source_port=int(source_port),
        destination_address=destination_address,
        destination_port=int(destination_port),
        **rest,
    )


VIDEO = rule("/video", "10.9.0.1:17900", "10.9.0.2:17910", dscp=46, five_qi=85, max_delay_ms=5.0)
RULES = (
    VIDEO,
    rule("/depth", "10.9.0.1:17901", "10.9.0.2:17911", dscp=46),
    rule("/bulk", "*:17900", "10.9.0.2:17912", dscp=1),
    rule("/log", "10.9.0.1:17903", "10.9.0.2:17913", dscp=5, protocol="tcp"),
    rule("/lidar", "fd09::1:17904", "fd09::2:17914", dscp=45, flow_label=0x12345),
    rule("/touch", "10.9.0.1:17905", "10.9.0.2:17915", five_qi=9),
)
LEFT_OUT = ("/map /robot/camera → /viewer: not verified: its verdict is unverifiable",)


def report(topic: str = "/robot/video", **rest: object) -> FlowReport:
    """A verified flow from the camera to the viewer."""
    ordinary = FlowReport(
        topic=topic,
        publisher="/robot/camera",
        subscription="/viewer",
        source=(nfe("0.0.0.0", 45000),),
        destination=(nfe("10.77.0.2", 7001),),
        unique=UniqueHow.STRONGLY,
        dscp=0,
        requirement=(UniqueRequirement.NOT_REQUIRED, UniqueRequirement.NOT_REQUIRED),
        demanded=UniqueHow.NOT,
        outcome=Outcome.OK,
    )
    return replace(ordinary, **rest)


SHM = shared_memory()


def plan(*, robot: str = "10.77.0.1", operator: str = "10.77.0.2") -> Plan:
    """A camera with a marked video and ordinary status, and a viewer of both."""
    return planned(
        node(
            "camera",
            publisher("video"),
            publisher("status"),
            needs=(need(EndpointKind.PUBLISHER, "video", dscp=46, five_qi=85),),
            namespace="/robot",
            machine="robot",
        ),
        node(
            "viewer",
            subscription("/robot/video"),
            subscription("/robot/status"),
            machine="operator",
        ),
        machines=(
            Machine(name="robot", address=robot, at=at(2)),
            Machine(name="operator", address=operator, at=at(2)),
        ),
    )


def in_a_network_namespace(*command: str, needs: str = "") -> subprocess.CompletedProcess[str]:
    """Run something as root of a new network namespace, or skip the test and say why.

    Args:
        command: with its arguments.
        needs: program that a script runs.
    """
    for program in ("unshare", needs or command[0]):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    probe = _run("unshare", "-Urn", "true")
    if probe.returncode:
        pytest.skip(f"no user namespace of one's own here: {probe.stderr.strip()}")
    return _run("unshare", "-Urn", *command)


def _run(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, check=False, capture_output=True, text=True, timeout=20)
