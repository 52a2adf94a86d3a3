"""Which parameter files are read: as librcl_yaml_param_parser has it, asked through a context."""

from __future__ import annotations

from pathlib import Path

import pytest
from rclpy.context import Context

from lifecycle.manifest.checks.parameters import read_sections
from lifecycle.manifest.diagnostics import Severity

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
}
REFUSED_HERE = {
    "a key twice": P + "    x: 1\n    x: 2\n",
    "a number as a key": P + "    1: 2\n",
    "two documents": P + "    x: 1\n---\nb:\n  ros__parameters: {y: 1}\n",
    "a merge key": P + "    <<: {x: 1}\n",
    "arrays of arrays": P + "    x: [[1]]\n",
}
"""What rcl reads, and this package refuses still."""


def _rcl_reads(path: Path) -> bool:
    context = Context()
    try:
        context.init(["--ros-args", "--params-file", str(path)])
    except RuntimeError:
        return False
    context.try_shutdown()
    return True


def _is_read(path: Path) -> bool:
    _, found = read_sections(str(path), shown="f")
    return all(each.severity is not Severity.ERROR for each in found)


@pytest.mark.parametrize("name", ALIKE)
def test_a_file_is_read_where_rcl_reads_it(name: str, tmp_path: Path) -> None:
    path = tmp_path / "p.yaml"
    path.write_text(ALIKE[name], encoding="utf-8")
    assert _is_read(path) is _rcl_reads(path)


@pytest.mark.parametrize("name", REFUSED_HERE)
def test_what_only_rcl_reads_is_known(name: str, tmp_path: Path) -> None:
    path = tmp_path / "p.yaml"
    path.write_text(REFUSED_HERE[name], encoding="utf-8")
    assert (_rcl_reads(path), _is_read(path)) == (True, False)
