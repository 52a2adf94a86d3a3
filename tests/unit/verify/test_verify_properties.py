"""Whatever the system: seen exactly as planned it is ok, and no missing fact goes unnoticed."""

from __future__ import annotations

import random

from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import PRESETS
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.model import Plan
from lifecycle.verify.observation import Observation
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Stage
from tests.builders import endpoint, need, node, planned
from tests.unit.verify.lines import verify
from tests.unit.verify.perfect import perfect

TYPES = {
    EndpointKind.PUBLISHER: "std_msgs/msg/String",
    EndpointKind.SUBSCRIPTION: "std_msgs/msg/String",
    EndpointKind.SERVICE_SERVER: "std_srvs/srv/Trigger",
    EndpointKind.SERVICE_CLIENT: "std_srvs/srv/Trigger",
    EndpointKind.ACTION_SERVER: "robot/action/Dock",
    EndpointKind.ACTION_CLIENT: "robot/action/Dock",
}
COMPATIBLE = ("default", "sensor_data", "parameters")


@st.composite
def systems(draw: st.DrawFn) -> Plan:
    """A few nodes of ours with endpoints of every kind; names never collide inside a node."""
    nodes = []
    for index in range(draw(st.integers(1, 4))):
        wanted = draw(
            st.lists(
                st.tuples(st.sampled_from(EndpointKind), st.sampled_from(["a", "b", "/c", "~/d"])),
                unique=True,
                max_size=6,
            )
        )
        endpoints, needs = [], []
        for kind, name in wanted:
            is_action = TYPES[kind].startswith("robot/action/")
            # a publisher offers the most, so that every pair of presets fits
            preset = (
                draw(st.sampled_from(COMPATIBLE))
                if kind is EndpointKind.SUBSCRIPTION
                else "default"
            )
            # topics, services and actions have name spaces of their own
            declared = f"{name}_{TYPES[kind].split('/')[1]}"
            qos = None if is_action else PRESETS[preset]
            endpoints.append(endpoint(kind, declared, TYPES[kind], qos, line=len(endpoints) + 1))
            if kind in (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION):
                unique = draw(st.sampled_from(UniqueRequirement))
                dscp = (
                    draw(st.none() | st.integers(0, 63)) if kind is EndpointKind.PUBLISHER else None
                )
                needs.append(need(kind, declared, unique, dscp=dscp))
        nodes.append(
            node(
                f"n{index}",
                *endpoints,
                needs=needs,
                namespace=draw(st.sampled_from(["/", "/robot"])),
                machine=draw(st.sampled_from(["", "robot"])),
                managed=draw(st.booleans()),
            )
        )
    return planned(*nodes)


@settings(max_examples=60, deadline=None)
@given(systems(), st.sampled_from(Stage))
def test_a_perfect_observation_is_ok(plan: Plan, stage: Stage):
    verdict = verify(plan, perfect(plan, stage), stage=stage)
    assert (verdict.findings, verdict.verdict) == ((), Outcome.OK)
    assert all(flow.outcome is Outcome.OK for flow in verdict.flows)
    assert len(verdict.flows) == len(plan.flows)


@settings(max_examples=60, deadline=None)
@given(systems(), st.sampled_from(Stage), st.data())
def test_no_dropped_fact_leaves_the_verdict_ok(plan: Plan, stage: Stage, data: st.DataObject):
    seen = perfect(plan, stage)
    planned_names = {each.full_name for each in plan.nodes}
    drops: list[Observation] = [
        replace(seen, nodes=tuple(each for each in seen.nodes if each is not gone))
        for gone in seen.nodes
        if gone.full_name in planned_names
    ]
    drops += [
        replace(seen, endpoints=tuple(each for each in seen.endpoints if each is not gone))
        for gone in seen.endpoints
    ]
    drops += [
        replace(
            seen, configurations=tuple(each for each in seen.configurations if each is not gone)
        )
        for gone in seen.configurations
    ]
    drops += [
        replace(
            seen,
            configurations=tuple(
                replace(
                    each, endpoints=tuple(report for report in each.endpoints if report is not gone)
                )
                for each in seen.configurations
            ),
        )
        for configuration in seen.configurations
        for gone in configuration.endpoints
    ]
    poorer = data.draw(st.sampled_from(drops))
    verdict = verify(plan, poorer, stage=stage)
    assert verdict.verdict is Outcome.VIOLATED
    assert verdict.blocking


@settings(max_examples=40, deadline=None)
@given(systems(), st.integers(), st.data())
def test_the_verdict_does_not_depend_on_the_order_of_what_was_seen(
    plan: Plan, seed: int, data: st.DataObject
):
    seen = perfect(plan)
    if seen.endpoints and data.draw(st.booleans()):
        seen = replace(seen, endpoints=seen.endpoints[1:])
    chance = random.Random(seed)

    def shuffled(items: tuple) -> tuple:
        return tuple(chance.sample(items, len(items)))

    other = Observation(
        nodes=shuffled(seen.nodes),
        endpoints=shuffled(seen.endpoints),
        configurations=shuffled(seen.configurations),
    )
    assert verify(plan, other, stage=Stage.CONNECTED) == verify(plan, seen, stage=Stage.CONNECTED)
