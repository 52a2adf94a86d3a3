"""Launch files become manifests; manifests are started from launch files and by ros2cli.

`launch`, `launch_ros` and `ros2cli` are not on PyPI: what needs them runs where ROS is installed.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from lifecycle.cli.launch_files import Launched, LaunchedNode, to_launched_manifest
from lifecycle.manifest.loading import load
from lifecycle.manifest.model import Restart


def _is_installed(name: str) -> bool:
    return importlib.util.find_spec(name) is not None


HAS_LAUNCH = _is_installed("launch") and _is_installed("launch_ros")
needs_launch = pytest.mark.skipif(not HAS_LAUNCH, reason="launch and launch_ros are not installed")

ROBOT = """
from launch import LaunchDescription
from launch.actions import (DeclareLaunchArgument, ExecuteProcess, GroupAction,
    IncludeLaunchDescription, LogInfo, OpaqueFunction, RegisterEventHandler, SetEnvironmentVariable,
    TimerAction)
from launch.conditions import IfCondition, UnlessCondition
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node, PushRosNamespace, SetParameter, SetRemap
from pathlib import Path

HERE = Path(__file__).parent


def generate_launch_description():
    talker = Node(
        package="demo", executable="talker", name="talker", output="screen", prefix="nice -n 5",
        remappings=[("chatter", "words")], additional_env={"A": "b"},
        respawn=True, respawn_delay=2.5,
        parameters=[str(HERE / "talker.yaml"), {"rate": 5.0, "a": {"b": [1, 2]}},
                    {"mode": LaunchConfiguration("mode"), "text": "$(x)"}])
    return LaunchDescription([
        DeclareLaunchArgument("mode", default_value="fast"),
        DeclareLaunchArgument("sim", default_value="false"),
        SetParameter("use_sim_time", True),
        SetEnvironmentVariable("ROBOT", "r2"),
        GroupAction([
            PushRosNamespace("left"), SetRemap("scan", "scan_raw"), talker,
            LifecycleNode(package="demo", executable="arm", name="arm", namespace="inner")]),
        Node(package="demo", executable="sim", condition=IfCondition(LaunchConfiguration("sim"))),
        Node(package="demo", executable="real",
             condition=UnlessCondition(LaunchConfiguration("sim")),
             ros_arguments=["--log-level", "warn"]),
        IncludeLaunchDescription(str(HERE / "part.launch.xml")),
        OpaqueFunction(function=lambda context: [Node(executable="/bin/own", name="own")]),
        TimerAction(period=2.0, actions=[
            LogInfo(msg="said to people"),
            Node(package="demo", executable="late", name="late", env={"ONLY": "this"})]),
        RegisterEventHandler(OnProcessExit(
            target_action=talker, on_exit=[Node(package="demo", executable="x", name="after")])),
        ExecuteProcess(cmd=["touch", str(HERE / "STARTED")]),
    ])
"""
PART = """<launch>
  <group>
    <push_ros_namespace namespace="part"/>
    <node pkg="demo" exec="talker" name="part" args="--fast 3">
      <param name="rate" value="2.0"/>
    </node>
  </group>
</launch>
"""
START = """
import sys
from launch import LaunchService
from launch.launch_description_sources import get_launch_description_from_any_launch_file as read
service = LaunchService(argv=[])
service.include_launch_description(read("a.launch.xml"))
sys.exit(service.run())
"""


def _lifecycle(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return _python(folder, "-m", "lifecycle", *words)


def _python(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env=os.environ,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@needs_launch
def test_a_launch_file_is_evaluated_and_nothing_of_it_started(tmp_path: Path) -> None:
    (tmp_path / "robot.launch.py").write_text(ROBOT)
    (tmp_path / "part.launch.xml").write_text(PART)
    (tmp_path / "talker.yaml").write_text("/**: {ros__parameters: {rate: 1.0}}\n")
    result = _lifecycle(tmp_path, "import", "robot.launch.py", "mode:=slow")
    assert result.returncode == 0, result.stderr
    assert not (tmp_path / "STARTED").exists()
    path = tmp_path / "robot.lifecycle.yaml"
    # The package of this test is not installed, so that no path below it can be found.
    path.write_text(result.stdout.replace("$(find-pkg-share demo)", "/opt/demo/share/demo"))
    manifest = load(path).manifest
    nodes = {f"{node.namespace.rstrip('/')}/{node.name}": node for node in manifest.nodes}
    assert list(nodes) == [
        *("/left/talker", "/left/inner/arm", "/real", "/part/part", "/own", "/late", "/after"),
    ]
    talker = nodes["/left/talker"]
    assert dict(talker.parameters) == {
        "use_sim_time": True,
        "rate": 5.0,
        "a.b": (1, 2),
        "mode": "slow",
        "text": "$(x)",
    }
    assert talker.parameter_files == (str(tmp_path / "talker.yaml"),)
    assert dict(talker.remap) == {"scan": "scan_raw", "chatter": "words"}
    assert (talker.run.package, talker.run.executable) == ("demo", "talker")
    assert talker.run.prefix == ("nice", "-n", "5")
    assert dict(talker.run.environment) == {"ROBOT": "r2", "A": "b"}
    assert talker.supervision.restart is Restart.ALWAYS
    assert talker.supervision.restart_sec == 2.5
    assert dict(nodes["/late"].run.environment)["ONLY"] == "this"
    assert [node.key for node in manifest.nodes if node.managed] == ["arm"]
    assert nodes["/part/part"].run.command[1:] == ("--fast", "3")
    assert nodes["/own"].run.command == ("/bin/own",)
    assert result.stderr.splitlines() == [
        "[INFO] [launch.user]: said to people",
        f"gap: the process 'touch {tmp_path}/STARTED' is no node: a manifest starts nodes only",
        "gap: /left/talker: launch lets talker.yaml win over parameters before it; here they win",
        "gap: /: ROS arguments --log-level warn: see remap, parameters and log_level",
        "gap: /late: launch starts it 2 s later; `after:` says what it waits for",
        "gap: /late: env, which are its only variables there: a manifest has nothing like it",
        "gap: /after: launch starts it on an event, OnProcessExit; `after:` says what it waits for",
    ]


@needs_launch
def test_a_launch_file_that_cannot_be_evaluated_says_why(tmp_path: Path) -> None:
    (tmp_path / "a.launch.xml").write_text('<launch><node pkg="p" exec="$(var x)"/></launch>')
    result = _lifecycle(tmp_path, "import", "a.launch.xml")
    assert result.returncode == 2
    assert "launch configuration 'x' does not exist" in result.stderr
    assert "give NAME:=VALUE here" in result.stderr


@needs_launch
def test_a_launch_file_starts_a_manifest(tmp_path: Path) -> None:
    (tmp_path / "a.launch.xml").write_text(
        '<launch><arg name="rate" default="5"/>'
        '<lifecycle_manifest manifest="a.lifecycle.yaml"><arg name="rate" value="$(var rate)"/>'
        "</lifecycle_manifest></launch>"
    )
    result = _python(tmp_path, "-c", START)
    output = result.stdout + result.stderr
    assert "lifecycle up a.lifecycle.yaml rate:=5" in output or "exit code 3" in output, output
    assert "a.lifecycle.yaml:1:1: cannot open 'a.lifecycle.yaml'" in output


@pytest.mark.skipif(not _is_installed("ros2cli"), reason="ros2cli is not installed")
def test_ros2_manifest_is_lifecycle(tmp_path: Path) -> None:
    program = "from ros2cli.cli import main; raise SystemExit(main())"
    result = _python(tmp_path, "-c", program, "manifest", "check", "none.lifecycle.yaml")
    assert result.returncode == 3, result.stderr
    assert "none.lifecycle.yaml:1:1: cannot open" in result.stdout


@pytest.mark.skipif(_is_installed("launch"), reason="launch is installed")
def test_without_launch_the_error_names_what_to_install(tmp_path: Path) -> None:
    result = _lifecycle(tmp_path, "import", "robot.launch.py")
    assert result.returncode == 2
    assert result.stderr == (
        "cannot import a launch file: the Python package 'launch' is not installed here; install "
        "the ros-DISTRO-launch package of your ROS distribution and source its setup file; PyPI "
        "has none\n"
    )


def test_what_launch_leaves_open_is_marked(tmp_path: Path) -> None:
    found = Launched(
        nodes=[
            LaunchedNode(
                name="",
                namespace="/",
                keys={"run": {"command": ["/bin/talk", "$$(date)"]}},
                gaps=["shell: a manifest has nothing like it"],
            ),
            LaunchedNode(
                name="a",
                namespace="/one",
                keys={"run": {"command": ["a"]}, "parameters": {"on": ["yes", "$$(y)"]}},
            ),
            LaunchedNode(name="a", namespace="/two", keys={"run": {"command": ["a"]}}),
        ],
        arguments={"mode": "fast"},
        gaps=["a timer"],
    )
    text = to_launched_manifest(found, source="x.launch.py", system="x")
    path = tmp_path / "x.lifecycle.yaml"
    path.write_text(text)
    manifest = load(path).manifest
    assert [(node.key, node.name, node.namespace) for node in manifest.nodes] == [
        ("talk", "talk", "/"),
        ("a", "a", "/one"),
        ("two_a", "a", "/two"),
    ]
    assert manifest.nodes[0].run.command == ("/bin/talk", "$(date)")
    assert dict(manifest.nodes[1].parameters) == {"on": ("yes", "$(y)")}
    first = "launch leaves its name to its code; the key must be that name"
    assert text.splitlines()[:11] == [
        "# yaml-language-server: $schema=manifest.v1.schema.json",
        "# Imported from x.launch.py: evaluated, and never run. `gap:` marks what is missing.",
        "# mode:=fast",
        "# gap: a timer",
        "manifest_version: 1",
        "system: x",
        "policy:  # as long as interfaces are missing",
        "  unpublished: ignore",
        "  unheard: ignore",
        "nodes:",
        f"  talk:  # gap: {first}; gap: shell: a manifest has nothing like it",
    ]
