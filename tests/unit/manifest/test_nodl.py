"""NoDL v2 documents in place of an inline interface."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import pytest

from lifecycle.manifest.diagnostics import Diagnostic, Position, Severity
from lifecycle.manifest.interface import MAX_DOCUMENTS, read_interface
from lifecycle.manifest.model import Endpoint, EndpointKind, Interface, ParameterDeclaration
from lifecycle.manifest.qos import (
    POLICIES,
    PRESETS,
    Durability,
    History,
    Liveliness,
    QosProfile,
    Reliability,
    not_written,
)

AT = Position(file="system.lifecycle.yaml", line=7, column=16, path="nodes.imu.interface")

WHOLE = """\
nodl_version: 2
description: An IMU driver.
codegen: {cpp: {namespace: imu}}
publishers:
  - name: imu
    type: sensor_msgs/msg/Imu
    qos: {history: KEEP_LAST, depth: 5, reliability: BEST_EFFORT, durability: VOLATILE,
          deadline_ns: 20000000, lifespan_ns: 0, liveliness: AUTOMATIC,
          liveliness_lease_duration_ns: 1000000000}
subscriptions:
  - {name: /clock_offset, type: std_msgs/Float64, qos: {history: KEEP_ALL, reliability: RELIABLE}}
service_servers:
  - {name: ~/reset, type: std_srvs/srv/Trigger, description: starts again}
service_clients:
  - {name: save, type: std_srvs/Trigger, qos: {history: SYSTEM_DEFAULT, reliability: RELIABLE}}
action_servers:
  - {name: calibrate, type: example_interfaces/action/Fibonacci}
action_clients:
  - {name: dock, type: example_interfaces/Fibonacci}
parameters:
  rate: {type: double, default_value: 100.0, description: Hz, read_only: true}
  frames: {type: string_array, default_value: [a, b]}
  group: {type: none}
"""


def followed(
    reference: str, *, base: str | Path, at: Position, environment: Mapping[str, str] = os.environ
) -> tuple[Interface, list[Diagnostic]]:
    found: list[Diagnostic] = []
    interface = read_interface(reference, base=base, at=at, environment=environment, found=found)
    return interface, found


def read(path: Path, text: str) -> tuple[Interface, list[str]]:
    path.write_text(text)
    interface, found = followed(f"local://{path.name}", base=path.parent, at=AT)
    return interface, [str(each).replace(f"{path.parent}/", "") for each in found]


def test_a_whole_document_becomes_an_interface(tmp_path: Path) -> None:
    interface, found = read(tmp_path / "imu.nodl.yaml", WHOLE)
    assert found == []
    file = str(tmp_path / "imu.nodl.yaml")

    def at(line: int, column: int, path: str) -> Position:
        return Position(file=file, line=line, column=column, path=path)

    assert interface.endpoints == (
        Endpoint(
            kind=EndpointKind.PUBLISHER,
            name="imu",
            type="sensor_msgs/msg/Imu",
            qos=QosProfile(
                depth=5,
                reliability=Reliability.BEST_EFFORT,
                deadline_ns=20_000_000,
                liveliness_lease_duration_ns=10**9,
            ),
            at=at(5, 5, "publishers[0]"),
        ),
        Endpoint(
            kind=EndpointKind.SUBSCRIPTION,
            name="/clock_offset",
            type="std_msgs/msg/Float64",
            qos=QosProfile(history=History.KEEP_ALL, depth=0, liveliness=Liveliness.SYSTEM_DEFAULT),
            qos_defaults=not_written(["history", "reliability"]),
            at=at(11, 5, "subscriptions[0]"),
        ),
        Endpoint(
            kind=EndpointKind.SERVICE_SERVER,
            name="~/reset",
            type="std_srvs/srv/Trigger",
            qos=PRESETS["services_default"],
            qos_defaults=POLICIES,
            at=at(13, 5, "service_servers[0]"),
        ),
        Endpoint(
            kind=EndpointKind.SERVICE_CLIENT,
            name="save",
            type="std_srvs/srv/Trigger",
            qos=QosProfile(history=History.SYSTEM_DEFAULT, liveliness=Liveliness.SYSTEM_DEFAULT),
            qos_defaults=not_written(["history", "reliability"]),
            at=at(15, 5, "service_clients[0]"),
        ),
        Endpoint(
            kind=EndpointKind.ACTION_SERVER,
            name="calibrate",
            type="example_interfaces/action/Fibonacci",
            qos=None,
            at=at(17, 5, "action_servers[0]"),
        ),
        Endpoint(
            kind=EndpointKind.ACTION_CLIENT,
            name="dock",
            type="example_interfaces/action/Fibonacci",
            qos=None,
            at=at(19, 5, "action_clients[0]"),
        ),
    )
    assert interface.parameters == (
        ParameterDeclaration(
            name="rate",
            type="double",
            default=100.0,
            description="Hz",
            read_only=True,
            at=at(21, 3, "parameters.rate"),
        ),
        ParameterDeclaration(
            name="frames",
            type="string_array",
            default=("a", "b"),
            at=at(22, 3, "parameters.frames"),
        ),
    )


def test_json_is_read_as_well(tmp_path: Path) -> None:
    interface, found = read(tmp_path / "a.json", '{"nodl_version": 2, "publishers": []}')
    assert (interface.endpoints, found) == ((), [])


@pytest.mark.parametrize(
    ("text", "findings"),
    [
        ("description: nothing", ["1:1 nodl.invalid"]),
        ("nodl_version: 1", ["1:15 nodl.invalid nodl_version"]),
        ("nodl_version: 2\npublisher: []", ["2:1 nodl.unknown-key publisher"]),
        ("nodl_version: 2\npublishers: 1", ["2:13 nodl.invalid publishers"]),
        (
            "nodl_version: 2\nservice_servers:\n  - {name: a, type: std_msgs/msg/Empty}",
            ["3:21 nodl.invalid service_servers[0].type"],
        ),
        (
            "nodl_version: 2\npublishers:\n  - {type: 3, qos: {history: KEEP_LAST}}",
            [
                "3:12 nodl.invalid publishers[0].type",
                "3:5 nodl.invalid publishers[0]",  # no name
            ],
        ),
        (
            (
                "nodl_version: 2\nsubscriptions:\n  - {name: a, type: std_msgs/Empty, "
                "qos: {history: KEEP_ALL, reliability: reliable, deadline_ns: 1.5}}"
            ),
            [
                "3:75 nodl.invalid subscriptions[0].qos.reliability",
                "3:98 nodl.invalid subscriptions[0].qos.deadline_ns",
            ],
        ),
        (
            (
                "nodl_version: 2\nparameters: {a: {type: doubl}, b: {type: double, validation: "
                "{gt: 0}}, c: {type: string_fixed_25}, __map_d: {type: int}, e: 5}"
            ),
            [
                "2:125 nodl.invalid parameters.e",
                "2:24 nodl.invalid parameters.a.type",
            ],
        ),
        ("nodl_version: 2\ninclude: [{file: a}]", ["2:11 nodl.invalid include[0].ref"]),
        ("nodl_version: 2\ninclude: {ref: a}", ["2:10 nodl.invalid include"]),
    ],
)
def test_what_breaks_a_document_is_an_error_and_what_is_unknown_a_warning(
    tmp_path: Path, text: str, findings: list[str]
) -> None:
    (tmp_path / "x.yaml").write_text(text)
    _, found = followed("local://x.yaml", base=tmp_path, at=AT)
    places = [f"{each.at.line}:{each.at.column} {each.rule} {each.at.path}" for each in found]
    assert sorted(each.strip() for each in places) == findings
    assert {each.severity for each in found if each.rule != "nodl.invalid"} <= {Severity.WARNING}


def test_hostile_text_is_refused_by_the_same_reader_as_manifests(tmp_path: Path) -> None:
    _, found = read(tmp_path / "x.yaml", "nodl_version: !!python/name:os.system 2")
    assert found == [
        (
            "x.yaml:1:15: nodl_version: cannot use the tag '!!python/name:os.system': a manifest "
            "is data only; remove the tag; quotes make a string"
        )
    ]


def publisher(name: str, *includes: str) -> str:
    references = "".join(f"  - ref: {each}\n" for each in includes)
    return (
        "nodl_version: 2\n"
        + (f"include:\n{references}" if references else "")
        + f"publishers:\n  - {{name: {name}, type: std_msgs/msg/Empty, "
        "qos: {history: KEEP_LAST, depth: 1, reliability: RELIABLE}}\n"
    )


def test_includes_are_merged_each_relative_to_its_document(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "mid.yaml").write_text(publisher("mid", "local://leaf.yaml"))
    (tmp_path / "sub" / "leaf.yaml").write_text(publisher("leaf"))
    interface, found = read(tmp_path / "top.yaml", publisher("top", "local://sub/mid.yaml"))
    assert ([each.name for each in interface.endpoints], found) == (["top", "mid", "leaf"], [])


def test_a_document_that_includes_itself_is_read_once(tmp_path: Path) -> None:
    (tmp_path / "b.yaml").write_text(publisher("b", "local://./a.yaml"))
    interface, found = read(tmp_path / "a.yaml", publisher("a", "local://b.yaml"))
    assert ([each.name for each in interface.endpoints], found) == (["a", "b"], [])


def test_the_number_of_documents_is_bounded(tmp_path: Path) -> None:
    for index in range(MAX_DOCUMENTS + 5):
        (tmp_path / f"n{index}.yaml").write_text(
            publisher(f"n{index}", f"local://n{index + 1}.yaml")
        )
    interface, found = followed("local://n0.yaml", base=tmp_path, at=AT)
    assert len(interface.endpoints) == MAX_DOCUMENTS
    assert [each.message for each in found] == ["cannot include more than 100 documents"]


def test_a_missing_file_is_reported_at_the_reference_with_the_nearest_name(tmp_path: Path) -> None:
    (tmp_path / "camera.nodl.yaml").write_text(publisher("a"))
    interface, found = followed("local://camra.nodl.yaml", base=tmp_path, at=AT)
    assert interface == Interface(has_all_parameters=True)
    assert [str(each).replace(f"{tmp_path}/", "") for each in found] == [
        (
            "system.lifecycle.yaml:7:16: nodes.imu.interface: cannot find "
            "'local://camra.nodl.yaml': there is no file 'camra.nodl.yaml'; "
            "did you mean 'camera.nodl.yaml'?"
        )
    ]


@pytest.fixture
def prefix(tmp_path: Path) -> Path:
    index = tmp_path / "share" / "ament_index" / "resource_index" / "nodl"
    index.mkdir(parents=True)
    (index / "sensor_common__imu_driver").write_text(publisher("imu", "nodl://sensor_common/tf"))
    (index / "sensor_common__tf").write_text(publisher("tf"))
    return tmp_path


def test_a_document_is_found_in_the_ament_index(prefix: Path) -> None:
    interface, found = followed(
        "nodl://sensor_common/imu_driver",
        base="/nowhere",
        at=AT,
        environment={"AMENT_PREFIX_PATH": str(prefix)},
    )
    assert ([each.name for each in interface.endpoints], found) == (["imu", "tf"], [])


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        (
            "nodl://sensor_comon/imu_driver",
            (
                "cannot find 'nodl://sensor_comon/imu_driver' in the ament index; "
                "did you mean 'nodl://sensor_common/imu_driver'?"
            ),
        ),
        (
            "nodl://zz/q",
            (
                "cannot find 'nodl://zz/q' in the ament index; "
                "source the workspace that installs zz, so that AMENT_PREFIX_PATH names it"
            ),
        ),
        ("nodl://pkg", "cannot follow 'nodl://pkg'; write nodl://PACKAGE/NAME"),
        (
            "http://pkg/a",
            "cannot follow 'http://pkg/a'; write local://PATH or nodl://PACKAGE/NAME",
        ),
    ],
)
def test_a_reference_that_leads_nowhere_says_how_to_write_one(
    prefix: Path, reference: str, message: str
) -> None:
    environment = {"AMENT_PREFIX_PATH": str(prefix)}
    _, found = followed(reference, base="/nowhere", at=AT, environment=environment)
    assert [str(each) for each in found] == [
        f"system.lifecycle.yaml:7:16: nodes.imu.interface: {message}"
    ]


def test_defaults_of_a_profile_are_those_of_rmw(tmp_path: Path) -> None:
    interface, _ = read(tmp_path / "a.yaml", publisher("a"))
    assert interface.endpoints[0].qos == QosProfile(
        depth=1, durability=Durability.VOLATILE, liveliness=Liveliness.SYSTEM_DEFAULT
    )
