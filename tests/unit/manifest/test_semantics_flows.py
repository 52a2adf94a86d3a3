"""Checks of flow needs and links; the limits of *Unique Network Flows*."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from msgspec.structs import replace

from lifecycle.manifest.checks.registry import check
from lifecycle.manifest.model import (
    EndpointKind,
    FlowIdentification,
    FlowNeed,
    Machine,
    Manifest,
    Network,
    UniqueHow,
)
from lifecycle.manifest.qos import QosProfile, Reliability
from lifecycle.network.nfe import UniqueRequirement
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


def streams(count: int, *, need: FlowNeed) -> Manifest:
    """Return `count` marked publishers, in as many nodes, each with a weakly unique link."""
    names = [f"s{index}" for index in range(count)]
    sources = [
        node(
            f"n{index}",
            publisher(name, EMPTY),
            needs=(replace(need, name=name, dscp=index % 64, at=at(index + 1)),),
            machine=f"n{index}",
        )
        for index, name in enumerate(names)
    ]
    sink = node("sink", *(subscription(name, EMPTY) for name in names), machine="sink")
    return manifest(
        *sources,
        sink,
        links=(
            link(f"/{name}", f"n{index}", "sink", unique=UniqueHow.WEAKLY)
            for index, name in enumerate(names)
        ),
        machines=tuple(
            Machine(name=each.key, address=f"10.0.0.{index}", at=at(1))
            for index, each in enumerate((*sources, sink), start=1)
        ),
    )


MARKED = FlowNeed(kind=EndpointKind.PUBLISHER, name="", dscp=0, at=at(1))


def test_sixty_four_publishers_can_be_told_apart_by_dscp_alone() -> None:
    assert check(streams(64, need=MARKED)) == ()


def test_publishers_that_ask_to_be_unique_do_not_rely_on_their_dscp() -> None:
    need = replace(MARKED, unique=UniqueRequirement.OPTIONALLY_REQUIRED)
    assert check(streams(70, need=need)) == ()


def test_a_dscp_that_no_link_needs_as_identifier_may_be_shared() -> None:
    made = streams(70, need=MARKED)
    links = tuple(replace(link, unique=UniqueHow.NOT) for link in made.links)
    assert check(replace(made, links=links)) == ()


def acknowledging(reliability: Reliability, **marks: int | None) -> Manifest:
    """A stream whose subscription is marked."""
    made = streams(1, need=MARKED)
    given = {"dscp": 48, **marks}
    need = replace(MARKED, kind=EndpointKind.SUBSCRIPTION, name="s0", **given)
    sink = made.nodes[1]
    (endpoint,) = sink.interface.endpoints
    qos = replace(endpoint.qos or QosProfile(), reliability=reliability)
    interface = replace(sink.interface, endpoints=(replace(endpoint, qos=qos),))
    sink = replace(sink, interface=interface, flows=(need,))
    return replace(made, nodes=(made.nodes[0], sink))


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


def test_a_subscription_may_not_acknowledge_with_what_identifies_a_publisher() -> None:
    network = Network(flow_identification=FlowIdentification.DSCP)
    made = acknowledging(Reliability.RELIABLE, dscp=MARKED.dscp)
    found = check(replace(made, network=network))
    assert [each.rule for each in found if each.severity.value == "error"] == [
        "check.dscp-not-unique"
    ]
    assert "cannot give subscription '/s0' of" in str(found[0])


def test_the_mark_of_a_subscription_makes_no_flow_unique() -> None:
    made = acknowledging(Reliability.RELIABLE)
    source = replace(made.nodes[0], flows=())
    found = check(replace(made, nodes=(source, made.nodes[1])))
    assert [each.rule for each in found] == ["check.link-not-unique"]


def test_a_link_that_relies_on_a_dscp_counts_as_an_identifier_too() -> None:
    network = Network(flow_identification=FlowIdentification.DSCP)
    found = check(replace(streams(65, need=MARKED), network=network))
    assert [str(each) for each in found] == [
        (
            f"{FILE}:65:1: cannot give publisher '/s64' of 'n64' DF = DSCP 0 = TOS 0 (0x00): it "
            f"identifies '/s0' of 'n0' ({FILE}:10:9); give it another DSCP, or none: then it gets "
            "one that nobody has"
        )
    ]
