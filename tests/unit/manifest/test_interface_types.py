"""Whether a type exists, by the ament index alone."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from lifecycle.manifest.installed_types import (
    find_resource,
    list_resources,
    search_prefixes,
    types_of,
)

INDEX = Path("share", "ament_index", "resource_index")


@pytest.fixture
def prefix(tmp_path: Path) -> Path:
    folder = tmp_path / INDEX / "rosidl_interfaces"
    folder.mkdir(parents=True)
    (folder / "sensor_msgs").write_text(
        "msg/Image.idl\nmsg/Image.msg\nmsg/Imu.idl\nsrv/SetCameraInfo.idl\nsrv/SetCameraInfo.srv\n"
    )
    (folder / ".hidden").write_text("")
    return tmp_path


def test_a_declared_type_exists(prefix: Path) -> None:
    assert types_of("sensor_msgs", [prefix]) == ("msg/Image", "msg/Imu", "srv/SetCameraInfo")


def test_a_package_that_is_not_installed_is_told_apart(prefix: Path) -> None:
    assert types_of("zzz", [prefix]) is None


def test_the_first_prefix_that_has_the_package_decides(prefix: Path, tmp_path: Path) -> None:
    overlay = tmp_path / "overlay"
    folder = overlay / INDEX / "rosidl_interfaces"
    folder.mkdir(parents=True)
    (folder / "sensor_msgs").write_text("msg/Own.msg\n")
    assert types_of("sensor_msgs", [overlay, prefix]) == ("msg/Own",)


def test_prefixes_are_the_variable_and_then_the_python_environment() -> None:
    listed = {"AMENT_PREFIX_PATH": "/a:/b::/a"}
    assert search_prefixes(listed) == (Path("/a"), Path("/b"), Path(sys.prefix))
    assert search_prefixes({}) == (Path(sys.prefix),)


def test_resources_are_listed_without_hidden_files(prefix: Path) -> None:
    assert list_resources("rosidl_interfaces", [prefix]) == ("sensor_msgs",)
    assert list_resources("nothing", [prefix]) == ()
    assert find_resource("rosidl_interfaces", "sensor_msgs", []) is None


def test_looking_a_type_up_imports_no_message_package() -> None:
    code = (
        "import sys; from lifecycle.manifest.installed_types import search_prefixes\n"
        "from lifecycle.manifest.installed_types import types_of\n"
        "types_of('sensor_msgs', search_prefixes())\n"
        "sys.exit(bool({'rclpy', 'sensor_msgs', 'ament_index_python'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
