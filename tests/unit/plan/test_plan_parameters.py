"""What the plan expects of parameters: declarations, files and values, and who wins."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import pytest
from msgspec.structs import replace

from lifecycle import codec
from lifecycle.manifest.loading import load
from lifecycle.manifest.model import (
    Interface,
    Node,
    ParameterDeclaration,
    ParameterValue,
    Run,
    RunKind,
)
from lifecycle.manifest.parameter_files import read_parameter_file
from lifecycle.manifest.parameter_values import portable
from lifecycle.plan.build import build_plan, check_plan
from lifecycle.plan.model import Plan
from tests.builders import at, manifest, node

SCHEMA = Path(__file__).parents[3] / "schemas" / "plan.v1.schema.json"
NAMED = "/robot/camera: {ros__parameters: {rate: 2.0}}"
EVERYONE = "/**: {ros__parameters: {rate: 1.0}}"


def declared(name: str, type_: str, default: ParameterValue | None = None, **rest: bool):
    return ParameterDeclaration(name=name, type=type_, default=default, at=at(50), **rest)


def camera(*parameters: ParameterDeclaration, **rest: object) -> Node:
    made = node("camera", namespace="/robot", **rest)
    return replace(made, interface=Interface(parameters=parameters))


def plan_of(made: Node) -> Plan:
    return build_plan(manifest(made), environment={})


def values(made: Node) -> dict[str, tuple[str, ParameterValue | None, str]]:
    (planned,) = plan_of(made).nodes
    return {each.name: (each.type, each.value, each.source) for each in planned.expected_parameters}


def files(directory: Path, *texts: str) -> tuple[str, ...]:
    paths = [directory / f"{number}.yaml" for number in range(len(texts))]
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text)
    return tuple(map(str, paths))


def test_a_given_value_wins_over_a_file_and_a_file_over_the_default(tmp_path: Path):
    (file,) = files(tmp_path, NAMED)
    rate = declared("rate", "double", 0.5)
    assert values(camera(rate))["rate"] == ("double", 0.5, "default_value")
    assert values(camera(rate, parameter_files=(file,)))["rate"][:2] == ("double", 2.0)
    given = camera(rate, parameter_files=(file,), parameters=(("rate", 3.0),))
    assert values(given)["rate"] == ("double", 3.0, "parameters")


@pytest.mark.parametrize(
    ("texts", "wins"),
    [
        ((f"{EVERYONE}\n{NAMED}",), 2.0),
        ((f"{NAMED}\n{EVERYONE}",), 1.0),
        ((NAMED, EVERYONE), 1.0),
        ((EVERYONE, NAMED), 2.0),
        ((EVERYONE, NAMED, "/**: {ros__parameters: {rate: 7.0}}"), 2.0),
        (("/robot/*: {ros__parameters: {rate: 4.0}}",), 4.0),
        (("/other: {ros__parameters: {rate: 4.0}}",), None),
    ],
)
def test_sections_of_files_win_in_rcls_order(
    tmp_path: Path, texts: tuple[str, ...], wins: float | None
):
    rate = declared("rate", "double")
    found = values(camera(rate, parameter_files=files(tmp_path, *texts)))
    assert found["rate"][1] == wins


def test_a_type_alone_expects_no_value_and_an_integer_is_the_double_that_it_is_declared_to_be():
    found = values(camera(declared("any", "string"), declared("gain", "double", 2)))
    assert found == {"any": ("string", None, ""), "gain": ("double", 2.0, "default_value")}
    assert isinstance(found["gain"][1], float)


def test_a_given_value_that_nobody_declares_brings_its_own_type():
    given = (("count", 5), ("names", ("a", "b")), ("none", ()), ("deep.er", True))
    assert values(camera(parameters=given)) == {
        "count": ("int", 5, "parameters"),
        "names": ("string_array", ("a", "b"), "parameters"),
        "none": ("array", (), "parameters"),
        "deep.er": ("bool", True, "parameters"),
    }


def test_what_only_a_section_for_many_gives_is_optional(tmp_path: Path):
    both = "/**: {ros__parameters: {rate: 1.0, depth: 3}}"
    (planned,) = plan_of(camera(parameter_files=files(tmp_path, both, NAMED))).nodes
    optional = {each.name: each.optional for each in planned.expected_parameters}
    assert optional == {"rate": False, "depth": True}


def test_a_file_that_cannot_be_read_here_is_named(tmp_path: Path):
    refused = "/**: 5"
    (planned,) = plan_of(camera(parameter_files=files(tmp_path, refused, NAMED))).nodes
    assert [Path(each).name for each in planned.unread_parameter_files] == ["0.yaml"]
    assert [each.name for each in planned.expected_parameters] == ["rate"]


def test_doubles_that_json_has_not_travel_as_text(tmp_path: Path):
    text = "/**: {ros__parameters: {a: .nan, b: -.inf, c: [1.0, .inf]}}"
    plan = plan_of(camera(parameter_files=files(tmp_path, text)))
    assert {each.name: each.value for each in plan.nodes[0].expected_parameters} == {
        "a": ".nan",
        "b": "-.inf",
        "c": (1.0, ".inf"),
    }
    document = codec.to_json(plan)
    assert codec.from_json(document, Plan) == plan
    jsonschema.validate(json.loads(document), json.loads(SCHEMA.read_text(encoding="utf-8")))


def test_text_that_utf8_has_not_can_be_sent():
    assert codec.to_json(portable("a\udc80")) == b'"a\\\\udc80"'


def test_a_command_line_gives_values_too_and_files_and_parameters_win_over_it(tmp_path: Path):
    (file,) = files(tmp_path, "/**: {ros__parameters: {b: 2, c: 2}}")
    words = ("a:=1", "b:=1", "camera:c:=1", "other:d:=1", "e:='yes'", "f:=[1, 2]", "g:=.5", "h")
    argv = ("node", "-p", "z:=1", "--ros-args", *(each for word in words for each in ("-p", word)))
    run = Run(kind=RunKind.COMMAND, command=(*argv, "--", "-p", "z:=1"))
    made = camera(
        declared("f", "int_array", (3,)),
        run=run,
        parameter_files=(file,),
        parameters=(("c", 3),),
    )
    assert values(made) == {
        "f": ("int_array", None, ""),
        "a": ("int", 1, "command"),
        "b": ("int", 2, values(made)["b"][2]),
        "c": ("int", 3, "parameters"),
        "e": ("string", "yes", "command"),
        "g": ("double", 0.5, "command"),
    }
    assert values(made)["b"][2].endswith("0.yaml")


def test_what_a_command_line_gives_all_nodes_of_a_process_only_some_of_them_have():
    argv = ("both", "--ros-args", "-p", "a:=1", "-p", "camera:b:=1")
    made = camera(run=Run(kind=RunKind.COMMAND, command=argv), process="both")
    (planned,) = plan_of(made).nodes
    found = {each.name: each.optional for each in planned.expected_parameters}
    assert found == {"a": True, "b": False}


def test_a_file_that_a_command_line_names_is_read(tmp_path: Path):
    files(tmp_path, EVERYONE)
    argv = ("node", "--ros-args", "--params-file", "0.yaml", "--params-file", "gone.yaml")
    run = Run(kind=RunKind.COMMAND, command=argv, working_directory=str(tmp_path))
    (planned,) = plan_of(camera(run=run)).nodes
    assert [(each.name, each.value) for each in planned.expected_parameters] == [("rate", 1.0)]
    assert [Path(each).name for each in planned.unread_parameter_files] == ["gone.yaml"]


def test_a_check_reads_each_file_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []

    def counted(path: str, *, shown: str) -> object:
        read.append(shown)
        return read_parameter_file(path, shown=shown)

    monkeypatch.setattr("lifecycle.manifest.parameter_files.read_parameter_file", counted)
    (tmp_path / "p.yaml").write_text("/**: {ros__parameters: {rate: 1.0, use_sim_time: true}}")
    run = "{run: {command: [a]}, managed: false, endpoints: open, parameter_files: [p.yaml]}"
    path = tmp_path / "a.lifecycle.yaml"
    path.write_text(
        "manifest_version: 1\nsystem: a\nparameters: {rate: 2.0}\n"
        f"nodes:\n  a: {run}\n  b: {run}\n"
    )
    loaded = load(path)
    check_plan(loaded.manifest, files=loaded.files)
    assert len(read) == 1
