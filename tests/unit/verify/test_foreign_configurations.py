"""What a node answers for its configuration is anybody's text: read within bounds, or refused."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from lifecycle import codec
from lifecycle.graph.status import NodeStatusError
from lifecycle.graph.status import decode as decode_status
from lifecycle.plan.comparison import PlanNoticeError
from lifecycle.plan.comparison import decode as decode_notice
from lifecycle.verify.observation import (
    LONGEST_CONFIGURATION,
    ConfigurationError,
    decode_configuration,
)
from lifecycle.verify.report import render_text, to_json, to_junit, to_sarif
from lifecycle.verify.verdict import Stage
from tests.unit.verify.lines import verify
from tests.unit.verify.perfect import perfect
from tests.unit.verify.test_verify_rules import PLAN

SEEN = perfect(PLAN, Stage.ACTIVE)
GOOD: dict[str, Any] = json.loads(codec.to_json(SEEN.configurations[0]))
NAME = GOOD["name"]
DEEP = 1_000_000

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
)


def edited(**changes: object) -> str:
    return json.dumps({**GOOD, **changes})


def with_endpoint(**changes: object) -> str:
    return edited(endpoints=[{**GOOD["endpoints"][0], **changes}])


NFE = {"transport_protocol": "udp", "internet_protocol": "ipv4", "transport_port": 1}

REFUSED = {
    "nothing": "",
    "no JSON": "hello",
    "half of it": edited()[:-1],
    "two of it": edited() * 2,
    "a number": "1e999",
    "null": "null",
    "a list": "[]",
    "an empty object": "{}",
    "deep lists": "[" * DEEP,
    "deep objects": '{"a":' * DEEP,
    "deep lists in a field that is passed over": edited()[:-1] + ',"x":' + "[" * DEEP,
    "more than is read": edited() + " " * LONGEST_CONFIGURATION,
    "another node's name": edited(name="/somebody_else"),
    "a name that is a number": edited(name=7),
    "an unknown kind": with_endpoint(kind="telepathy"),
    "a pid that no integer holds": edited(identity={**GOOD["identity"], "process_id": 10**30}),
    "a negative count of matches": with_endpoint(matched=-1),
    "a DSCP of 64": with_endpoint(dscp=64),
    "a prefix that is too short": edited(connections=[{"name": "b", "prefix": "a"}]),
    "a long name of another": edited(name="x" * 200),
    "a long address that is none": with_endpoint(nfes=[{**NFE, "internet_address": "y" * 200}]),
    "a GID that is no hex": with_endpoint(gid="zz" * 16),
    "a port of 65536": with_endpoint(nfes=[{**NFE, "transport_port": 65536}]),
    "an address that is none": with_endpoint(nfes=[{**NFE, "internet_address": "\x1b[2J"}]),
    "a negative deadline": with_endpoint(qos={"deadline_ns": -1}),
    "a lone surrogate": '{"name":"\ud800"}',
    "a parameter that no node can have": edited(
        parameters=[{"name": "p", "type": "int", "value": 2**64}]
    ),
}


def test_a_good_one_is_read() -> None:
    assert decode_configuration(edited(), NAME) == SEEN.configurations[0]
    assert decode_configuration(edited(of_a_later_version=[1]), NAME) == SEEN.configurations[0]


@pytest.mark.parametrize("text", REFUSED.values(), ids=REFUSED)
def test_what_is_no_configuration_is_refused_in_a_sentence(text: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        decode_configuration(text, NAME)
    assert 0 < len(str(caught.value)) < 300


def with_parameter(value: object) -> str:
    return edited(parameters=[{"name": "p", "type": "integer", "value": value}])


LARGEST = 2**63 - 1
BOUNDS: dict[str, tuple[Callable[[int], str], int, int]] = {
    "identity.process_id": (
        lambda value: edited(identity={**GOOD["identity"], "process_id": value}),
        0,
        LARGEST,
    ),
    "endpoints[0].matched": (lambda value: with_endpoint(matched=value), 0, LARGEST),
    "endpoints[0].size_bytes": (lambda value: with_endpoint(size_bytes=value), 0, LARGEST),
    "endpoints[0].dscp": (lambda value: with_endpoint(dscp=value), 0, 63),
    **{
        f"endpoints[0].qos.{field}": (
            lambda value, field=field: with_endpoint(qos={field: value}),
            0,
            LARGEST,
        )
        for field in ("depth", "deadline_ns", "lifespan_ns", "liveliness_lease_duration_ns")
    },
    **{
        f"endpoints[0].nfes[0].{field}": (
            lambda value, field=field: with_endpoint(nfes=[{**NFE, field: value}]),
            0,
            most,
        )
        for field, most in (("transport_port", 65535), ("flow_label", 0xFFFFF), ("dscp", 63))
    },
    "parameters[0].value": (with_parameter, -LARGEST - 1, LARGEST),
}


@pytest.mark.parametrize("what", BOUNDS)
def test_of_every_number_what_it_can_be_is_read_and_all_else_refused(what: str) -> None:
    write, least, most = BOUNDS[what]
    for value in (least, most):
        assert decode_configuration(write(value), NAME).name == NAME
    for value in (least - 1, most + 1):
        with pytest.raises(ConfigurationError) as caught:
            decode_configuration(write(value), NAME)
        assert str(caught.value).endswith(f"at `$.{what}`"), caught.value


def test_deep_text_is_refused_in_a_thread_with_little_stack_too() -> None:
    caught: list[BaseException] = []

    def read() -> None:
        try:
            decode_configuration("[" * DEEP, NAME)
        except BaseException as error:  # noqa: BLE001 - the point is which one it is
            caught.append(error)

    before = threading.stack_size(256 * 1024)
    try:
        thread = threading.Thread(target=read)
        thread.start()
    finally:
        threading.stack_size(before)
    thread.join()
    assert [type(each) for each in caught] == [ConfigurationError]


@given(JSON.map(json.dumps) | st.text() | st.binary())
def test_no_text_makes_a_decoder_raise_anything_but_its_own_error(text: str | bytes) -> None:
    with pytest.raises(ConfigurationError):
        decode_configuration(text, NAME)
    with pytest.raises(NodeStatusError):
        decode_status(text)
    if isinstance(text, str):
        with pytest.raises(PlanNoticeError):
            decode_notice(text)


def places(value: object, path: tuple[object, ...] = ()) -> list[tuple[object, ...]]:
    found = [path] if path else []
    if isinstance(value, dict):
        for key, inner in value.items():
            found += places(inner, (*path, key))
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            found += places(inner, (*path, index))
    return found


TEXT = st.text() | st.sampled_from(["\x1b[2J", "\nverdict: ok", "\u202e", "[red]", "//", "/"])


@given(st.data())
@settings(max_examples=200, deadline=None)
def test_whatever_is_read_can_be_judged_and_written(data: st.DataObject) -> None:
    document = json.loads(codec.to_json(SEEN.configurations[0]))
    for _ in range(data.draw(st.integers(1, 4))):
        *parents, last = data.draw(st.sampled_from(places(document)))
        inner = document
        for key in parents:
            inner = inner[key]
        old = inner[last]
        inner[last] = data.draw(
            TEXT
            if isinstance(old, str)
            else st.integers()
            if isinstance(old, int)
            else st.sampled_from([[], None, {}])
        )
    try:
        found = decode_configuration(json.dumps(document), NAME)
    except ConfigurationError:
        return
    seen = replace(SEEN, configurations=(found, *SEEN.configurations[1:]))
    for stage in Stage:
        verdict = verify(PLAN, seen, stage=stage)
        for text in (render_text(verdict), to_junit(verdict, PLAN)):
            assert text.replace("\n", "").isprintable()
        json.loads(to_json(verdict))
        json.loads(to_sarif(verdict))
