"""Graph messages: their JSON, their schema, and what is not one."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jsonschema
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated import ManualScheduler, Network

from lifecycle.graph.events import GraphEvents
from lifecycle.graph.messages import (
    MESSAGES,
    ConfigurationChanged,
    ConnectionEstablished,
    ConnectionLost,
    GraphMessage,
    GraphMessageError,
    Heartbeat,
    Joined,
    Left,
    MappingEstablished,
    MappingLost,
    StateChanged,
    decode,
    encode,
    new_incarnation,
)

SCHEMA = json.loads(
    (Path(__file__).parents[3] / "schemas" / "graph_message.v1.schema.json").read_text()
)
HEADER = {"node": "/robot/camera", "incarnation": "1", "sequence": 3}
SAMPLES: list[GraphMessage] = [
    Joined(**HEADER, state="inactive", connected=True, checksum="ab"),
    Left(**HEADER, reason="shutdown"),
    StateChanged(**HEADER, state="active", connected=True),
    Heartbeat(**HEADER, state="active", connected=True, checksum="ab"),
    ConfigurationChanged(**HEADER, checksum="cd"),
    ConnectionEstablished(**HEADER, connection="net", urls=("shm://",)),
    ConnectionLost(**HEADER, connection="net", urls=("shm://",), error="unplugged"),
    MappingEstablished(**HEADER, endpoint="publishers/video", connection="net", matched=2),
    MappingLost(**HEADER, endpoint="publishers/video", connection="net", error="gone"),
]


def test_there_is_a_sample_of_every_message() -> None:
    assert {type(each) for each in SAMPLES} == set(MESSAGES)


@pytest.mark.parametrize("message", SAMPLES, ids=lambda each: each.kind.value)
def test_a_message_comes_back_as_it_was_and_fits_the_schema(message: GraphMessage) -> None:
    data = encode(message)
    assert decode(data) == message
    jsonschema.Draft202012Validator(SCHEMA).validate(json.loads(data))


@pytest.mark.parametrize("type_", MESSAGES, ids=lambda each: each.kind.value)
def test_the_schema_has_exactly_the_fields_of_a_message(type_: type[GraphMessage]) -> None:
    fields = {each.name for each in dataclasses.fields(type_)}
    definition = SCHEMA["$defs"][type_.__name__]
    assert set(definition["properties"]) == fields | {"version", "kind"}
    assert set(definition["required"]) == set(definition["properties"])


def test_fields_that_nobody_knows_are_passed_over() -> None:
    document = {**json.loads(encode(SAMPLES[0])), "colour": "red"}
    assert decode(json.dumps(document)) == SAMPLES[0]


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"hello", "cannot read a graph message: JSON is malformed: invalid character (byte 0)"),
        (b"\xff\xfe", "cannot read a graph message: JSON is malformed: invalid character (byte 0)"),
        (b"x" * 70_000, "cannot read a graph message of 70000 bytes; at most 65536"),
        (
            b'{"version":2,"kind":"joined"}',
            (
                "cannot read a graph message of version 2 and kind 'joined'; known are version 1"
                " and joined, left, state_changed, heartbeat, configuration_changed,"
                " connection_established, connection_lost, mapping_established, mapping_lost"
            ),
        ),
        (
            b'{"version":1,"kind":"left","node":"camera","incarnation":"1","sequence":1}',
            (
                "cannot read a graph message: cannot be from node 'camera', incarnation '1',"
                " sequence 1"
            ),
        ),
        (
            b'{"version":1,"kind":"left","node":"/camera","incarnation":"1"}',
            "cannot read a graph message: Object missing required field `sequence`",
        ),
    ],
)
def test_what_is_no_message_is_refused_with_the_reason(data: bytes, reason: str) -> None:
    with pytest.raises(GraphMessageError) as refusal:
        decode(data)
    assert str(refusal.value) == reason


@given(st.binary() | st.text().map(str.encode) | st.integers(0, 20_000).map(lambda n: b"[" * n))
def test_no_bytes_make_decoding_crash(data: bytes) -> None:
    with pytest.raises(GraphMessageError):
        decode(data)


def test_what_is_no_message_is_counted_and_ignored() -> None:
    scheduler = ManualScheduler()
    network = Network(scheduler)
    events = GraphEvents(network.transport(), scheduler)
    sender = network.transport()
    sender.send(b"hello")
    sender.send(b'{"version":1,"kind":"dance"}')
    sender.send(encode(Joined(node="/a", incarnation="1", sequence=1)))
    assert events.ignored == 2
    assert [each.node for each in events.members()] == ["/a"]


def test_a_later_incarnation_compares_greater() -> None:
    made = [new_incarnation() for _ in range(100)]
    assert made == sorted(made)
    assert len(set(made)) == 100
