"""Checks of flow needs and links; the limits of *Unique Network Flows*."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from msgspec.structs import replace

from lifecycle.manifest.checks import check
from lifecycle.manifest.model import (
    EndpointKind,
    FlowNeed,
    Machine,
    Manifest,
    UniqueHow,
)
from lifecycle.manifest.qos import QosProfile, Reliability
from tests.builders import FILE, at, link, manifest, node, publisher, subscription

Findings = Callable[..., list[str]]
EMPTY = "std_msgs/msg/Empty"

PAIR = """
nodes:
  camera:
    run: {{python: "demo:Camera"}}
    interface:
      publishers: [{{name: video, type: sensor_msgs/msg/Image}}]
    flows: {{publishers: {{video: {publisher}}}}}
  viewer:
    run: {{python: "demo:Viewer"}}
    interface:
      subscriptions: [{{name: video, type: sensor_msgs/msg/Image}}]
    flows: {{subscriptions: {{video: {subscription}}}}}
links:
  - {{topic: /video, from: camera, to: viewer, unique: {demand}}}
"""
YES, SOME, ANY, NO = (
    f"{{unique: {each}}}"
    for each in ("strictly_required", "optionally_required", "system_default", "not_required")
)


@pytest.mark.parametrize(
    ("demand", "publisher", "subscription", "missing"),
    [
        ("strongly", YES, YES, []),
        ("strongly", SOME, ANY, []),
        ("strongly", YES, NO, ["subscription 'video' of 'viewer'"]),
        ("strongly", NO, YES, ["publisher 'video' of 'camera'"]),
        (
            "strongly",
            NO,
            NO,
            ["publisher 'video' of 'camera'", "subscription 'video' of 'viewer'"],
        ),
        ("strongly", "{dscp: EF}", YES, ["publisher 'video' of 'camera'"]),
        ("weakly", YES, NO, []),
        ("weakly", NO, SOME, []),
        ("weakly", "{dscp: EF}", NO, []),
        (
            "weakly",
            NO,
            NO,
            ["neither publisher 'video' of 'camera' nor subscription 'video' of 'viewer'"],
        ),
        ("not", NO, NO, []),
    ],
)
def test_a_link_demands_what_its_ends_must_ask_for(
    findings: Findings, demand: str, publisher: str, subscription: str, missing: list[str]
) -> None:
    found = findings(PAIR.format(demand=demand, publisher=publisher, subscription=subscription))
    assert len(found) == len(missing)
    for text, name in zip(found, missing, strict=True):
        asks = "asks" if name.startswith("neither") else "does not ask"
        assert text.startswith(
            f"check.link-not-unique 15:5: links[0]: cannot make the flow of '/video' {demand} "
            f"unique: {name} {asks} to be unique; add 'video: {{unique: strictly_required}}' to "
        )


MARKED = FlowNeed(kind=EndpointKind.PUBLISHER, name="", dscp=0, at=at(1))


def acknowledging(reliability: Reliability, **changes: object) -> Manifest:
    """A stream whose subscription is marked."""
    source = node("n0", publisher("s0", EMPTY), needs=[replace(MARKED, name="s0")])
    need = replace(MARKED, kind=EndpointKind.SUBSCRIPTION, name="s0", dscp=48, **changes)
    endpoint = subscription("s0", EMPTY, qos=replace(QosProfile(), reliability=reliability))
    sink = node("sink", endpoint, needs=[need])
    links = [link("/s0", "n0", "sink", unique=UniqueHow.WEAKLY)]
    return manifest(source, sink, links=links, machines=[Machine(name="", at=at(1))])


def test_a_reliable_subscription_can_be_marked_as_it_acknowledges() -> None:
    assert [str(each) for each in check(acknowledging(Reliability.RELIABLE))] == []


def test_a_best_effort_subscription_is_told_that_it_sends_nothing_to_mark() -> None:
    (found,) = check(acknowledging(Reliability.BEST_EFFORT))
    assert found.severity.value == "note"
    assert str(found) == (
        f"{FILE}:1:1: note: cannot mark anything that subscription 's0' sends with a DSCP: it "
        "is BEST_EFFORT and acknowledges nothing; make it RELIABLE, or mark the publishers of the "
        "topic"
    )


def test_a_subscription_has_one_mark_too() -> None:
    (found,) = check(acknowledging(Reliability.RELIABLE, transport_priority=0x20))
    assert found.message == ("cannot give subscription 's0' both dscp and transport_priority")


def test_the_mark_of_a_subscription_makes_no_flow_unique() -> None:
    made = acknowledging(Reliability.RELIABLE)
    source = replace(made.nodes[0], flows=())
    found = check(replace(made, nodes=(source, made.nodes[1])))
    assert [each.rule for each in found] == ["check.link-not-unique"]
