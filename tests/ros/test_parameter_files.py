"""Parameter files, compared with librcl_yaml_param_parser itself: what is read, and as what."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterator
from ctypes import (
    POINTER,
    Structure,
    c_bool,
    c_char_p,
    c_double,
    c_int64,
    c_size_t,
    c_void_p,
)
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.impl.implementation_singleton import rclpy_implementation  # loads the library

from lifecycle.manifest.parameter_files import read_parameter_file

assert rclpy_implementation


class _Allocator(Structure):
    _fields_ = tuple((f"f{index}", c_void_p) for index in range(5))


def _array(of: Any) -> type[Structure]:
    return type("_Array", (Structure,), {"_fields_": (("values", POINTER(of)), ("size", c_size_t))})


class _Strings(Structure):
    _fields_ = (("size", c_size_t), ("values", POINTER(c_char_p)), ("allocator", _Allocator))


class _Variant(Structure):
    _fields_ = (
        ("bool", POINTER(c_bool)),
        ("int", POINTER(c_int64)),
        ("double", POINTER(c_double)),
        ("string", c_char_p),
        ("byte_array", c_void_p),
        ("bool_array", POINTER(_array(c_bool))),
        ("int_array", POINTER(_array(c_int64))),
        ("double_array", POINTER(_array(c_double))),
        ("string_array", POINTER(_Strings)),
    )


class _Node(Structure):
    _fields_ = (
        ("names", POINTER(c_char_p)),
        ("values", POINTER(_Variant)),
        ("count", c_size_t),
        ("capacity", c_size_t),
    )


class _Params(Structure):
    _fields_ = (("names", POINTER(c_char_p)), ("nodes", POINTER(_Node)), ("count", c_size_t))


def _library() -> Any:
    path = next(
        line.split()[-1]
        for line in Path("/proc/self/maps").read_text(encoding="utf-8").splitlines()
        if "librcl_yaml_param_parser" in line
    )
    library = ctypes.CDLL(path)
    library.rcutils_get_default_allocator.restype = _Allocator
    library.rcl_yaml_node_struct_init.argtypes = (_Allocator,)
    library.rcl_yaml_node_struct_init.restype = POINTER(_Params)
    library.rcl_yaml_node_struct_fini.argtypes = (POINTER(_Params),)
    library.rcl_parse_yaml_file.argtypes = (c_char_p, POINTER(_Params))
    library.rcl_parse_yaml_file.restype = c_bool
    return library


LIBRARY = _library()
Read = list[tuple[str, dict[str, Any]]]


def _rcl(path: Path) -> Read | None:
    """Return sections as rcl reads them, the values as rclpy takes them; None where it refuses."""
    params = LIBRARY.rcl_yaml_node_struct_init(LIBRARY.rcutils_get_default_allocator())
    try:
        if not LIBRARY.rcl_parse_yaml_file(str(path).encode(), params):
            LIBRARY.rcutils_reset_error()
            return None
        found = params.contents
        return [
            (_pattern(found.names[i].decode()), dict(_values(found.nodes[i])))
            for i in range(found.count)
        ]
    finally:
        LIBRARY.rcl_yaml_node_struct_fini(params)


def _pattern(name: str) -> str:
    return name if name.startswith("/") else f"/{name}"


def _values(node: _Node) -> Iterator[tuple[str, Any]]:
    for index in range(node.count):
        for name, _ in _Variant._fields_:
            each = getattr(node.values[index], name)
            if each is None or (name != "string" and not each):
                continue
            if name == "string":
                value: Any = each.decode()
            elif name.endswith("_array"):
                items = [each.contents.values[i] for i in range(each.contents.size)]
                value = tuple(i.decode() if isinstance(i, bytes) else i for i in items)
            else:
                value = each.contents.value
            yield node.names[index].decode(), value
            break


def _ours(path: Path) -> Read | None:
    """Return sections as this package reads them; `[]`, from which rcl takes nothing, left out."""
    file = read_parameter_file(str(path), shown="f")
    if file.flaws:
        return None
    return [
        (each.pattern, {name: value for name, value, _ in each.parameters if value != ()})
        for each in file.sections
    ]


def _comparable(read: Read | None) -> object:
    def plain(value: object) -> object:
        if isinstance(value, tuple):
            return [plain(each) for each in value]
        is_nan = isinstance(value, float) and math.isnan(value)
        return (type(value).__name__, "nan" if is_nan else value)

    return read and [
        (name, {key: plain(each) for key, each in values.items()}) for name, values in read
    ]


P = "a:\n  ros__parameters:\n"
ALIKE = {
    "infinite": P + "    x: .INF\n    y: .Inf\n    z: -.inf\n    n: .NaN\n",
    "too large": P + "    x: 1e400\n    y: 99999999999999999999\n",
    "numbers": P + "    x: 0x10\n    y: 0x1.8p3\n    z: 010\n",
    "block scalars": P + "    x: |\n      1\n    y: >\n      1\n",
    "a value without text": P + "    x:\n",
    "null": P + "    x: null\n",
    "an empty string": P + "    x: ''\n",
    "arrays": P + "    x: [1, 2]\n    y: []\n    z: [.inf, 1.0]\n    e: ['']\n",
    "integers among doubles": P + "    x: [1, 2.0]\n",
    "booleans among integers": P + "    x: [true, 1]\n",
    "nested names": P + "    x: {y: {z: 1}}\n    x.z: 2\n    empty: {}\n",
    "nested sections": "n: {a: {ros__parameters: {x: 1}}, b: {ros__parameters: {y: 1}}}\n",
    "a node below": "a:\n  ros__parameters: {x: 1}\n  b:\n    ros__parameters: {y: 1}\n",
    "a node below, flow": "a: {ros__parameters: {x: 1}, b: {ros__parameters: {y: 1}}}\n",
    "a node above": "a:\n  b:\n    ros__parameters: {y: 1}\n  ros__parameters: {x: 1}\n",
    "nothing below": "a:\n  ros__parameters: {x: 1}\n  b: {}\n",
    "a value below": P + "    x: 1\n  y: 2\n",
    "no parameters": "a:\n  ros__parameters: {}\n",
    "no value": "a:\n  ros__parameters:\n",
    "a tilde": "a:\n  ros__parameters: ~\n",
    "a number": "a:\n  ros__parameters: 3\n",
    "a list": "a:\n  ros__parameters: [1]\n",
    "an anchor": "a:\n  ros__parameters: &p\n    x: &v 1\n",
    "an alias of a mapping": "a:\n  ros__parameters: &p\n    x: 1\nb:\n  ros__parameters: *p\n",
    "an alias of a scalar": P + "    x: &v 1\n    y: *v\n",
    "an alias in an array": P + "    x: &v 1\n    y: [*v]\n",
    "no node": "ros__parameters:\n  x: 1\n",
    "no section": "a: 1\n",
    "no mapping": "- a\n",
    "nothing": "",
    "a comment": "# nothing\n",
    "braces": "{}\n",
    "names": "/a/b:\n  ros__parameters: {x: 1}\n/**:\n  ros__parameters: {x: 1}\n",
    "a key twice": P + "    x: 1\n    x: 2\n",
    "a number as a key": P + "    1: 2\n",
    "two documents": P + "    x: 1\n---\nb:\n  ros__parameters: {y: 1}\n",
    "a merge key": P + "    <<: {x: 1}\n",
    "arrays of arrays": P + "    x: [[1]]\n",
    "a list in lists": P + "    x: [[[1]]]\n    y: 1\n",
    "lists in a list": P + "    x: [[1], [2]]\n",
    "a list with a mapping": P + "    x: [{a: 1}]\n",
    "a key of several types": P + "    x: a\n    x: [1]\n    x: 2.0\n    x: true\n",
    "a section twice": P + "    x: 1\na:\n  ros__parameters: {x: 3, y: 2}\n",
    "a section in another spelling": P + "    x: 1\n/a:\n  ros__parameters: {y: 2}\n",
    "a name that becomes a prefix": P + "    x: 1\n    x: {y: 2}\n    x: 3\n",
    "a prefix with a dot": P + "    x: {a.b: {c: 1}, d: 2}\n",
    "a namespace with a slash": "n: {a/b: {ros__parameters: {x: 1}}, c: {ros__parameters: {}}}\n",
    "an empty mapping in between": P + "    e: {}\n    x: 1\nb:\n  ros__parameters: {y: 1}\n",
    "a key without text": P + "    '': 1\n",
    "tags": P + "    x: !!str 5\n    y: !!int '5'\n    z: !mine 5\n",
    "not quite the key": "a:\n  ros__parameters_of_mine: {x: 1}\n",
    "a pattern": '"(\\\\w+)+!":\n  ros__parameters: {x: 1}\n',
    "wildcards": "/**/*/a:\n  ros__parameters: {x: 1}\n'*': {ros__parameters: {y: 1}}\n",
    "wildcards in a word": "/a*:\n  ros__parameters: {x: 1}\n",
    "two slashes": "/a//b:\n  ros__parameters: {x: 1}\n",
    "a slash at the end": "/a/:\n  ros__parameters: {x: 1}\n",
    "a slash at the end, and more": "/a/: {b: {ros__parameters: {x: 1}}}\n",
    "a digit first": "/1a:\n  ros__parameters: {x: 1}\n",
    "a scalar alone": "a\n",
    "no YAML": "a: [\n",
    "a value after parameters": "a: {ros__parameters: {x: 1}}\nb: {ros__parameters: 2}\n",
}
"""One by one, what differs from YAML 1.2 or from what people think of these files."""


@pytest.mark.parametrize("name", ALIKE)
def test_a_file_is_read_as_rcl_reads_it(name: str, tmp_path: Path) -> None:
    path = tmp_path / "p.yaml"
    path.write_text(ALIKE[name], encoding="utf-8")
    assert _comparable(_ours(path)) == _comparable(_rcl(path))


_SCALARS = st.sampled_from(
    (
        *("1", "-0x1F", "010", "2.5", "1e400", ".inf", "-.INF", ".nan", "yes", "'1'", '"a"', "a"),
        *("~", "null", "1_0", "0x1p3", "+.inf", "on", "!!str 7", "&x 3", "''", "nan"),
    )
)
_KEYS = st.sampled_from(["a", "b", "/a", "c.d", "1", "a/b", "/**", "x", "<<", "ros__parameters"])
_ARRAYS = st.lists(_SCALARS, max_size=3).map(lambda each: f"[{', '.join(each)}]")


def _mapping(values: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    entries = st.lists(st.tuples(_KEYS, values), max_size=3)
    return entries.map(lambda each: "{" + ", ".join(f"{key}: {value}" for key, value in each) + "}")


_VALUES = st.recursive(_SCALARS | _ARRAYS, _mapping, max_leaves=8)
_SECTIONS = st.lists(st.tuples(_KEYS, _mapping(_VALUES)), min_size=1, max_size=3).map(
    lambda found: "".join(f"{key}: {{ros__parameters: {value}}}\n" for key, value in found)
)


@settings(max_examples=600, deadline=None)
@given(text=_SECTIONS | _mapping(_mapping(_VALUES)))
def test_any_file_is_read_as_rcl_reads_it(
    text: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "generated.yaml"
    path.write_text(text, encoding="utf-8")
    assert _comparable(_ours(path)) == _comparable(_rcl(path))
