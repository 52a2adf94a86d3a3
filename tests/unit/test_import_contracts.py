"""The arrows of ARCHITECTURE.md, held by import-linter and by a clean interpreter."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PURE_ROOMS = (
    "manifest",
    "network",
    "plan",
    "verify",
    "export",
    "run_directory",
    "programming.rules",
    "codec",
    "errors",
)


def test_imports_point_one_way() -> None:
    code = "import sys; from importlinter.cli import lint_imports_command; lint_imports_command()"
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize("room", PURE_ROOMS)
def test_a_pure_room_imports_without_ros(room: str) -> None:
    code = (
        "import sys\n"
        "class Refuse:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in {'rclpy', 'lifecycle_msgs', 'std_msgs', 'ctypes'}:\n"
        "            raise ImportError(name)\n"
        "for each in [n for n in sys.modules if n.split('.')[0] in {'rclpy', 'ctypes'}]:\n"
        "    del sys.modules[each]\n"
        "sys.meta_path.insert(0, Refuse())\n"
        f"import lifecycle.{room}\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr


def test_networks_are_programmed_without_ros_and_loaded_without_httpx() -> None:
    code = (
        "import sys\n"
        "sys.modules['rclpy'] = sys.modules['httpx'] = None\n"
        "import lifecycle.programming.apply\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
