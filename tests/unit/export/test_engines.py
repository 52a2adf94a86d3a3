"""Units and manifests of engines, checked by the engines' own tools where these are installed."""

from __future__ import annotations

import configparser
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import click
import kubernetes_validate
import pytest
import yaml
from click.testing import CliRunner

from lifecycle.cli import cli
from lifecycle.errors import UsageError
from lifecycle.export.engines import ENGINES, Deployment
from lifecycle.plan.model import Plan
from tests.builders import plan_of, planned_node

ROOT = Path(__file__).parents[3]
TELEOP = str(ROOT / "manifests/teleop.lifecycle.yaml")
PLAN = plan_of(planned_node("camera"), planned_node("viewer", after={"camera": "active"}))


def written(engine: str, **fields: Any) -> str:
    (text,) = ENGINES[engine](
        Deployment(
            **{
                "plan": PLAN,
                "manifest": "/system/robot.lifecycle.yaml",
                "image": "robot:1",
                **fields,
            }
        )
    ).values()
    return text


def exported(tmp_path: Path, *words: str) -> dict[str, str]:
    result = CliRunner().invoke(cli, ["export", *words, "-o", str(tmp_path)], standalone_mode=False)
    if result.exception is not None:
        raise result.exception
    return {each.name: each.read_text() for each in tmp_path.iterdir()}


def deadlines_s(plan: Plan) -> float:
    limits = [plan.node(key).timeouts for level in plan.levels for key in level]
    return sum(
        each.start_s + each.configure_s + each.connect_s + each.activate_s for each in limits
    )


def sections(text: str) -> configparser.ConfigParser:
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read_string(text)
    return parser


def test_each_machine_has_a_unit_that_starts_its_part(tmp_path: Path) -> None:
    files = exported(tmp_path, "systemd", TELEOP, "domain:=7", "--up", "--strict")
    assert sorted(files) == ["teleop-operator.service", "teleop-robot.service"]
    service = sections(files["teleop-robot.service"])["Service"]
    assert service["ExecStart"] == (
        f"/opt/lifecycle/bin/lifecycle up {TELEOP} --machine robot domain:=7 --strict"
    )
    assert service["WorkingDirectory"] == str(Path.cwd())
    assert service["Type"] == "notify"
    assert (service["Restart"], service["RestartPreventExitStatus"]) == ("on-failure", "2 3 4 5 7")
    assert "AmbientCapabilities" not in service


def test_relative_programs_are_looked_for_beside_a_manifest_that_is_elsewhere(
    tmp_path: Path,
) -> None:
    files = exported(tmp_path, "systemd", TELEOP, "--at", "/etc/100%/t.lifecycle.yaml")
    assert sections(files["teleop-robot.service"])["Service"]["WorkingDirectory"] == "/etc/100%%"


def test_who_programs_networks_may_do_that_and_no_more(tmp_path: Path) -> None:
    text = exported(tmp_path, "systemd", TELEOP, "--up", "--program nft")["teleop-robot.service"]
    service = sections(text)["Service"]
    assert service["AmbientCapabilities"] == service["CapabilityBoundingSet"] == "CAP_NET_ADMIN"
    with pytest.raises(UsageError, match="export systemd"):
        exported(tmp_path, "kubernetes", TELEOP, "--image", "i", "--up", "--program nft")


def test_words_with_signs_of_systemd_stand_for_themselves() -> None:
    text = written("systemd", words=('name:=a b"c', "share:=100%", "home:=$HOME", "back:=\\"))
    line = sections(text)["Service"]["ExecStart"]
    assert line.endswith(
        r'/system/robot.lifecycle.yaml "name:=a b\"c" share:=100%% home:=$$HOME "back:=\\"'
    )


def test_kubernetes_takes_its_objects() -> None:
    made = yaml.safe_load(written("kubernetes", words=("a:=$(b)",)))
    kubernetes_validate.validate(made, "1.30", strict=True)
    assert made["kind"] == "Deployment"  # which starts a killed supervisor again, and no node
    (container,) = made["spec"]["template"]["spec"]["containers"]
    assert container["args"][-1] == "a:=$$(b)"
    assert container["readinessProbe"]["exec"]["command"][-2:] == ["--probe", "ready"]
    assert container["livenessProbe"]["exec"]["command"][-2:] == ["--probe", "live"]
    assert container["securityContext"]["runAsNonRoot"]
    # Its own deadlines end a bring-up that fails, before the engine does.
    start = container["startupProbe"]
    assert start["periodSeconds"] * start["failureThreshold"] >= deadlines_s(PLAN) + 30


def test_machines_of_kubernetes_are_its_nodes(tmp_path: Path) -> None:
    files = exported(tmp_path, "kubernetes", TELEOP, "--image", "teleop:1")
    for machine in ("robot", "operator"):
        made = yaml.safe_load(files[f"teleop-{machine}.yaml"])
        kubernetes_validate.validate(made, "1.30", strict=True)
        pod = made["spec"]["template"]["spec"]
        assert pod["nodeSelector"] == {"kubernetes.io/hostname": machine}
        assert pod["hostNetwork"]
        assert pod["hostIPC"]


LIMITED = """
manifest_version: 1
system: limited
machines:
  here: {address: 10.0.0.1}
  there: {address: 10.0.0.2}
nodes:
  arm:
    run: {command: [arm], resources: {cpu_quota_percent: 50, tasks_max: 20}}
    machine: here
  eye: {run: {command: [eye]}, machine: here}
  hand: {run: {command: [hand]}, machine: there}
"""


def test_a_container_in_which_nothing_limits_processes_is_refused(tmp_path: Path) -> None:
    manifest = tmp_path / "limited.lifecycle.yaml"
    manifest.write_text(LIMITED)
    with pytest.raises(UsageError) as raised:
        exported(tmp_path / "out", "kubernetes", str(manifest), "--image", "i")
    assert str(raised.value) == (
        f"{manifest}:9:27: cannot give process 'arm' its 'run.resources' in a container of "
        "Kubernetes: systemd limits what a process may use, and does not run there; leave "
        "'resources' out and limit the whole container (resources.limits), or write a unit: "
        "lifecycle export systemd"
    )
    assert not (tmp_path / "out").exists()


def test_a_unit_whose_processes_systemd_limits_runs_as_root_which_alone_may_ask_for_it(
    tmp_path: Path,
) -> None:
    manifest = tmp_path / "limited.lifecycle.yaml"
    manifest.write_text(LIMITED)
    exported(tmp_path / "out", "systemd", str(manifest))
    here, there = (
        (tmp_path / f"out/limited-{each}.service").read_text() for each in ("here", "there")
    )
    assert "DynamicUser" not in here
    assert "CapabilityBoundingSet=\n" in here
    assert "DynamicUser=yes\n" in there


AWKWARD = """
manifest_version: 1
system: The_Longest-System_Name_That_Anybody_Would_Write_In_A_Manifest_Of_Theirs
arguments: {what: {default: a}}
machines:
  Left_Arm: {address: 10.0.0.1}
  right_arm: {address: 10.0.0.2}
  _base: {address: 10.0.0.3}
modes: {normal: {}, safe: {inactive: [hand]}}
nodes:
  arm:
    run: {command: [arm], environment: {ARM_TOKEN: topsecret}, limits: {nofile: 512}}
    machine: Left_Arm
    timeouts: {configure_s: 400, deactivate_s: 90}
  hand: {run: {command: [hand]}, machine: right_arm, restart: always, after: {arm: active}}
  eye: {run: {command: [eye]}, machine: _base, health: {diagnostics: ["eye: *"]}}
  cart: {run: {command: [cart]}, parameters: {what: $(arg what)}}
"""
SIGNS = 'x y\nTimeoutStartSec=1\n %h $HOME ${A} "q" \' \\ ; é \t'
"""What a shell, systemd and Kubernetes each would read as something else."""


@pytest.fixture(scope="module")
def awkward(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """What each engine is given for manifests of all kinds: folders, by engine."""
    base = tmp_path_factory.mktemp("engines")
    manifest = base / "awkward manifest.lifecycle.yaml"
    manifest.write_text(AWKWARD)
    shipped = ROOT / "manifests"
    for engine, option in (
        ("systemd", ("--program", "/bin/true", "--up", "--strict --timeout 600")),
        ("kubernetes", ("--image", "reg:5000/robot:1")),
    ):
        for words in (
            (str(manifest), f"what:={SIGNS}"),
            (str(shipped / "first_node.lifecycle.yaml"),),
            (str(shipped / "client_server_master.lifecycle.yaml"),),
            (TELEOP,),
        ):
            command = ["export", engine, *words, "-o", str(base / engine), *option]
            CliRunner().invoke(cli, command, standalone_mode=False, catch_exceptions=False)
    return {engine: base / engine for engine in ENGINES}


def checked(*command: str | Path, **environment: str) -> str:
    """Run an engine's tool, which must find nothing wrong."""
    done = subprocess.run(
        list(map(str, command)),
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
        env={**os.environ, **environment},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def test_no_two_parts_have_one_file(awkward: dict[str, Path]) -> None:
    for folder in awkward.values():
        names = [each.name for each in folder.iterdir()]
        assert len(names) == 4 + 1 + 2 + 2
        assert max(map(len, names)) <= 63 + len(".service")


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed")
def test_systemd_finds_nothing_wrong_with_its_units(
    awkward: dict[str, Path], tmp_path: Path
) -> None:
    exported(tmp_path, "systemd", TELEOP, "--program", "/bin/true", "--up", "--program 'nft'")
    for folder in (awkward["systemd"], tmp_path):
        assert checked("systemd-analyze", "verify", "--man=no", *folder.iterdir()) == ""


@pytest.mark.skipif(shutil.which("kubectl") is None, reason="kubectl is not installed")
def test_kubectl_loses_nothing_of_its_objects(awkward: dict[str, Path]) -> None:
    """Without a server: read into the API's own types, in which an unknown field is lost."""
    for each in awkward["kubernetes"].iterdir():
        made = yaml.safe_load(each.read_text())
        kubernetes_validate.validate(made, "1.30", strict=True)
        command = ("kubectl", "label", "--local", "-f", each, "app.kubernetes.io/part-of=x")
        read = yaml.safe_load(checked(*command, "-o", "yaml"))
        assert contained(made, read)


def contained(less: object, more: object) -> bool:
    """Return whether all of `less` is in `more`, at its place."""
    if isinstance(less, dict) and isinstance(more, dict):
        return all(key in more and contained(value, more[key]) for key, value in less.items())
    if isinstance(less, list) and isinstance(more, list):
        return len(less) == len(more) and all(map(contained, less, more))
    return less == more


def test_a_system_of_one_host_may_run_on_any_node(tmp_path: Path) -> None:
    """`local` is what its machine is called inside; no host has that name."""
    manifest = str(ROOT / "manifests/first_node.lifecycle.yaml")
    (text,) = exported(tmp_path, "kubernetes", manifest, "--image", "robot:1").values()
    assert "nodeSelector" not in text
    assert "--machine" not in text
    assert yaml.safe_load(text)["metadata"]["name"] == "first-node"


def test_machines_that_kubernetes_cannot_tell_apart_are_refused(tmp_path: Path) -> None:
    manifest = tmp_path / "robot.lifecycle.yaml"
    manifest.write_text(
        "manifest_version: 1\nsystem: robot\n"
        "machines: {arm_1: {address: 10.0.0.1}, Arm_1: {address: 10.0.0.2}}\n"
        "nodes:\n  a: {run: {command: [a]}, machine: arm_1}\n"
        "  b: {run: {command: [b]}, machine: Arm_1}\n"
    )
    files = exported(tmp_path / "units", "systemd", str(manifest))
    assert len(files) == 2
    assert all(each.startswith("robot-arm-1-") for each in files)
    with pytest.raises(UsageError, match="cannot choose a node of Kubernetes by the name"):
        exported(tmp_path / "k", "kubernetes", str(manifest), "--image", "robot:1")


def test_the_engine_restarts_the_part_of_a_machine_on_which_nothing_restarts_itself(
    awkward: dict[str, Path],
) -> None:
    units = {each.name: sections(each.read_text()) for each in awkward["systemd"].iterdir()}
    restart = {
        machine: next(
            unit["Service"]["Restart"] for name, unit in units.items() if f"{machine}-" in name
        )
        for machine in ("left-arm", "right-arm")
    }
    assert restart == {"left-arm": "on-failure", "right-arm": "on-abnormal"}


def test_an_engine_waits_as_long_as_nodes_may_take(awkward: dict[str, Path]) -> None:
    """A node that takes 90 s to park is not killed in the middle of it."""
    for each in awkward["systemd"].iterdir():
        service = sections(each.read_text())["Service"]
        assert service["KillMode"] == "mixed"
        if "left-arm" in each.name:
            assert int(service["TimeoutStopSec"]) > 90
            assert int(service["TimeoutStartSec"]) >= 600
    many = plan_of(*(planned_node(f"n{number}") for number in range(120)))
    service = sections(written("systemd", plan=many))["Service"]
    assert int(service["TimeoutStartSec"]) >= 30 + 120
    pods = awkward["kubernetes"].iterdir()
    (text,) = (each.read_text() for each in pods if "left-arm" in each.name)
    pod = yaml.safe_load(text)["spec"]["template"]["spec"]
    assert pod["terminationGracePeriodSeconds"] > 90


def test_what_up_would_refuse_is_refused(tmp_path: Path) -> None:
    with pytest.raises(click.ClickException, match="No such option '--nonsense'"):
        exported(tmp_path, "systemd", TELEOP, "--up", "--nonsense")


def test_places_that_an_engine_would_not_find_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"cannot use --program '\./lifecycle' in a unit"):
        exported(tmp_path, "systemd", TELEOP, "--program", "./lifecycle")
    with pytest.raises(UsageError, match="cannot use image 'a b'"):
        exported(tmp_path, "kubernetes", TELEOP, "--image", "a b")
