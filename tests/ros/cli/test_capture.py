"""`lifecycle capture` of systems that run, on real DDS."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from lifecycle.errors import ExitCode
from lifecycle.manifest.loading import load
from tests.ros.supervisor.running import BOUND_S, ENOUGH, pair, up, verb

pytestmark = pytest.mark.thorough

_SETTLES = ("--attach", "--wait", str(BOUND_S / 2))
"""It ends once nothing changes any more, which takes a busy machine longer."""

_ACTION_SERVER = ("action server", "/left/dock", "test_msgs/action/Fibonacci")
_ACTION_CLIENT = ("action client", *_ACTION_SERVER[1:])


@pytest.mark.parametrize("nodl", [False, True])
def test_what_was_captured_from_foreign_nodes_is_verified_by_them(
    tmp_path: Path, foreign: int, nodl: bool
) -> None:
    manifest = tmp_path / "found.lifecycle.yaml"
    options = (*_SETTLES, *(("--nodl-dir", str(tmp_path / "nodl")) if nodl else ()))
    captured = verb(
        "capture", "--domain", str(foreign), "--output", str(manifest), *options, runtime=tmp_path
    )
    assert (captured.returncode, captured.stdout, captured.stderr) == (ExitCode.OK, "", "")
    checked = verb("check", str(manifest), runtime=tmp_path)
    assert checked.returncode == ExitCode.OK, checked.stderr
    judged = verb(
        "verify", str(manifest), *ENOUGH, "--strict", "--format", "json", runtime=tmp_path
    )
    verdict = json.loads(judged.stdout)
    # All that discovery shows is as captured; whether data flow between the two it does not show.
    assert [each["rule"] for each in verdict["findings"]] == ["flow.unreported"], judged.stdout
    assert (judged.returncode, verdict["verdict"]) == (ExitCode.UNVERIFIABLE, "unverifiable")

    nodes = {each.key: each for each in load(str(manifest), {}).manifest.nodes}
    assert {key: node.managed for key, node in nodes.items()} == {
        "left_scanner": False,
        "managed": True,
        "off": False,
        "right_scanner": False,
        "twice": False,
    }
    actions = {
        key: [(each.kind.noun, each.name, each.type) for each in node.interface.endpoints]
        for key, node in nodes.items()
    }
    assert _ACTION_SERVER in actions["managed"]
    assert _ACTION_CLIENT in actions["off"]
    assert "_action" not in "".join(name for each in actions.values() for _, name, _ in each)
    left = nodes["left_scanner"]
    assert [each.name for each in left.interface.endpoints] == [
        "/left/_hidden/map",
        "/left/scan",
        "/left/scanner/reset",
    ]
    assert {each.name: each.default for each in left.interface.parameters} == {
        "frames": ("$(arg x)", "no", 'a "b"\n'),
        "limits.low": -3,
        "on": "08",
        "rate": 10.0,
    }
    assert bool(list((tmp_path / "nodl").glob("*.nodl.yaml")) if nodl else False) is nodl


def test_two_captures_of_one_system_are_the_same_text(tmp_path: Path, foreign: int) -> None:
    options = ("--domain", str(foreign), *_SETTLES)
    first, second = (verb("capture", *options, runtime=tmp_path) for _ in "12")
    assert first.stdout == second.stdout
    assert yaml.safe_load(first.stdout)["discovery"] == {"domain_id": foreign, "range": "localhost"}


def test_our_own_nodes_tell_their_depth_their_flows_and_their_process(
    tmp_path: Path, fresh_domain: int
) -> None:
    edit = {
        "nodes/talker/interface/publishers": [
            {
                "name": "chatter",
                "type": "std_msgs/msg/String",
                "qos": {"history": "KEEP_LAST", "depth": 3},
            }
        ],
        "nodes/talker/flows": {
            "publishers": {"chatter": {"unique": "strictly_required", "dscp": "EF"}}
        },
        "nodes/listener/flows": {"subscriptions": {"chatter": {"unique": "strictly_required"}}},
    }
    manifest = tmp_path / "found.lifecycle.yaml"
    with up(pair(tmp_path, fresh_domain, edit=edit), runtime=tmp_path) as run:
        run.until("system", reached="active")
        options = ("--domain", str(fresh_domain), "--output", str(manifest), *_SETTLES)
        captured = verb("capture", *options, runtime=tmp_path)
        assert (captured.returncode, captured.stderr) == (ExitCode.OK, "")
        judged = verb("verify", str(manifest), *ENOUGH, "--format", "json", runtime=tmp_path)
        verdict = json.loads(judged.stdout)
        assert (verdict["verdict"], verdict["findings"]) == ("ok", [])
        text = manifest.read_text()
        assert f"  talker:  # pid {run.pid_of('talker')} when it was captured\n" in text
    nodes = {each.key: each for each in load(str(manifest), {}).manifest.nodes}
    assert list(nodes) == ["listener", "talker"]
    qos = nodes["talker"].interface.endpoints[0].qos
    assert qos is not None
    assert qos.depth == 3
    assert nodes["talker"].flows[0].dscp == 46


def test_an_empty_domain_is_said(tmp_path: Path, fresh_domain: int) -> None:
    options = ("--domain", str(fresh_domain), "--wait", "3")
    captured = verb("capture", *options, runtime=tmp_path)
    assert captured.returncode == ExitCode.VIOLATED
    assert captured.stderr == (
        f"no node; looked in ROS domain {fresh_domain}, discovery range localhost\n"
        "nodes that only listed peers, a discovery server or shared memory lead to are not found "
        "so: `discovery: mode:` of their manifest says which; it is what to verify them by\n"
    )


def test_a_graph_that_does_not_settle_says_what_was_missing(tmp_path: Path, foreign: int) -> None:
    options = ("--domain", str(foreign), "--wait", "0.3")
    captured = verb("capture", *options, runtime=tmp_path)
    assert "gap: discovery had not settled after 0.3 s: " in captured.stderr
