"""Command lines of ssh, what its failures mean, what is sent, and how clocks compare."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.errors import UsageError
from lifecycle.fleet.parts import destinations, in_place, parts_of, ranks
from lifecycle.fleet.protocol import RoundTrip, clock_offset
from lifecycle.fleet.transport import Closed, SshTransport, explained, ssh_command
from lifecycle.manifest import load, noting_files
from lifecycle.plan import build_plan

TEXT = """
manifest_version: 1
system: patrol
discovery: {domain_id: 7, range: subnet}
arguments: {rate: {default: "5.0"}}
machines:
  robot: {address: 10.77.0.1}
  dock: {address: 10.77.0.2}
  spare: {}
nodes:
  camera:
    run: {command: [sleep, "1"]}
    machine: robot
    parameter_files: [params/camera.yaml]
    interface: {}
  viewer: {run: {command: [sleep, "1"]}, machine: dock, after: {camera: started}, interface: {}}
  clock: {run: {command: [sleep, "1"]}, interface: {}}
"""


_SETUP = ". /opt/ros/jazzy/setup.sh && /PATH/TO/lifecycle"


@pytest.fixture
def manifest(tmp_path: Path) -> Path:
    (tmp_path / "here" / "params").mkdir(parents=True)
    (tmp_path / "here" / "params" / "camera.yaml").write_text("/**: {ros__parameters: {x: 1}}\n")
    file = tmp_path / "here" / "patrol.lifecycle.yaml"
    file.write_text(TEXT)
    return file


def test_what_is_in_the_folder_of_the_manifest_is_sent_to_each_machine(manifest: Path) -> None:
    with noting_files() as files:
        plan = build_plan(load(manifest).manifest)
    parts, unsent = parts_of(plan, files, options=("--strict",))
    assert [(each.name, each.machine) for each in parts] == [
        ("patrol@7.robot", "robot"),
        ("patrol@7.dock", "dock"),
        ("patrol@7.local", "local"),
    ]
    assert {each.path for each in parts[0].files} == {
        "patrol.lifecycle.yaml",
        "params/camera.yaml",
    }
    assert parts[0].manifest == "patrol.lifecycle.yaml"
    assert len({each.digest for each in parts}) == 1
    assert unsent == ()
    assert in_place(parts[0], str(manifest)).manifest == str(manifest)
    assert ranks(plan) == {"robot": 0, "dock": 1, "local": 0}


def test_no_file_from_elsewhere_leaves_this_host_for_a_manifest_that_names_it(
    manifest: Path, tmp_path: Path
) -> None:
    (tmp_path / "secret.yaml").write_text("/**: {ros__parameters: {x: 1}}\n")
    (manifest.parent / "params" / "camera.yaml").unlink()
    (manifest.parent / "params" / "camera.yaml").symlink_to(tmp_path / "secret.yaml")
    with noting_files() as files:
        plan = build_plan(load(manifest).manifest)
    parts, unsent = parts_of(plan, files)
    assert [each.path for each in parts[0].files] == ["patrol.lifecycle.yaml"]
    assert unsent == (str(manifest.parent / "params" / "camera.yaml"),)


def test_a_machine_is_at_its_address_unless_it_is_said_where(manifest: Path) -> None:
    plan = build_plan(load(manifest).manifest)
    assert destinations(plan, {"dock": "op@dock.lan"}, lambda name: name == "robot") == {
        "robot": "",
        "dock": "op@dock.lan",
        "spare": "spare",
        "local": "",
    }
    with pytest.raises(UsageError, match="declares no such machine; declared: dock, local, robot"):
        destinations(plan, {"boat": "x"}, lambda _: False)


def test_nothing_but_the_users_own_text_reaches_a_shell_and_no_place_is_an_option() -> None:
    argv = SshTransport(
        machine="a; reboot",
        destination="-oProxyCommand=reboot",
        remote_command=". /opt/ros/jazzy/setup.sh && lifecycle",
        ssh=ssh_command("ssh -F '/a b/config'"),
    ).argv()
    assert argv[:3] == ("ssh", "-F", "/a b/config")
    assert argv[-3:] == (
        "--",
        "-oProxyCommand=reboot",
        ". /opt/ros/jazzy/setup.sh && lifecycle host-agent",
    )
    assert "BatchMode=yes" in argv
    assert not any("reboot" in each for each in argv[:-2])


@pytest.mark.parametrize(
    ("code", "stderr", "message", "hint"),
    [
        (
            255,
            "Host key verification failed.",
            "Host key verification failed.",
            "connect once by hand and compare its key: ssh dock",
        ),
        (
            255,
            "op@dock: Permission denied (publickey).",
            "op@dock: Permission denied (publickey).",
            "have it accept a key of yours, or load it by ssh-add: ssh dock",
        ),
        (
            255,
            "ssh: Could not resolve hostname dock: Name or service not known",
            "ssh: Could not resolve hostname dock: Name or service not known",
            "say where it is: --host dock=USER@ADDRESS",
        ),
        (
            127,
            "bash: line 1: lifecycle: command not found",
            "its shell cannot run 'lifecycle': bash: line 1: lifecycle: command not found",
            f"install it there, or say how it is run: --remote-command '{_SETUP}'",
        ),
        (
            2,
            "cannot find the verb 'host-agent'",
            "its lifecycle is of a version without --hosts: cannot find the verb 'host-agent'",
            "install the version there that is here",
        ),
        (None, "", "no answer in time", "try by hand: ssh dock"),
        (1, "", "'lifecycle' ended there with exit status 1: noise", "try it: ssh dock"),
    ],
)
def test_an_end_of_ssh_says_why_and_what_to_do(
    code: int | None, stderr: str, message: str, hint: str
) -> None:
    closed = Closed(exit_code=code, text=stderr)
    said = explained(
        closed, "noise", machine="dock", remote_command="lifecycle", by_hand="ssh dock"
    )
    assert said == (message, hint)


_SECONDS = st.floats(min_value=0, max_value=5)


@given(
    ahead_s=st.floats(min_value=-1e6, max_value=1e6),
    ways=st.lists(st.tuples(_SECONDS, _SECONDS, _SECONDS), min_size=1, max_size=8),
)
def test_the_true_offset_is_within_the_uncertainty_however_long_the_ways_are(
    ahead_s: float, ways: list[tuple[float, float, float]]
) -> None:
    readings = [
        RoundTrip(
            sent_s=0.0,
            there_s=there + ahead_s,
            answered_s=there + think + ahead_s,
            back_s=there + think + back,
        )
        for there, think, back in ways
    ]
    found = clock_offset(readings)
    assert abs(found.offset_s - ahead_s) <= found.uncertainty_s + 1e-6
    assert found.uncertainty_s <= min(there + back for there, _, back in ways) / 2 + 1e-6
    assert found.round_trips == len(ways)
