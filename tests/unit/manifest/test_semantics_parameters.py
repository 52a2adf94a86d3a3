"""Checks of parameters, in the manifest and in files."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.model import ParameterValue
from lifecycle.manifest.parameter_files import Section, read_scalar
from lifecycle.manifest.parameter_values import misfit, suggestion, type_of

Findings = Callable[..., list[str]]

AT = Position(file="f", line=1, column=1)


@pytest.mark.parametrize(
    ("value", "type_"),
    [
        (True, "bool"),
        (1, "int"),
        (1.0, "double"),
        ("a", "string"),
        ((True,), "bool_array"),
        ((1, 2), "int_array"),
        ((1.0,), "double_array"),
        (("a",), "string_array"),
        ((0, 255), "byte_array"),
        ((), "string_array"),
        ((), "byte_array"),
    ],
)
def test_a_value_fits_its_own_type(value: ParameterValue, type_: str) -> None:
    assert misfit(value, type_) == ""


@pytest.mark.parametrize(
    ("value", "type_", "problem", "remedy"),
    [
        (30, "double", "30: it is an int, declared is double", "write 30.0"),
        (True, "int", "true: it is a bool, declared is int", ""),
        (1.0, "int", "1.0: it is a double, declared is int", ""),
        (5, "string", "5: it is an int, declared is string", "put it in quotes"),
        ("1", "int", "'1': it is a string, declared is int", "write 1 as a number, not as text"),
        ("1.5", "int", "'1.5': it is a string, declared is int", ""),
        ("fast", "double", "'fast': it is a string, declared is double", ""),
        (1, "int_array", "1: it is an int, declared is int_array", "write [1]"),
        ((), "int", "[]: it is an array, declared is int", ""),
        (
            (1, 2),
            "double_array",
            "[1, 2]: it is an int_array, declared is double_array",
            "write [1.0, 2.0]",
        ),
        ((-1,), "byte_array", "[-1]: a byte_array holds 0 to 255", ""),
        (
            ("a",) * 6,
            "string",
            "['a', 'a', 'a', 'a', …]: it is a string_array, declared is string",
            "",
        ),
    ],
)
def test_ros_converts_nothing(value: ParameterValue, type_: str, problem: str, remedy: str) -> None:
    assert (misfit(value, type_), suggestion(value, type_)) == (problem, remedy)


SCALARS: dict[str, object] = {
    "yes": True,
    "Off": False,
    "y": True,
    "1": 1,
    "+7": 7,
    "-0x1F": -31,
    "010": 8,
    "0": 0,
    "08": 8.0,
    "1.5": 1.5,
    ".5": 0.5,
    "5.": 5.0,
    "1e3": 1000.0,
    "-.inf": float("-inf"),
    "infinity": float("inf"),
    "9223372036854775808": 9.223372036854775808e18,
    "a": "a",
    "1_000": "1_000",
    "0o17": "0o17",
    "tRue": "tRue",
    "12:30": "12:30",
}


@pytest.mark.parametrize("text", SCALARS)
def test_a_scalar_in_a_file_means_what_rcl_makes_of_it(text: str) -> None:
    value = read_scalar(text, quoted=False)
    assert (type(value), value) == (type(SCALARS[text]), SCALARS[text])
    assert read_scalar(text, quoted=True) == text


def test_a_scalar_that_is_not_a_number_is_a_double_as_well() -> None:
    value = read_scalar(".nan", quoted=False)
    assert type_of(value) == "double"
    assert value != value  # what NaN is


@pytest.mark.parametrize(
    ("pattern", "node", "matches"),
    [
        ("/camera", "/camera", True),
        ("/camera", "/robot/camera", False),
        ("/**", "/camera", True),
        ("/**", "/a/b/c", True),
        ("/*", "/camera", True),
        ("/*", "/robot/camera", False),
        ("/robot/*", "/robot/camera", True),
        ("/robot/**", "/robot/a/b", True),
        ("/robot/**", "/robot", True),
        ("/**/camera", "/robot/camera", True),
        ("/**/camera", "/camera", True),
        ("/*/camera", "/camera", False),
        ("/**/**/camera", "/camera", True),
        ("/camera(s)?", "/camera", False),
    ],
)
def test_a_section_is_matched_as_by_rclcpp(pattern: str, node: str, matches: bool) -> None:
    assert Section(pattern=pattern, parameters=(), at=AT).matches(node) is matches


NODE = """
nodes:
  camera:
    run: {python: "demo:Camera"}
    parameter_files: [p.yaml]
    interface:
      parameters: {rate: {type: double}}
"""


@pytest.mark.parametrize(
    ("content", "found"),
    [
        ("camera: {ros__parameters: {rate: 1.0}}", ""),
        ("/**: {ros__parameters: {rate: 1.0}}", ""),
        (
            "camera: {ros__parameters: {rate: {min: 1.0}}}",
            (
                "check.parameter-undeclared p.yaml:1:35: camera.ros__parameters.rate.min: "
                "cannot set parameter 'rate.min' of '/camera': its interface declares no such "
                "parameter; did you mean 'rate'?"
            ),
        ),
        (
            "/**: {ros__parameters: {other: 1}}",
            (
                'check.parameter-undeclared p.yaml:1:25: warning: ["/**"].ros__parameters.'
                "other: cannot set parameter 'other': no node that reads it declares it"
            ),
        ),
        (
            "/**: {ros__parameters: {rate: 1}}",
            (
                'check.parameter-type p.yaml:1:25: ["/**"].ros__parameters.rate: '
                "cannot set parameter 'rate' of '/camera' to 1: it is an int, declared is "
                "double; write 1.0"
            ),
        ),
        (
            "camra: {ros__parameters: {rate: 1.0}}",
            (
                "check.parameter-file-unmatched 6:23: warning: "
                "nodes.camera.parameter_files[0]: cannot find node '/camera' in 'p.yaml': it "
                "is for '/camra'; name the section /camera, or /** for every node"
            ),
        ),
        (
            "",
            (
                "check.parameter-file-unmatched 6:23: warning: nodes.camera.parameter_files[0]: "
                "cannot find node '/camera' in 'p.yaml': it is for no node; name the section "
                "/camera, or /** for every node"
            ),
        ),
        (
            "- 1",
            (
                "check.parameter-file p.yaml:1:1: cannot use a list here: it is no key, and holds "
                "no lists; write 'NODE: {ros__parameters: {NAME: VALUE}}'"
            ),
        ),
        (
            "camera: {ros__parameters: 5}",
            (
                "check.parameter-file p.yaml:1:10: camera.ros__parameters: "
                "cannot use 5 as parameters; write 'NODE: {ros__parameters: {NAME: VALUE}}'"
            ),
        ),
        (
            "camera: {ros__parameters: {rate: !!str 5}}",
            (
                "check.parameter-type p.yaml:1:28: camera.ros__parameters.rate: cannot set "
                "parameter 'rate' of '/camera' to '5': it is a string, declared is double; "
                "write 5 as a number, not as text"
            ),
        ),
        (
            "camera: {ros__parameters: {rate: 1, rate: 2.0}}",
            (
                "check.parameter-type p.yaml:1:28: camera.ros__parameters.rate: cannot set "
                "parameter 'rate' of '/camera' to 1: it is an int, declared is double; write 1.0"
            ),
        ),
        (
            "'.+!': {ros__parameters: {rate: 1.0}}",
            (
                "check.parameter-file p.yaml:1:9: [\".+!\"].ros__parameters: cannot use '.+!' as "
                "the name of a node: a node name holds letters, digits and '_' only, not '.'"
            ),
        ),
    ],
)
def test_a_parameter_file_is_judged_as_its_node_will_read_it(
    findings: Findings, content: str, found: str
) -> None:
    assert "\n".join(findings(NODE, p_yaml=content)) == found


def test_a_file_shared_by_nodes_is_read_once_and_judged_for_each(findings: Findings) -> None:
    assert findings(
        """
        nodes:
          a: &a
            run: {python: "demo:A"}
            parameter_files: [p.yaml]
            interface: {parameters: {rate: {type: double}}}
          b: *a
        """,
        p_yaml="/**: {ros__parameters: {rate: yes}}\n/c: {ros__parameters: {rate: 1.0}}",
    ) == [
        (
            'check.parameter-type p.yaml:1:25: ["/**"].ros__parameters.rate: cannot set parameter '
            "'rate' of '/a' to true: it is a bool, declared is double"
        ),
        (
            'check.parameter-type p.yaml:1:25: ["/**"].ros__parameters.rate: cannot set parameter '
            "'rate' of '/b' to true: it is a bool, declared is double"
        ),
        (
            'check.parameter-file-unmatched p.yaml:2:1: warning: ["/c"]: cannot use the parameters '
            "of '/c': no node has that name"
        ),
    ]


def test_an_interface_without_parameters_says_nothing_about_them(findings: Findings) -> None:
    assert not findings(
        """
        nodes:
          camera:
            run: {python: "demo:Camera"}
            parameters: {anything: 1}
            parameter_files: [p.yaml]
        """,
        p_yaml="camera: {ros__parameters: {other: 1}}",
    )
