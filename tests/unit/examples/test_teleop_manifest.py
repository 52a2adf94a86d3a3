"""The teleop manifest, checked and planned; runs without ROS."""

from __future__ import annotations

from pathlib import Path

import pytest

from lifecycle.manifest.diagnostics import ManifestError
from lifecycle.manifest.loading import load
from lifecycle.plan.build import build_plan

MANIFEST = str(Path(__file__).parents[3] / "manifests" / "teleop.lifecycle.yaml")


def test_it_has_neither_errors_nor_warnings() -> None:
    assert load(MANIFEST).warnings == ()


def test_all_traffic_stays_on_this_computer_unless_told_otherwise() -> None:
    assert build_plan(load(MANIFEST).manifest).discovery_range.value == "localhost"
    wide = load(MANIFEST, {"range": "subnet"}).manifest
    assert build_plan(wide).discovery_range.value == "subnet"
    with pytest.raises(ManifestError, match="'moon'"):
        load(MANIFEST, {"range": "moon"})


def test_the_domain_is_the_environments_unless_told_otherwise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    assert build_plan(load(MANIFEST).manifest).domain_id == 0
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    assert build_plan(load(MANIFEST).manifest).domain_id == 7
    assert build_plan(load(MANIFEST, {"domain": "8"}).manifest).domain_id == 8


def test_machines_get_their_addresses_from_arguments() -> None:
    default = load(MANIFEST).manifest.machines
    assert {each.name: each.address for each in default} == {"robot": "", "operator": ""}
    given = load(MANIFEST, {"robot_address": "10.77.0.1", "operator_address": "10.77.0.2"})
    assert {each.name: each.address for each in given.manifest.machines} == {
        "robot": "10.77.0.1",
        "operator": "10.77.0.2",
    }


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("video: /robot/video", "video: /robot/vidoe", "'/robot/vidoe'"),
        ("qos: sensor_data", "qos: {reliability: RELIABLE}", "reliability"),
    ],
    ids=["a misspelt remap", "an incompatible reliability"],
)
def test_breaking_the_operator_as_the_readme_says_is_refused(
    tmp_path: Path, old: str, new: str, named: str
) -> None:
    robot, start, operator = Path(MANIFEST).read_text().partition("\n  operator:\n    run:")
    assert old in operator
    broken = tmp_path / "teleop.lifecycle.yaml"
    broken.write_text(robot + start + operator.replace(old, new, 1))
    with pytest.raises(ManifestError) as error:
        load(str(broken))
    assert named in str(error.value)
    assert "/robot/vid" in str(error.value)
