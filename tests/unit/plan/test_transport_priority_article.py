"""*RTI Connext Micro, Transport Priority* (section 3.24) as the manifest applies it.

The mapping itself is tested in tests/unit/network/test_transport_priority.py.
"""

from __future__ import annotations

import pytest

from lifecycle.manifest.checks import check
from lifecycle.manifest.loading import load
from lifecycle.manifest.model import EndpointKind, Machine, Manifest, Network
from lifecycle.network.dscp import TransportPriorityMapping
from lifecycle.plan.build import build_plan
from lifecycle.plan.model import PlanError
from lifecycle.verify.judge import verify
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Stage
from tests.builders import at, manifest, need, node, publisher
from tests.unit.verify.edits import change_report
from tests.unit.verify.perfect import perfect

PUB = EndpointKind.PUBLISHER


def writers(*priorities: int, mapping: TransportPriorityMapping | None = None, **rest: object):
    """One node with a publisher for each priority."""
    names = [f"w{index}" for index in range(len(priorities))]
    return manifest(
        node(
            "n",
            *(publisher(name, "std_msgs/msg/Empty") for name in names),
            needs=[
                need(PUB, name, transport_priority=priority, **rest)
                for name, priority in zip(names, priorities, strict=True)
            ],
        ),
        machines=(Machine(name="", at=at(1)),),
        network=Network(transport_priority_mapping=mapping),
    )


def dscps(system: Manifest) -> list[int | None]:
    return [each.dscp for each in build_plan(system, environment={}).nodes[0].endpoints]


def errors(system: Manifest) -> list[str]:
    return [
        each.message for each in check(system, environment={}) if each.severity.value == "error"
    ]


@pytest.mark.parametrize(
    ("priority", "mask", "low", "high", "tos"),
    [
        (0xB8, 0xFF, 0, 0xFF, 0xB8),
        (0x00, 0x03, 0, 0x03, 0x00),
        (0x01, 0x03, 0, 0x3F, 0x15),
        (0x02, 0x03, 0, 0x3F, 0x2A),
        (0x03, 0x03, 0, 0x3F, 0x3F),
    ],
)
def test_section_3_24_3_examples_become_marks_or_are_refused_for_their_ecn_bits(
    priority: int, mask: int, low: int, high: int, tos: int
):
    system = writers(priority, mapping=TransportPriorityMapping(mask=mask, low=low, high=high))
    if tos & 0b11:
        (message,) = errors(system)
        assert f"it is TOS {tos} ({tos:#04x}), whose two lowest bits are ECN" in message
        with pytest.raises(PlanError):
            build_plan(system, environment={})
    else:
        assert errors(system) == []
        assert dscps(system) == [tos >> 2]


def test_section_3_24_2_expedited_forwarding_is_0xb8_which_is_dscp_101110_and_ecn_00():
    system = writers(0xB8)
    assert dscps(system) == [0b101110]
    plan = build_plan(system, environment={})
    assert plan.nodes[0].participants[0].reason.endswith("EF = DSCP 46 = TOS 184 (0xb8)")


def test_section_3_24_1_bits_outside_the_mask_do_not_take_part_and_that_is_said():
    system = writers(0x1B8, mapping=TransportPriorityMapping(mask=0xFF))
    assert dscps(system) == [46]
    assert [
        each.message for each in check(system, environment={}) if "transport-prio" in each.rule
    ] == ["cannot map bits 0x100 of transport_priority 440 (0x1b8): they are outside mask 0xff"]


def test_section_3_24_2_a_priority_is_per_datawriter():
    assert dscps(writers(0xB8, 0x20)) == [46, 8]


def test_section_3_24_2_a_priority_is_per_datareader_and_independent_of_the_datawriters(
    tmp_path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.lifecycle.yaml").write_text(
        "manifest_version: 1\nsystem: s\nnodes:\n  n:\n    run: {python: 'm:C'}\n    interface:\n"
        "      subscriptions:\n"
        "        - {name: a, type: std_msgs/msg/Empty}\n"
        "        - {name: b, type: std_msgs/msg/Empty}\n"
        "        - {name: c, type: std_msgs/msg/Empty}\n"
        "        - {name: d, type: std_msgs/msg/Empty}\n"
        "      publishers:\n"
        "        - {name: a, type: std_msgs/msg/Empty}\n"
        "        - {name: e, type: std_msgs/msg/Empty}\n"
        "    flows:\n"
        "      subscriptions:\n"
        "        a: {transport_priority: 184}\n"
        "        b: {dscp: EF}\n"
        "        d: {dscp: CS6}\n"
        "      publishers:\n"
        "        e: {transport_priority: 184}\n"
        "policy: {unheard: ignore, unpublished: ignore}\n"
    )
    (one,) = build_plan(load("s.lifecycle.yaml").manifest, environment={}).nodes
    found = {(each.kind.noun, each.name): (each.dscp, each.participant) for each in one.endpoints}
    # One set of send sockets for a mark, and none of them shared by a writer and a reader.
    ef = found["subscription", "a"][1]
    assert found["subscription", "a"] == found["subscription", "b"] == (46, ef)
    assert found["subscription", "c"] == found["publisher", "a"] == (None, "")
    assert found["subscription", "d"][0] == 48
    assert found["publisher", "e"][0] == 46
    assert len({ef, found["subscription", "d"][1], found["publisher", "e"][1]}) == 3
    assert {each.name: each.reason for each in one.participants}[ef] == (
        "subscriptions a, b marked EF = DSCP 46 = TOS 184 (0xb8)"
    )


@pytest.mark.parametrize(
    ("enforce", "outcome", "blocking"),
    [(True, Outcome.VIOLATED, True), (False, Outcome.UNVERIFIABLE, False)],
)
def test_section_3_24_4_a_priority_that_could_not_be_set_fails_unless_not_enforced(
    enforce: bool, outcome: Outcome, blocking: bool
):
    plan = build_plan(writers(0xB8, enforce=enforce), environment={})
    seen = change_report(PUB, "/w0", dscp=0)(perfect(plan))
    verdict = verify(plan, seen, stage=Stage.CONNECTED)
    assert (verdict.verdict, verdict.blocking) == (outcome, blocking)
    assert [each.rule for each in verdict.findings] == ["flow.dscp-not-applied"]


@pytest.mark.parametrize(
    ("priorities", "sockets"), [((0xB8, 0xB8, 0xB8), 1), ((0xB8, 0x20, 0xB8, 0x40), 3)]
)
def test_section_3_24_5_one_set_of_send_sockets_per_distinct_priority(
    priorities: tuple[int, ...], sockets: int
):
    plan = build_plan(writers(*priorities), environment={})
    assert len(plan.nodes[0].participants) == sockets
