"""`lifecycle check`: text, JSON, exit codes, and no ROS."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import pytest

from lifecycle.cli import common, main
from lifecycle.manifest.schema import read_schema
from lifecycle.plan.programs import Resolution

ROOT = Path(__file__).parents[3]
CORPUS = ROOT / "tests" / "corpus"


@pytest.fixture
def corpus(monkeypatch: pytest.MonkeyPatch, without_programs: None) -> None:
    monkeypatch.chdir(CORPUS)


@pytest.fixture
def without_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Look for nothing that nodes run: what manifests of the corpus run is made up."""
    monkeypatch.setattr(common, "resolve", lambda *_: Resolution())


@pytest.mark.usefixtures("corpus")
def test_a_good_manifest_is_summed_up_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "valid/teleop.lifecycle.yaml"]) == 0
    assert capsys.readouterr().out == "teleop: 2 nodes, 4 endpoints, 1 link: ok\n"


@pytest.mark.usefixtures("corpus")
def test_every_finding_of_a_bad_manifest_comes_before_the_summary(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["check", "invalid/qos_of_a_wrong_type.lifecycle.yaml"]) == 3
    path = "invalid/qos_of_a_wrong_type.lifecycle.yaml"
    publishers = "nodes.talker.interface.publishers"
    wanted = "it must be a string or a mapping"
    assert capsys.readouterr().out.splitlines() == [
        f"{path}:8:53: {publishers}[0].qos: cannot use qos 10; {wanted}; write {{depth: 10}}",
        f"{path}:9:53: {publishers}[1].qos: cannot use a list as qos; {wanted}",
        f"{path}: not ok (2 errors)",
    ]


@pytest.mark.usefixtures("corpus")
def test_what_is_unproven_fails_only_when_strict(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "p.yaml").write_text("/other: {ros__parameters: {gain: 1.0}}\n")
    path = str(tmp_path / "one.lifecycle.yaml")
    Path(path).write_text(
        "manifest_version: 1\nsystem: one\nnodes:\n"
        "  arm: {run: {command: [python3]}, managed: false, parameter_files: [p.yaml]}\n"
    )
    assert main(["check", path]) == 0
    relaxed = capsys.readouterr().out.splitlines()
    assert main(["check", path, "--strict"]) == 5
    strict = capsys.readouterr().out.splitlines()
    assert relaxed[-1] == "one: 1 node, 0 endpoints, 0 links: ok (1 warning)"
    assert strict[-1] == "one: 1 node, 0 endpoints, 0 links: not ok (1 warning)"
    assert relaxed[:-1] == strict[:-1]


@pytest.mark.usefixtures("corpus")
def test_notes_fail_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "valid/include_only.lifecycle.yaml", "--strict"]) == 0
    found = capsys.readouterr().out.splitlines()
    assert found[-1] == "include_only: 2 nodes, 2 endpoints, 0 links: ok (2 notes)"


@pytest.mark.usefixtures("corpus")
def test_arguments_are_handed_on(capsys: pytest.CaptureFixture[str]) -> None:
    path = "valid/every_key.lifecycle.yaml"
    assert main(["check", path, "rate:=20"]) == 0
    assert main(["check", path, "rate:=30"]) == 3
    assert capsys.readouterr().out.splitlines()[-2] == (
        f"{path}:6:9: arguments.rate: cannot set rate to '30'; allowed: 10, 20"
    )
    assert main(["check", path, "rate"]) == 2
    assert capsys.readouterr().err == "cannot read argument 'rate'; write name:=value\n"


@pytest.mark.usefixtures("corpus")
@pytest.mark.parametrize(
    ("path", "code", "rules"),
    [
        ("valid/teleop.lifecycle.yaml", 0, []),
        ("valid/yaml_1_1_booleans.lifecycle.yaml", 0, ["manifest.yaml-1.1-boolean"]),
        ("invalid/yaml_nul_byte.lifecycle.yaml", 3, ["yaml.file"]),
        ("nowhere.lifecycle.yaml", 3, ["yaml.file"]),
    ],
)
def test_json_fits_its_schema(
    path: str, code: int, rules: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", path, "--format", "json"]) == code
    report = json.loads(capsys.readouterr().out)
    jsonschema.validate(report, read_schema("check.v1.schema.json"))
    assert report["ok"] is (code == 0)
    assert report["manifest"] == path
    assert [each["rule"] for each in report["diagnostics"]] == rules


@pytest.mark.usefixtures("without_programs")
def test_what_cannot_be_planned_is_found_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "apart.lifecycle.yaml"
    path.write_text(
        """manifest_version: 1
system: apart
discovery: {mode: static, transport: shm}
nodes:
  called:
    run: {python: "demo:Called"}
    interface: {publishers: [{name: /data, type: std_msgs/msg/String}]}
    connections: {net: {urls: ["udpv4://127.0.0.1:9001?multicast=off"], map: all}}
  caller:
    run: {python: "demo:Caller"}
    interface: {subscriptions: [{name: /data, type: std_msgs/msg/String}]}
""",
        encoding="utf-8",
    )
    assert main(["check", str(path)]) == 3
    assert capsys.readouterr().out.splitlines() == [
        (
            f"{path}:7:30: nodes.called.interface.publishers[0]: cannot carry '/data' from "
            "'called' to 'caller' by shm: the publisher's participant has udpv4, the "
            "subscription's shm, so it would not arrive; ask for one transport for all "
            "that these two endpoints talk to"
        ),
        f"{path}: not ok (1 error)",
    ]


@pytest.mark.usefixtures("corpus")
def test_a_domain_of_the_environment_that_is_none_is_refused_as_up_refuses_it(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "233")
    assert main(["check", "valid/smallest.lifecycle.yaml"]) == 2
    assert capsys.readouterr().err == (
        "cannot use ROS_DOMAIN_ID='233': a domain is a number from 0 to 232; unset it, or set "
        "discovery.domain_id in the manifest\n"
    )


def test_the_arguments_of_a_manifest_are_listed_whatever_else_is_wrong_with_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    manifest = tmp_path / "arm.lifecycle.yaml"
    manifest.write_text(
        "manifest_version: 1\nsystem: arm\narguments:\n"
        "  robot: {description: its name}\n"
        "  rate: {default: 10, choices: [5, 10]}\n"
        "  where: {default: $(env HOME /)}\n"
        "nodez: {}\n"
    )
    assert main(["check", str(manifest), "--arguments"]) == 0
    assert capsys.readouterr().out == (
        "robot:=VALUE  its name; required\nrate:=10  allowed: 5, 10\nwhere:=$(env HOME /)\n"
    )
    assert main(["check", str(manifest), "--arguments", "--format", "json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert [(each["name"], each["default"]) for each in listed] == [
        ("robot", None),
        ("rate", "10"),
        ("where", "$(env HOME /)"),
    ]
    assert main(["check", str(manifest), "--arguments", "rate:=5"]) == 2
    manifest.write_text("manifest_version: 1\nsystem: arm\narguments: {rate: {defalt: 1}}\n")
    assert main(["check", str(manifest), "--arguments"]) == 3
    assert "arguments.rate.defalt: cannot use the unknown key" in capsys.readouterr().err
    manifest.write_text("manifest_version: 1\nsystem: arm\nnodes: {}\n")
    assert main(["check", str(manifest), "--arguments"]) == 0
    assert capsys.readouterr().out == f"{manifest} takes no arguments\n"


@pytest.mark.usefixtures("without_programs")
@pytest.mark.parametrize(
    ("verb", "flags", "code", "runs"),
    [
        ("check", [], 0, False),
        ("check", ["--strict"], 5, False),
        ("check", ["--strict", "--run-commands"], 0, True),
        ("plan", [], 0, False),
        ("plan", ["--run-commands"], 0, True),
    ],
)
def test_programs_of_a_manifest_run_only_when_they_may(
    verb: str,
    flags: list[str],
    code: int,
    runs: bool,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path, ran = tmp_path / "s.lifecycle.yaml", tmp_path / "ran"
    path.write_text(
        f"manifest_version: 1\nsystem: s\ndescription: $(command touch {ran})\n"
        "nodes:\n  a:\n    run: {command: [sleep, $(command echo 5)]}\n    managed: false\n"
        "    parameters: {names: [$(command echo x)], count: $(command echo 3)}\n"
        "    timeouts: {start_s: $(command echo 3)}\n",
        encoding="utf-8",
    )
    assert main([verb, str(path), *flags]) == code
    assert ran.exists() is runs
    said = "".join(capsys.readouterr())
    assert said.count("its program was not run") == (0 if runs else 5)


@pytest.mark.usefixtures("without_programs")
@pytest.mark.parametrize(
    "text",
    [
        "arguments: {a: {default: $(command echo x)}}\nnodes: {a: {attach: true}}\n",
        "nodes: {a: {attach: true, if: $(command echo true)}}\n",
    ],
)
def test_what_decides_about_the_rest_cannot_be_left_out(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "s.lifecycle.yaml"
    path.write_text(f"manifest_version: 1\nsystem: s\n{text}", encoding="utf-8")
    assert main(["check", str(path)]) == 3
    assert "give --run-commands" in capsys.readouterr().out
    assert main(["check", str(path), "--run-commands"]) == 0


@pytest.mark.usefixtures("without_programs")
def test_a_manifest_may_be_named_by_its_package_and_file_as_ros2_launch_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    index = tmp_path / "share/ament_index/resource_index/packages"
    folder = tmp_path / "share/robot/manifests"
    for each in (index, folder):
        each.mkdir(parents=True)
    (index / "robot").touch()
    text = (ROOT / "manifests/first_node.lifecycle.yaml").read_text()
    (folder / "first.lifecycle.yaml").write_text(text)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))

    assert main(["check", "robot", "first.lifecycle.yaml", "greeting:=Hi"]) == 0
    assert main(["check", "robot", "other.lifecycle.yaml"]) == 2
    assert main(["check", "robt", "first.lifecycle.yaml"]) == 2
    assert main(["check", "submarine", "first.lifecycle.yaml"]) == 2
    assert main(["run", "robot", "greeting:=Hi"]) == 2

    out, err = capsys.readouterr()
    assert out.startswith("first_node: 2 nodes")
    where = f"'{tmp_path}/share/robot'"
    assert err.splitlines() == [
        f"cannot choose 'other.lifecycle.yaml': no such manifest in {where}: first.lifecycle.yaml",
        "cannot find a file or a package 'robt'; did you mean 'robot'?",
        (
            "cannot find a file or a package 'submarine'; source the setup file of the package's "
            "workspace"
        ),
        (
            "cannot find the node in 'greeting:=Hi'; it comes before the arguments: lifecycle run "
            "MANIFEST NODE NAME:=VALUE"
        ),
    ]
