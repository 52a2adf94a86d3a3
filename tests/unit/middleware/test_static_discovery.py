"""The table of endpoints that are not announced, and how an endpoint finds its line."""

from __future__ import annotations

from xml.etree import ElementTree as ET

import pytest
from msgspec.structs import replace

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.static_edp import (
    check_endpoint,
    endpoint_profiles,
    endpoint_table,
)
from lifecycle.plan.model import StaticEndpoint, StaticParticipant

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
    told = {
        each.findtext("name"): [(end.tag, {v.tag: v.text for v in end}) for end in each[1:]]
        for each in root
    }
    common = {"topicName": "rt/x", "topicDataType": _STRING, "topicKind": "NO_KEY"}
    one = {
        "userId": "1",
        **common,
        "reliabilityQos": "RELIABLE_RELIABILITY_QOS",
        "durabilityQos": "TRANSIENT_LOCAL_DURABILITY_QOS",
    }
    other = {
        "userId": "32767",
        **common,
        "reliabilityQos": "BEST_EFFORT_RELIABILITY_QOS",
        "durabilityQos": "VOLATILE_DURABILITY_QOS",
    }
    assert told == {"/a": [("writer", one)], "/b": [("reader", other)]}


def test_profiles_are_named_as_rmw_looks_for_them_and_give_the_id() -> None:
    text = endpoint_profiles([line("/x", 3), line("/y", 4, writer=False)])
    root = ET.fromstring(text.replace(" xmlns=", " x="))
    assert [
        (each.tag, each.get("profile_name"), each.findtext("userDefinedID"))
        for each in root.findall("./profiles/*")
    ] == [("data_writer", "/x", "3"), ("data_reader", "/y", "4")]


def test_an_endpoint_is_found_by_direction_name_and_type_together() -> None:
    lines = [
        line("/x", 1, writer=False),
        replace(line("/x", 2), type="std_msgs::msg::dds_::Int32_"),
        line("/y", 3),
        line("/x", 4),
    ]
    check_endpoint(lines, writer=True, profile="/x", type_name=_STRING)
    with pytest.raises(MiddlewareError):
        check_endpoint(lines[:3], writer=True, profile="/x", type_name=_STRING)


@pytest.mark.parametrize(
    ("lines", "listed"),
    [((line("/x", 1), line("/y", 2, writer=False)), f"/x ({_STRING})"), ((), "none")],
)
def test_an_endpoint_that_nobody_would_find_is_refused(
    lines: tuple[StaticEndpoint, ...], listed: str
) -> None:
    with pytest.raises(MiddlewareError) as refused:
        check_endpoint(lines, writer=True, profile="/y", type_name=_STRING)
    assert str(refused.value) == (
        f"cannot make a writer of '/y' ({_STRING}): the table of static discovery has only these "
        f"writers for this participant: {listed}; declare the endpoint, and check or plan again"
    )
