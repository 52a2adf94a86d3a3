"""The largest size of a message type, from installed definitions."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lifecycle.manifest.installed_types import bounded_size, search_prefixes

INSTALLED = search_prefixes({})


NAMES = (
    *("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64"),
    *("float", "double", "long_double", "char", "wchar", "boolean", "byte"),
)
IDS = {name: number for number, name in enumerate(NAMES, start=2)}
FORMS = {"": 0, "array": 48, "bounded": 96, "unbounded": 144}


def field(type_: str, form: str = "", capacity: int = 0, *, text: int = 0) -> dict[str, object]:
    """Describe a field as rosidl does; `text` is the bound of a string."""
    number = 1 if "/" in type_ else IDS.get(type_) or {"string": 17, "wstring": 18}[type_]
    number += 4 if text else 0
    described = {"type_id": number + FORMS[form], "capacity": capacity, "string_capacity": text}
    return {"name": "a", "type": {**described, "nested_type_name": type_ if "/" in type_ else ""}}


@pytest.fixture
def package(tmp_path: Path):
    """Install descriptions `Name=[fields]` as package `p` and return the prefix."""

    def install(**structures: list[dict[str, object]]) -> list[Path]:
        index = tmp_path / "share/ament_index/resource_index/rosidl_interfaces/p"
        index.parent.mkdir(parents=True, exist_ok=True)
        index.write_text("".join(f"msg/{name}.idl\n" for name in structures))
        folder = tmp_path / "share/p/msg"
        folder.mkdir(parents=True, exist_ok=True)
        for name, fields in structures.items():
            described = {"type_description": {"type_name": f"p/msg/{name}", "fields": fields}}
            (folder / f"{name}.json").write_text(json.dumps({"type_description_msg": described}))
        return [tmp_path]

    return install


@pytest.mark.parametrize(
    ("type_", "size"),
    [
        ("std_msgs/msg/Empty", 5),  # rosidl puts a byte into an empty structure
        ("std_msgs/msg/Bool", 5),
        ("std_msgs/msg/Float64", 12),
        ("geometry_msgs/msg/Twist", 4 + 6 * 8),
        ("geometry_msgs/msg/PoseWithCovariance", 4 + 7 * 8 + 36 * 8),
        ("sensor_msgs/msg/NavSatStatus", 4 + 4),  # int8, a byte of padding, uint16
    ],
)
def test_a_type_of_bounded_fields_has_a_largest_size(type_: str, size: int) -> None:
    assert bounded_size(type_, INSTALLED) == size


@pytest.mark.parametrize(
    "type_",
    [
        "std_msgs/msg/String",
        "sensor_msgs/msg/Image",
        "std_msgs/msg/Header",  # its frame_id is a string
        "std_msgs/msg/NoSuchType",
        "no_such_package/msg/Type",
        "Type",
    ],
)
def test_without_a_bound_or_a_definition_nothing_is_claimed(type_: str) -> None:
    assert bounded_size(type_, INSTALLED) is None


@pytest.mark.parametrize(
    ("fields", "payload"),
    [
        ([field("boolean"), field("double")], 8 + 8),
        ([field("double"), field("boolean")], 8 + 1),
        ([field("string", text=10)], 4 + 11),
        ([field("wstring", text=3)], 4 + 16),
        ([field("uint16", "bounded", 5)], 4 + 10),
        # After what has no fixed length, the most padding there can be.
        ([field("string", text=10), field("double")], 15 + 7 + 8),
        ([field("string", "bounded", 2, text=4)], 4 + 9 + (3 + 9)),
        ([field("byte"), field("int64")], 8 + 8),
        ([field("uint16"), field("uint32"), field("uint64")], 16),
        ([field("boolean"), field("boolean", "array", 6)], 7),
        ([field("wchar"), field("float"), field("char")], 9),
    ],
)
def test_fields_are_laid_out_as_in_cdr(
    package, fields: list[dict[str, object]], payload: int
) -> None:
    assert bounded_size("p/msg/M", package(M=fields)) == 4 + payload


def test_nested_types_are_followed(package) -> None:
    prefixes = package(
        Inner=[field("double"), field("boolean")],
        M=[field("p/msg/Inner", "array", 3), field("p/msg/Inner", "bounded", 2)],
    )
    some = sum([(8 + 1), (7 + 8 + 1), (7 + 8 + 1)])
    padded = some + -some % 4 + 4
    for _ in range(2):
        padded += -padded % 8 + 9
    assert bounded_size("p/msg/M", prefixes) == 4 + padded


def test_a_long_array_is_not_laid_out_item_by_item(package) -> None:
    prefixes = package(Inner=[field("double")], M=[field("p/msg/Inner", "array", 1_000_000)])
    size = bounded_size("p/msg/M", prefixes)
    assert size is not None
    assert 8_000_000 <= size <= 16_000_000


@pytest.mark.parametrize(
    "fields",
    [
        [field("double", "unbounded")],
        [field("p/msg/M")],  # itself, without end
        [field("long_double")],
        [{"name": "a"}],
        [{"name": "a", "type": {"type_id": 500, "capacity": 0, "string_capacity": 0}}],
        ["a"],
    ],
)
def test_what_is_not_understood_or_has_no_end_has_no_bound(package, fields) -> None:
    assert bounded_size("p/msg/M", package(M=fields)) is None


_KEYS = st.sampled_from(["fields", "type", "type_id", "capacity", "string_capacity"])
_ANYTHING = st.recursive(
    st.none() | st.integers() | st.text(),
    lambda each: st.lists(each) | st.dictionaries(_KEYS, each),
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(_ANYTHING)
def test_no_description_makes_it_raise(package, value: object) -> None:
    size = bounded_size("p/msg/M", package(M=value))
    assert size is None or size > 4


_SCALARS = {"boolean": "?", "uint16": "H", "uint32": "I", "double": "d", "byte": "B"}


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.sampled_from(sorted(_SCALARS)), min_size=1, max_size=12))
def test_scalars_take_what_a_c_compiler_gives_them(package, words: list[str]) -> None:
    # Natural alignment up to 8 bytes: struct's native layout without the padding at the end.
    expected = struct.calcsize("@" + "".join(_SCALARS[each] for each in words))
    assert bounded_size("p/msg/M", package(M=[field(each) for each in words])) == 4 + expected
