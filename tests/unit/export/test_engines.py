"""Units and manifests of engines, checked by the engines' own tools where these are installed."""

from __future__ import annotations

import configparser
import shutil
import subprocess
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from click.testing import CliRunner

from lifecycle.cli import cli
from lifecycle.errors import UsageError
from lifecycle.export import ENGINES, Deployment
from lifecycle.plan import Plan
from tests.builders import plan_of, planned_node

ROOT = Path(__file__).parents[3]
TELEOP = str(ROOT / "manifests/teleop.lifecycle.yaml")
PLAN = plan_of(planned_node("camera"), planned_node("viewer", after={"camera": "active"}))


def written(engine: str, **fields: Any) -> str:
    (text,) = ENGINES[engine](
        Deployment(plan=PLAN, manifest="/system/robot.lifecycle.yaml", image="robot:1", **fields)
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
    assert service["Type"] == "notify"
    assert (service["Restart"], service["RestartPreventExitStatus"]) == ("on-failure", "2 3 4 5 7")
    assert "AmbientCapabilities" not in service


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed")
@pytest.mark.parametrize("more", [(), ("--up", "--program 'nft'")])
def test_systemd_finds_nothing_wrong_with_its_units(tmp_path: Path, more: tuple[str, ...]) -> None:
    exported(tmp_path, "systemd", TELEOP, "--program", "/bin/true", *more)
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *map(str, tmp_path.iterdir())],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_who_programs_networks_may_do_that_and_no_more(tmp_path: Path) -> None:
    text = exported(tmp_path, "systemd", TELEOP, "--up", "--program nft")["teleop-robot.service"]
    service = sections(text)["Service"]
    assert service["AmbientCapabilities"] == service["CapabilityBoundingSet"] == "CAP_NET_ADMIN"
    with pytest.raises(UsageError, match="export systemd"):
        exported(tmp_path, "compose", TELEOP, "--image", "i", "--up", "--program nft")


def test_words_with_signs_of_systemd_stand_for_themselves() -> None:
    text = written("systemd", words=('name:=a b"c', "share:=100%", "home:=$HOME", "back:=\\"))
    line = sections(text)["Service"]["ExecStart"]
    assert line.endswith(
        r'/system/robot.lifecycle.yaml "name:=a b\"c" share:=100%% home:=$$HOME "back:=\\"'
    )


@pytest.mark.parametrize("restarts", [False, True])
def test_kubernetes_takes_its_objects(*, restarts: bool) -> None:
    made = yaml.safe_load(written("kubernetes", restarts=restarts, words=("a:=$(b)",)))
    kubernetes_validate.validate(made, "1.30", strict=True)
    assert made["kind"] == ("Pod" if restarts else "Deployment")
    pod = made["spec"] if restarts else made["spec"]["template"]["spec"]
    (container,) = pod["containers"]
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


def test_compose_has_a_service_that_is_healthy_once_verified() -> None:
    made = yaml.safe_load(written("compose", words=("a:=$b",)))
    (service,) = made["services"].values()
    assert service["command"] == ["up", "/system/robot.lifecycle.yaml", "a:=$$b"]
    assert service["healthcheck"]["test"][-2:] == ["--probe", "ready"]
    assert (service["network_mode"], service["ipc"], service["cap_drop"]) == (
        "host",
        "host",
        ["ALL"],
    )


@pytest.mark.skipif(
    shutil.which("docker") is None
    or subprocess.run(["docker", "compose", "version"], capture_output=True, check=False).returncode
    != 0,
    reason="docker compose is not installed",
)
def test_compose_finds_nothing_wrong_with_its_file(tmp_path: Path) -> None:
    exported(tmp_path, "compose", TELEOP, "--image", "teleop:1")
    for each in tmp_path.iterdir():
        subprocess.run(["docker", "compose", "-f", str(each), "config", "--quiet"], check=True)


@pytest.mark.parametrize(
    ("restarts", "unit", "composed"),
    [(False, "on-failure", "on-failure:5"), (True, "on-abnormal", "no")],
)
def test_what_fails_is_restarted_by_one_of_both(restarts: bool, unit: str, composed: str) -> None:
    assert sections(written("systemd", restarts=restarts))["Service"]["Restart"] == unit
    assert sections(written("quadlet", restarts=restarts))["Service"]["Restart"] == unit
    (service,) = yaml.safe_load(written("compose", restarts=restarts))["services"].values()
    assert service["restart"] == composed
    pod = yaml.safe_load(written("kubernetes", restarts=restarts))["spec"]
    assert pod.get("restartPolicy") == ("Never" if restarts else None)


def test_a_quadlet_is_probed_because_podman_passes_no_watchdog_on() -> None:
    unit = sections(written("quadlet"))
    assert "WatchdogSec" not in unit["Service"]
    assert unit["Container"]["HealthCmd"] == "lifecycle status robot --probe live"
    assert unit["Container"]["HealthOnFailure"] == "kill"
    assert unit["Container"]["Notify"] == "true"


def test_a_manifest_that_restarts_a_node_leaves_the_engine_its_supervisor(tmp_path: Path) -> None:
    manifest = tmp_path / "robot.lifecycle.yaml"
    manifest.write_text(
        "manifest_version: 1\nsystem: robot\nnodes:\n"
        '  camera: {run: {python: "a:B"}, restart: on-failure}\n'
    )
    (text,) = exported(tmp_path / "out", "systemd", str(manifest)).values()
    assert sections(text)["Service"]["Restart"] == "on-abnormal"
