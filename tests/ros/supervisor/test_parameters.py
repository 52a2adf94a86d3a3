"""Parameters of a running system, nodes of ours and of others, before the gate and behind it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rcl_interfaces.msg import ParameterType

from lifecycle.errors import ExitCode
from tests.ros.supervisor.running import ENOUGH, ROOT, Up, pair, up, verb

pytestmark = pytest.mark.thorough

ARM = str(ROOT / "tests" / "ros" / "supervisor" / "with_parameters.py")
DECLARED = {
    "gain": {"type": "double"},
    "limits.low": {"type": "int", "default_value": -3, "read_only": True},
    "joints": {"type": "string_array", "default_value": ["a", "b"]},
    "mode": {"type": "string"},
    "offset": {"type": "double"},
    "unset": {"type": "double"},
}


def arm(*options: str, name: str = "arm", **rest: Any) -> dict[str, Any]:
    """Return a foreign node of a manifest, with what it declares."""
    return {
        "run": {"command": [sys.executable, ARM, *options]},
        "managed": False,
        "name": name,
        "interface": {"parameters": DECLARED},
        **rest,
    }


def system(directory: Path, domain_id: int, foreign: dict[str, Any], **rest: Any) -> Path:
    """Write a talker and a listener of ours, the talker with parameters, and a foreign node."""
    talker = {
        "rate": {"type": "double", "default_value": 10.0},
        "label": {"type": "string"},
        "fixed": {"type": "int", "default_value": 3, "read_only": True},
    }
    edit = {
        "nodes/talker/interface/parameters": talker,
        "nodes/talker/parameters": {"label": "left"},
        "nodes/arm": foreign,
        **rest,
    }
    return pair(directory, domain_id, edit=edit)


Set = Callable[..., None]


def double(value: float) -> dict[str, Any]:
    return {"type": ParameterType.PARAMETER_DOUBLE, "double_value": value}


def found(run: Up) -> set[tuple[str, str]]:
    return {(each["rule"], each["subject"]) for each in run.verdict["findings"]}


def test_every_change_of_a_parameter_is_judged_until_it_is_set_back(
    tmp_path: Path, fresh_domain: int, set_parameter: Set
) -> None:
    values = tmp_path / "arm.yaml"
    values.write_text("/**/*: {ros__parameters: {joints: [c], offset: .nan}}\n")
    foreign = arm(
        namespace="/robot", name="left", parameters={"gain": 2.5}, parameter_files=[str(values)]
    )
    manifest = system(tmp_path, fresh_domain, foreign)
    with up(manifest, "--strict", runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.assert_gate_held()
        judged = verb("verify", str(manifest), *ENOUGH, "--strict", runtime=tmp_path)
        assert judged.returncode == ExitCode.OK, judged.stdout

        given, declared = "given under `parameters`", "declared in its interface"
        for node, name, wrong, right, expected in (
            ("/robot/left", "gain", double(99.0), double(2.5), f"double 2.5 as {given}"),
            (
                *("/talker", "rate", double(99.0), double(10.0)),
                f"double 10.0 as {declared}, where nothing else is given",
            ),
        ):
            since = len(run.events)
            set_parameter(node, name, **wrong)
            verdict = run.until_found("param.value-differs", f"{node}: {name}", since=since)
            (finding,) = verdict["findings"]
            assert (finding["expected"], finding["observed"]) == (expected, "99.0")
            since = len(run.events)
            set_parameter(node, name, **right)
            run.until_not_found("param.value-differs", since=since)

        # One that nobody judges changes nothing; one that is gone, or of another type, does.
        set_parameter("/robot/left", "unset", **double(7.0))
        since = len(run.events)
        set_parameter("/robot/left", "mode", type=ParameterType.PARAMETER_INTEGER, integer_value=5)
        run.until_found("param.type-differs", "/robot/left: mode", since=since)
        since = len(run.events)
        set_parameter("/robot/left", "mode", type=ParameterType.PARAMETER_NOT_SET)
        run.until_found("param.missing", "/robot/left: mode", since=since)

        judged = verb("verify", str(manifest), "--timeout", "1", runtime=tmp_path)
        assert judged.returncode == ExitCode.VIOLATED
        assert "param.missing: /robot/left: mode" in judged.stdout


def test_a_plain_node_of_ours_that_undeclares_a_parameter_is_found(
    tmp_path: Path, fresh_domain: int
) -> None:
    """Rclpy publishes no event of that."""
    forgetful = {
        "run": {
            "python": "tests.ros.supervisor.systems:Forgetful",
            "environment": {"FORGET": str(tmp_path / "forget")},
        },
        "managed": False,
        "interface": {"parameters": {"gain": {"type": "double", "default_value": 2.5}}},
    }
    with up(system(tmp_path, fresh_domain, forgetful), runtime=tmp_path) as run:
        run.until("system", reached="active")
        (tmp_path / "forget").touch()
        run.until_found("param.missing", "/arm: gain")


def test_a_node_whose_parameter_is_changed_is_deactivated_until_it_is_resumed(
    tmp_path: Path, fresh_domain: int, set_parameter: Set
) -> None:
    manifest = pair(
        tmp_path,
        fresh_domain,
        edit={
            "on_violation": {"param": "deactivate"},
            "nodes/talker/interface/parameters": {"rate": {"type": "double", "default_value": 1.5}},
        },
    )
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        since = len(run.events)
        set_parameter("/talker", "rate", **double(99.0))
        taken = run.until("consequence")
        assert (taken["action"], taken["nodes"]) == ("deactivate", ["/talker"])
        assert (taken["rule"], taken["subject"]) == ("param.value-differs", "/talker: rate")
        run.met("node", since=since, node="/talker", state="inactive")
        assert "param.value-differs" in verb("status", "pair", runtime=tmp_path).stdout
        assert verb("resume", "pair", runtime=tmp_path).returncode == ExitCode.VIOLATED
        set_parameter("/talker", "rate", **double(1.5))
        begun = len(run.events)
        assert verb("resume", "pair", runtime=tmp_path).returncode == ExitCode.OK
        run.met("request", since=begun, node="/talker", operation="activate")
        requests = [(each["node"], each["operation"]) for each in run.of_kind("request")]
        assert ("/listener", "deactivate") not in requests
        run.assert_gate_held()


def test_the_gate_stays_closed_over_parameters_that_are_not_what_is_declared(
    tmp_path: Path, fresh_domain: int
) -> None:
    declared = {
        "gain": {"type": "double", "default_value": 1.75},
        "limits.low": {"type": "double"},
        "joints": {"type": "string_array", "read_only": True},
        "bogus": {"type": "bool"},
    }  # neither its offset, nor its mode
    manifest = system(tmp_path, fresh_domain, arm(interface={"parameters": declared}))
    with up(manifest, "--timeout", "8", runtime=tmp_path) as run:
        assert run.finish() == ExitCode.VIOLATED
        run.assert_gate_held()
        assert not [each for each in run.of_kind("request") if each.get("operation") == "activate"]
        assert found(run) == {
            ("param.value-differs", "/arm: gain"),
            ("param.type-differs", "/arm: limits.low"),
            ("param.read-only-differs", "/arm: joints"),
            ("param.missing", "/arm: bogus"),
            ("param.undeclared", "/arm"),
        }


def test_a_parameter_that_is_declared_late_is_waited_for(tmp_path: Path, fresh_domain: int) -> None:
    now = tmp_path / "now"
    manifest = system(tmp_path, fresh_domain, arm("--late", str(now)))
    with up(manifest, "--strict", runtime=tmp_path) as run:
        run.until_found("param.missing", "/arm: mode")
        now.touch()
        run.until("system", reached="active")
        run.assert_gate_held()


@pytest.mark.parametrize(
    ("option", "why"),
    [("--mute", "it serves no parameters"), ("--hang", "it did not answer its parameter services")],
)
def test_parameters_that_nobody_tells_are_unverifiable(
    tmp_path: Path, fresh_domain: int, option: str, why: str
) -> None:
    manifest = system(tmp_path, fresh_domain, arm(option))
    with up(manifest, "--strict", runtime=tmp_path) as run:
        assert run.finish() == ExitCode.UNVERIFIABLE
        run.assert_gate_held()
        (finding,) = run.verdict["findings"]
        assert (finding["rule"], finding["node"]) == ("param.unverifiable", "/arm")
        assert finding["expected"] == f"parameters {', '.join(sorted(DECLARED))}"
        assert why in finding["message"]
