"""The checks together: everything at once, in order, and quickly."""

from __future__ import annotations

import time
from collections.abc import Callable

from hypothesis import given
from hypothesis import strategies as st

from lifecycle.manifest.checks import check
from lifecycle.manifest.model import (
    After,
    Condition,
    Discovery,
    Endpoint,
    EndpointKind,
    FlowNeed,
    Interface,
    Link,
    Machine,
    Node,
    Run,
    RunKind,
    UniqueHow,
)
from lifecycle.manifest.qos import PRESETS
from lifecycle.network.nfe import UniqueRequirement
from tests.builders import at, endpoint, manifest, node

Findings = Callable[..., list[str]]


def test_findings_of_all_topics_come_together_in_the_documents_order(findings: Findings) -> None:
    found = findings("""
        nodes:
          camera:
            run: {python: "demo:Camera"}
            machine: nowhere
            after: {camera: active}
            parameters: {rte: 1.0}
            remap: {a*: b}
            interface:
              publishers: [{name: video, type: std_msgs/msg/Sting, qos: sensor_data}]
              parameters: {rate: {type: double}}
            flows: {publishers: {vid: {unique: strictly_required}}}
          viewer:
            name: camera
            run: {python: "demo:Viewer"}
            interface:
              subscriptions: [{name: video, type: std_msgs/msg/Sting}]
        links: [{topic: /video, from: camra, to: viewer}]
    """)
    assert [each.split(": ")[0] for each in found] == [
        "check.unknown-machine 6:14",
        "check.after-self 7:13",
        "check.parameter-undeclared 8:18",
        "check.remap-rule 9:13",
        "check.type-unknown 11:20",
        "check.flow-unknown-endpoint 13:26",
        "check.duplicate-node 14:3",
        "check.type-unknown 18:23",
        "check.qos-incompatible 18:23",
        "check.link-unknown-node 19:9",
    ]


def test_ten_thousand_endpoints_are_checked_within_seconds() -> None:
    def many(index: int) -> Node:
        endpoints = (
            endpoint(kind, f"/topic_{(index + shift) % 100}_{number}", "std_msgs/msg/Empty")
            for kind, shift in ((EndpointKind.PUBLISHER, 0), (EndpointKind.SUBSCRIPTION, 1))
            for number in range(50)
        )
        remap = (("nothing", "something"), ("more", "less"))
        return node(f"n{index}", *endpoints, machine="m", remap=remap)

    system = manifest(*(many(index) for index in range(100)), machines=(Machine(name="m", at=AT),))
    start = time.process_time()
    found = check(system)
    assert {each.rule for each in found} == {"check.remap-unused"}
    assert time.process_time() - start < 10


AT = at(1)
texts = st.sampled_from(["a", "b", "/a", "~/a", "~", "{ns}/a", "1a", "", "a b", "/", "x" * 250])
types_ = st.sampled_from(["std_msgs/msg/Empty", "std_msgs/msg/Nothing", "acme/msg/A", ""])
endpoints = st.builds(
    Endpoint,
    kind=st.sampled_from(EndpointKind),
    name=texts,
    type=types_,
    qos=st.one_of(st.none(), st.sampled_from(list(PRESETS.values()))),
    at=st.just(AT),
)
needs = st.builds(
    FlowNeed,
    kind=st.sampled_from([EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION]),
    name=texts,
    unique=st.sampled_from(UniqueRequirement),
    dscp=st.one_of(st.none(), st.integers(-1, 64)),
    at=st.just(AT),
)
nodes = st.builds(
    Node,
    key=st.sampled_from("abc"),
    name=texts,
    namespace=st.sampled_from(["/", "/n", "n", "", "/" + "y" * 240]),
    machine=st.sampled_from(["m", ""]),
    run=st.builds(Run, kind=st.sampled_from(RunKind)),
    managed=st.booleans(),
    process=st.sampled_from(["", "a", "p"]),
    parameters=st.just((("rate", 1),)),
    parameter_files=st.sampled_from([(), ("/nonexistent/p.yaml",)]),
    remap=st.lists(st.tuples(texts, texts), max_size=3).map(tuple),
    after=st.lists(
        st.builds(
            After,
            node=st.sampled_from("abcd"),
            condition=st.sampled_from(Condition),
            at=st.just(AT),
        ),
        max_size=2,
    ).map(tuple),
    interface=st.builds(Interface, endpoints=st.lists(endpoints, max_size=4).map(tuple)),
    flows=st.lists(needs, max_size=2).map(tuple),
    at=st.just(AT),
)
links = st.builds(
    Link,
    topic=texts,
    from_node=st.sampled_from("abcd"),
    to_node=st.sampled_from("abcd"),
    unique=st.sampled_from(UniqueHow),
    at=st.just(AT),
)


@given(
    st.lists(nodes, max_size=3, unique_by=lambda node: node.key),
    st.lists(links, max_size=2),
    st.integers(-1, 233),
)
def test_any_manifest_gets_findings_never_an_exception(
    some: list[Node], demands: list[Link], domain: int
) -> None:
    system = manifest(
        *some,
        links=demands,
        machines=(Machine(name="m", at=AT),),
        discovery=Discovery(domain_id=domain),
    )
    found = check(system, environment={})
    assert all(each.message.startswith("cannot ") for each in found)
    assert all(each.rule.startswith("check.") for each in found)
    assert len(set(found)) == len(found)
