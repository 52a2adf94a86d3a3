"""What a verb needs of this host: an RMW that can be loaded, ROS 2, Linux; said in one line."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from lifecycle.cli import main
from lifecycle.errors import ExitCode
from lifecycle.middleware.versions import INSTALL

ROOT = Path(__file__).parents[3]
MANIFEST = "manifests/first_node.lifecycle.yaml"


@pytest.mark.parametrize("verb", ["up", "verify", "flows", "graph"])
def test_an_rmw_that_is_not_installed_is_one_clear_error(
    verb: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_nonsense_cpp")

    assert main([verb, "robot.lifecycle.yaml"]) is ExitCode.USAGE

    assert capfd.readouterr().err == (
        "cannot use RMW_IMPLEMENTATION='rmw_nonsense_cpp': this installation of ROS 2 cannot load "
        "that RMW; install it, or unset RMW_IMPLEMENTATION: the default is rmw_fastrtps_cpp\n"
    )


BARE = """
import sys

import asyncio, click, psutil, subprocess, tempfile, urllib.request  # of the real platform

platform, *words = sys.argv[1:]
GONE = {
    "rclpy", "rcl_interfaces", "std_msgs", "lifecycle_msgs", "ament_index_python", "rosidl_parser",
    "fcntl", "termios", "resource", "pwd", "grp", "ctypes",
}
for name in [each for each in sys.modules if each.partition(".")[0] in GONE]:
    del sys.modules[name]
sys.modules.update(dict.fromkeys(GONE))
sys.platform = platform
if platform != "linux":
    import os
    import signal

    for name in "O_NONBLOCK O_CLOEXEC killpg posix_fallocate getuid fork pidfd_open".split():
        delattr(os, name)
    for name in "SIGKILL SIGHUP SIGCHLD".split():
        delattr(signal, name)
from lifecycle.cli import main

sys.exit(main(words))
"""
"""A program where there is no ROS 2, and nothing that only POSIX has."""


def _bare(platform: str, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", BARE, platform, *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("platform", ["linux", "darwin", "win32"])
def test_a_manifest_is_checked_and_planned_without_ros_on_any_platform(
    platform: str, tmp_path: Path
) -> None:
    for words in (
        ["check", MANIFEST],
        ["plan", MANIFEST],
        ["plan", MANIFEST, "--format", "svg"],
        ["export", "sros2", MANIFEST, "--output", str(tmp_path / "sros2")],
        ["init", "my_robot", "--directory", str(tmp_path / "my_robot")],
        ["schema"],
        ["ports"],
    ):
        done = _bare(platform, *words)
        assert (done.returncode, done.stderr) == (0, ""), words


@pytest.mark.parametrize("verb", ["up", "verify", "run"])
def test_a_verb_that_needs_ros_says_how_to_get_it(verb: str) -> None:
    done = _bare("linux", verb, MANIFEST)
    assert (done.returncode, done.stdout) == (ExitCode.USAGE, "")
    assert done.stderr == (
        f"cannot run 'lifecycle {verb}': it needs ROS 2, and this Python has no rclpy; "
        f"{INSTALL} for its Python\n"
    )


@pytest.mark.parametrize("platform", ["darwin", "win32"])
@pytest.mark.parametrize("verb", ["up", "status", "logs", "history"])
def test_what_runs_nodes_says_that_it_needs_linux(platform: str, verb: str) -> None:
    done = _bare(platform, verb, MANIFEST)
    assert (done.returncode, done.stdout) == (ExitCode.USAGE, "")
    assert done.stderr == (
        f"cannot run 'lifecycle {verb}' on {platform}: nodes are run and watched on Linux; what is "
        "about manifests works here: check, plan, export, import, init, schema\n"
    )


def test_a_ros_of_another_python_is_said_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    missing = "The C extension '/opt/_rclpy_pybind11.cpython-312.so' isn't present\non the system"

    def fail() -> None:
        raise ImportError(missing, name="rclpy._rclpy_pybind11")

    monkeypatch.setattr("lifecycle.cli.cli.main", lambda **_: fail())
    assert main(["up", MANIFEST]) is ExitCode.USAGE
    assert capfd.readouterr().err == (
        f"cannot import rclpy with Python {sys.version.split()[0]}: {' '.join(missing.split())}; "
        f"{INSTALL} for its Python\n"
    )


def test_installing_forces_nothing_of_ros_from_pypi() -> None:
    text = (ROOT / "pyproject.toml").read_text()
    (core,) = re.findall(r"^dependencies = \[(.*?)^\]", text, re.MULTILINE | re.DOTALL)
    (extra,) = re.findall(r"^ros = \[(.*)\]", text, re.MULTILINE)
    (dev,) = re.findall(r"^dev = \[(.*?)^\]", text, re.MULTILINE | re.DOTALL)
    assert "ros-" not in core
    assert "ros-jazzy-rclpy[fastrtps]" in extra
    assert "ros-lifecycle-manifests[ros," in dev
