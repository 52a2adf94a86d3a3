"""The libraries of rclpy are loaded aside: before its import, which then has what it links to."""

from __future__ import annotations

import subprocess
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest

from lifecycle.middleware.rcl import library_loading

_ASIDE = """
import sys, threading
from pathlib import Path
from lifecycle.middleware import await_loading, begin_loading
begin_loading()
begin_loading()
await_loading()
loaded = Path("/proc/self/maps").read_text()
assert "rclpy" not in sys.modules, "it is imported"
assert "_rclpy_pybind11" in loaded and "librcl.so" in loaded, loaded
assert threading.active_count() == 1, threading.enumerate()
import rclpy
rclpy.init()
rclpy.shutdown()
"""


def test_they_are_there_before_rclpy_is_imported_and_no_thread_of_ours_is_left() -> None:
    subprocess.run([sys.executable, "-c", _ASIDE], check=True, timeout=60)


@pytest.mark.parametrize("is_there", [False, True], ids=["no rclpy", "no extension module"])
def test_what_cannot_be_loaded_is_left_to_the_import(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, is_there: bool
) -> None:
    spec = ModuleSpec("rclpy", None, is_package=True)
    spec.submodule_search_locations = [str(tmp_path)]
    monkeypatch.setattr(library_loading, "find_spec", lambda _: spec if is_there else None)
    monkeypatch.setattr(library_loading, "_threads", [])
    library_loading.begin_loading()
    library_loading.await_loading()
