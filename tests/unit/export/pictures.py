"""Systems to draw: a plan, a small one where everything is wrong somewhere, one of 30 nodes."""

from __future__ import annotations

from msgspec.structs import replace

from lifecycle.export.picture import Picture, Supervised, build_picture
from lifecycle.manifest.model import Discovery, EndpointKind, Machine, UniqueHow
from lifecycle.manifest.qos import QosProfile, Reliability
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.build import build_plan
from lifecycle.plan.model import Plan
from lifecycle.verify.judge import verify
from lifecycle.verify.observation import Observation, ObservedEndpoint, ObservedNode
from lifecycle.verify.verdict import Stage
from tests.builders import (
    STRING,
    at,
    endpoint,
    link,
    need,
    node,
    planned,
    publisher,
    subscription,
    teleop,
)
from tests.unit.verify.perfect import perfect

PUBLISHER, SUBSCRIPTION = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
IMAGE, TRIGGER = "sensor_msgs/msg/Image", "std_srvs/srv/Trigger"
STRICTLY = UniqueRequirement.STRICTLY_REQUIRED


def drawn(plan: Plan, observation: Observation, **rest: object) -> Picture:
    """The picture of a plan and an observation, judged as an active system."""
    verdict = verify(plan, observation, stage=Stage.ACTIVE)
    return build_picture(plan, observation, verdict, **rest)


def article() -> Plan:
    """The article's P1 and P2 in one process, S1 and S2 in one node, and a base beside them."""
    return planned(
        node(
            "camera",
            publisher("video", IMAGE),
            needs=(need(PUBLISHER, "video", STRICTLY, dscp=46),),
            machine="d1",
            process="n1",
        ),
        node("battery", publisher("level"), machine="d1", process="n1"),
        node(
            "viewer",
            subscription("video", IMAGE),
            subscription("level"),
            endpoint(EndpointKind.SERVICE_CLIENT, "reset", TRIGGER),
            needs=(need(SUBSCRIPTION, "video", STRICTLY),),
            machine="d2",
        ),
        node(
            "base",
            endpoint(EndpointKind.SERVICE_SERVER, "reset", TRIGGER),
            publisher("odometry"),
            machine="d1",
            managed=False,
        ),
        links=(link("/video", "camera", "viewer", unique=UniqueHow.STRONGLY, max_delay_ms=5.0),),
        machines=(
            Machine(name="d1", address="10.0.0.1", at=at(2)),
            Machine(name="d2", address="10.0.0.2", at=at(2)),
        ),
        discovery=Discovery(domain_id=7),
    )


def small() -> Picture:
    """The article's teleoperation, with a viewer that is missing and an intruder."""
    plan = build_plan(teleop(), environment={})
    observation = perfect(plan, Stage.ACTIVE)
    viewer = "/viewer"
    return drawn(
        plan,
        Observation(
            nodes=(
                *(each for each in observation.nodes if each.full_name != viewer),
                ObservedNode(full_name="/intruder", managed=False),
            ),
            endpoints=(
                *(each for each in observation.endpoints if each.node != viewer),
                ObservedEndpoint(
                    kind=SUBSCRIPTION,
                    node="/intruder",
                    name="/robot/video",
                    type="sensor_msgs/msg/CompressedImage",
                    qos=QosProfile(depth=1, reliability=Reliability.BEST_EFFORT),
                ),
            ),
            configurations=tuple(e for e in observation.configurations if e.name != viewer),
        ),
    )


def large() -> Picture:
    """30 nodes: ten robots' sensors, filters and loggers; some are missing, dead or silent."""
    nodes = []
    for number in range(10):
        space = f"/robot_{number}"
        nodes += [
            node(
                f"sensor_{number}",
                publisher("scan"),
                publisher("status"),
                endpoint(EndpointKind.SERVICE_SERVER, "reset", TRIGGER),
                namespace=space,
            ),
            node(f"filter_{number}", subscription("scan"), publisher("map"), namespace=space),
            node(
                f"logger_{number}",
                subscription("map"),
                subscription("status"),
                endpoint(EndpointKind.SERVICE_CLIENT, "reset", TRIGGER),
                namespace=space,
                process=f"loggers_{number % 2}",
            ),
        ]
    plan = planned(*nodes)
    seen = perfect(plan, Stage.ACTIVE)
    missing = {"/robot_3/filter_3", "/robot_7/sensor_7"}
    states = {"/robot_1/filter_1": "inactive", "/robot_2/logger_2": "unconfigured"}
    observation = Observation(
        nodes=(
            *(
                replace(each, state=states.get(each.full_name, each.state))
                for each in seen.nodes
                if each.full_name not in missing
            ),
            ObservedNode(full_name="/rogue", managed=True),
        ),
        endpoints=(
            *(each for each in seen.endpoints if each.node not in missing),
            ObservedEndpoint(
                kind=PUBLISHER, node="/rogue", name="/robot_5/map", type=STRING, qos=QosProfile()
            ),
        ),
        configurations=tuple(
            replace(each, state=states.get(each.name, each.state))
            for each in seen.configurations
            if each.name not in missing
        ),
    )
    supervised = {
        "/robot_7/sensor_7": Supervised(pid=4711, dead=True),
        "/robot_8/filter_8": Supervised(pid=4712, silent=True),
    }
    return drawn(plan, observation, phase="active", supervised=supervised)
