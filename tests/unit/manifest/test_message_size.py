"""The largest size of a message type, from installed definitions."""

from __future__ import annotations

import contextlib
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.manifest.installed_types import (
    Field,
    IdlError,
    bounded_size,
    parse_struct,
    search_prefixes,
)

INSTALLED = search_prefixes({})


@pytest.fixture
def package(tmp_path: Path):
    """Install definitions `Name="…"` as package `p` and return the prefix."""

    def install(**structures: str) -> list[Path]:
        index = tmp_path / "share/ament_index/resource_index/rosidl_interfaces/p"
        index.parent.mkdir(parents=True, exist_ok=True)
        index.write_text("".join(f"msg/{name}.idl\n" for name in structures))
        folder = tmp_path / "share/p/msg"
        folder.mkdir(parents=True, exist_ok=True)
        for name, fields in structures.items():
            text = f"module p {{ module msg {{ {fields} }}; }};"
            (folder / f"{name}.idl").write_text(text)
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
        ("boolean a; double b;", 8 + 8),
        ("double a; boolean b;", 8 + 1),
        ("string<10> a;", 4 + 11),
        ("wstring<3> a;", 4 + 16),
        ("sequence<uint16, 5> a;", 4 + 10),
        # After what has no fixed length, the most padding there can be.
        ("string<10> a; double b;", 15 + 7 + 8),
        ("sequence<string<4>, 2> a;", 4 + 9 + (3 + 9)),
        ("octet a; long long b;", 8 + 8),
        ("unsigned short a; unsigned long b; unsigned long long c;", 16),
        ("@key @default (value=TRUE) boolean a, b[2][3];", 7),
        ("wchar a; float b; char c;", 9),
    ],
)
def test_fields_are_laid_out_as_in_cdr(package, fields: str, payload: int) -> None:
    assert bounded_size("p/msg/M", package(M=f"struct M {{ {fields} }};")) == 4 + payload


def test_nested_types_and_typedefs_are_followed(package) -> None:
    prefixes = package(
        Inner="struct Inner { double x; boolean y; };",
        M="""
        // a comment, "quoted"
        module M_Constants { const uint8 A = 1; const string B = "struct M { long x; };"; };
        /* struct M { double wrong; }; */
        typedef p::msg::Inner Inner__3[3];
        @verbatim (language="comment", text="struct M { double wrong; }; )")
        struct M { Inner__3 all; sequence<p::msg::Inner, 2> some; };
        """,
    )
    inner = [(8 + 1), (7 + 8 + 1), (7 + 8 + 1)]
    some = sum(inner)
    padded = some + -some % 4 + 4
    for _ in range(2):
        padded += -padded % 8 + 9
    assert bounded_size("p/msg/M", prefixes) == 4 + padded


def test_a_long_array_is_not_laid_out_item_by_item(package) -> None:
    prefixes = package(
        Inner="struct Inner { double x; };", M="struct M { p::msg::Inner a[1000000]; };"
    )
    size = bounded_size("p/msg/M", prefixes)
    assert size is not None
    assert 8_000_000 <= size <= 16_000_000


@pytest.mark.parametrize(
    "fields",
    [
        "sequence<double> a;",
        "sequence<double, A_CONSTANT> a;",
        "sequence<sequence<double, 2>, 2> a;",
        "p::msg::M a;",  # itself, without end
        "map<long, long> a;",
        "long double a;",
        "double",
    ],
)
def test_what_is_not_understood_or_has_no_end_has_no_bound(package, fields: str) -> None:
    assert bounded_size("p/msg/M", package(M=f"struct M {{ {fields} }};")) is None


def test_every_installed_message_definition_is_read() -> None:
    files = [file for prefix in INSTALLED for file in (prefix / "share").glob("*/msg/*.idl")]
    if not files:
        pytest.skip("no interface packages are installed")
    for file in files:
        assert isinstance(parse_struct(file.read_text(encoding="utf-8"), file.stem), tuple)


def test_a_file_without_the_structure_is_no_definition() -> None:
    with pytest.raises(IdlError, match="cannot find struct 'M'"):
        parse_struct("module p { struct N { long a; }; };", "M")


@given(st.text(alphabet="struct M{};<>,[]@()\"'/* \n0aé", max_size=60))
def test_any_text_is_a_definition_or_an_idl_error(text: str) -> None:
    with contextlib.suppress(IdlError):
        assert all(isinstance(each, Field) for each in parse_struct(f"struct M {text}", "M"))


_SCALARS = {"boolean": "?", "uint16": "H", "uint32": "I", "double": "d", "octet": "B"}


@given(st.lists(st.sampled_from(sorted(_SCALARS)), min_size=1, max_size=12))
def test_scalars_take_what_a_c_compiler_gives_them(words: list[str]) -> None:
    # Natural alignment up to 8 bytes: struct's native layout without the padding at the end.
    assert layout(words) == struct.calcsize("@" + "".join(_SCALARS[each] for each in words))


def layout(words: list[str]) -> int:
    from lifecycle.manifest import installed_types

    found = installed_types._Layout()
    for word in words:
        installed_types._add_field(Field(type=word), found, [], 0)
    return found.offset
