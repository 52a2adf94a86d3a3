"""What a node says of itself, as JSON."""

from __future__ import annotations

import json

import jsonschema
import pytest

from lifecycle.graph.status import (
    LONGEST_STATUS_BYTES,
    MappingStatus,
    NodeStatus,
    NodeStatusError,
    decode,
    encode,
    new_instance,
)
from lifecycle.verify.outcome import ConnectionReport
from tests import result_schemas

STATUS = NodeStatus(
    node="/robot/camera",
    instance=new_instance(),
    state="active",
    connected=True,
    checksum="ab",
    connections=(ConnectionReport(name="net", urls=("shm://",), established=True),),
    mappings=(MappingStatus(endpoint="publishers/video", connection="net", matched=2),),
)


@pytest.mark.parametrize(
    "status", [STATUS, NodeStatus(node="/a", instance="1", left=True, reason="asked to")]
)
def test_a_status_comes_back_as_it_was_and_fits_the_schema(status: NodeStatus) -> None:
    assert decode(encode(status)) == status
    schema = json.loads(result_schemas.generate("node_status"))
    jsonschema.Draft202012Validator(schema).validate(json.loads(encode(status)))


def test_fields_that_a_later_version_may_add_are_passed_over() -> None:
    assert decode(json.dumps({**json.loads(encode(STATUS)), "colour": "red"})) == STATUS


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "truncated"),
        ("[1]", "Expected `object`, got `array`"),
        ('{"node": "/a"}', "missing required field `instance`"),
        ('{"node": "/a", "instance": "1", "version": 2}', "Invalid enum value 2"),
        ('{"node": "/a", "instance": "1", "state": 1}', "Expected `str`, got `int`"),
        ('{"node": "a", "instance": "1"}', "cannot be the status of node 'a', instance '1'"),
        ('{"node": "/a", "instance": ""}', "cannot be the status of node '/a', instance ''"),
        (" " * (LONGEST_STATUS_BYTES + 1), "at most 1048576 are read"),
    ],
)
def test_what_is_no_status_is_refused_with_the_reason(text: str, reason: str) -> None:
    with pytest.raises(NodeStatusError) as error:
        decode(text)
    assert reason in str(error.value)


def test_a_later_instance_compares_greater() -> None:
    made = [new_instance() for _ in range(100)]
    assert made == sorted(made)
    assert len(set(made)) == 100
