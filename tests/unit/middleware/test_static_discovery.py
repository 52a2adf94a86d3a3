"""The table of endpoints that are not announced, and how an endpoint finds its line."""

from __future__ import annotations

import dataclasses
from xml.etree import ElementTree as ET

import pytest

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.participant_profile import (
    endpoint_profiles,
    endpoint_table,
    find_endpoint,
    own_endpoints,
)
from lifecycle.plan.model import GRAPH_TOPIC, GRAPH_TYPE, StaticEndpoint, StaticParticipant

_STRING = "std_msgs::msg::dds_::String_"


def line(topic: str, user_id: int, *, writer: bool = True, **changes: bool) -> StaticEndpoint:
    return StaticEndpoint(
        writer=writer,
        topic=f"rt{topic}",
        type=_STRING,
        profile=topic,
        user_id=user_id,
        **changes,
    )


def graph(user_id: int, *, writer: bool) -> StaticEndpoint:
    return StaticEndpoint(
        writer=writer,
        topic=GRAPH_TOPIC,
        type=GRAPH_TYPE,
        profile=GRAPH_TOPIC,
        user_id=user_id,
        transient_local=True,
    )


def participant(name: str, *endpoints: StaticEndpoint) -> StaticParticipant:
    return StaticParticipant(name=name, endpoints=endpoints)


def test_the_table_says_of_each_endpoint_what_matching_needs() -> None:
    root = ET.fromstring(
        endpoint_table(
            [
                participant("/a", line("/x", 1, transient_local=True)),
                participant("/b", line("/x", 32767, writer=False, reliable=False)),
            ]
        )
    )
    assert root.tag == "staticdiscovery"
    told = [
        (each.findtext("name"), [(end.tag, {v.tag: v.text for v in end}) for end in each[1:]])
        for each in root
    ]
    common = {"topicName": "rt/x", "topicDataType": _STRING, "topicKind": "NO_KEY"}
    assert told == [
        (
            "/a",
            [
                (
                    "writer",
                    {
                        "userId": "1",
                        **common,
                        "reliabilityQos": "RELIABLE_RELIABILITY_QOS",
                        "durabilityQos": "TRANSIENT_LOCAL_DURABILITY_QOS",
                    },
                )
            ],
        ),
        (
            "/b",
            [
                (
                    "reader",
                    {
                        "userId": "32767",
                        **common,
                        "reliabilityQos": "BEST_EFFORT_RELIABILITY_QOS",
                        "durabilityQos": "VOLATILE_DURABILITY_QOS",
                    },
                )
            ],
        ),
    ]


@pytest.mark.parametrize("user_id", [0, 32768])
def test_an_id_that_fast_dds_cannot_read_is_refused(user_id: int) -> None:
    with pytest.raises(MiddlewareError) as refused:
        endpoint_table([participant("/a", line("/x", user_id))])
    assert str(refused.value) == (f"cannot use id {user_id} for '/x' of '/a': allowed are 1–32767")


def test_an_id_that_another_participant_has_is_refused() -> None:
    with pytest.raises(MiddlewareError) as refused:
        endpoint_table([participant("/a", line("/x", 7)), participant("/b", line("/y", 7))])
    assert str(refused.value) == "cannot use id 7 for '/y' of '/b': '/x' of '/a' has it"


def test_profiles_are_named_as_rmw_looks_for_them_and_give_the_id() -> None:
    text = endpoint_profiles([line("/x", 3), line("/y", 4, writer=False)])
    root = ET.fromstring(text.replace(" xmlns=", " x="))
    assert [
        (each.tag, each.get("profile_name"), each.findtext("userDefinedID"))
        for each in root.findall("./profiles/*")
    ] == [("data_writer", "/x", "3"), ("data_reader", "/y", "4")]


def test_a_participant_gets_its_own_lines() -> None:
    own = (line("/x", 1), graph(2, writer=True), graph(3, writer=False))
    other = participant("/b", line("/x", 4, writer=False))
    assert own_endpoints("/a", [other, participant("/a", *own)]) == own


def test_a_participant_that_is_not_in_the_table_is_refused() -> None:
    with pytest.raises(MiddlewareError) as refused:
        own_endpoints("/c", [participant("/a"), participant("/b")])
    assert str(refused.value) == (
        "cannot find participant '/c' in the table of static discovery: it has '/a', '/b'"
    )


@pytest.mark.parametrize(("kept", "missing"), [(True, "reader"), (False, "writer")])
def test_a_participant_needs_both_ends_of_the_topic_of_rmw(kept: bool, missing: str) -> None:
    with pytest.raises(MiddlewareError) as refused:
        own_endpoints("/a", [participant("/a", graph(1, writer=kept))])
    assert str(refused.value) == (
        f"cannot discover endpoints of '/a' statically: the table has no {missing} of "
        f"'{GRAPH_TOPIC}' for it, which every participant of rmw_fastrtps has; add one of type "
        f"{GRAPH_TYPE}, reliable and transient local"
    )


def test_an_endpoint_is_found_by_direction_name_and_type_together() -> None:
    lines = [
        line("/x", 1, writer=False),
        dataclasses.replace(line("/x", 2), type="std_msgs::msg::dds_::Int32_"),
        line("/y", 3),
        line("/x", 4),
    ]
    found = find_endpoint(lines, writer=True, profile="/x", type_name=_STRING)
    assert found.user_id == 4


@pytest.mark.parametrize(
    ("lines", "listed"),
    [((line("/x", 1), line("/y", 2, writer=False)), f"/x ({_STRING})"), ((), "none")],
)
def test_an_endpoint_that_nobody_would_find_is_refused(
    lines: tuple[StaticEndpoint, ...], listed: str
) -> None:
    with pytest.raises(MiddlewareError) as refused:
        find_endpoint(lines, writer=True, profile="/y", type_name=_STRING)
    assert str(refused.value) == (
        f"cannot make a writer of '/y' ({_STRING}): the table of static discovery has only these "
        f"writers for this participant: {listed}; declare the endpoint, and check or plan again"
    )
