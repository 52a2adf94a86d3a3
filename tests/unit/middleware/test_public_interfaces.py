"""What is below public interfaces, file by file: nothing is added without this table saying so."""

from __future__ import annotations

import re
from pathlib import Path

import lifecycle

ROOT = Path(lifecycle.__file__).parent

CTYPES = {
    "middleware/fastdds/factory.py",  # participants from profiles, eight public functions
    "middleware/process/control.py",  # prctl(2), and timers that end a process
    "middleware/rcl/abi.py",  # rcl's C API, checked by version and layout
}
"""Files that call libraries other than by Python."""

MANGLED = {
    "middleware/fastdds/factory.py",
}
"""Files that name C++ functions."""

FACTORY_SYMBOLS = 8


def files(pattern: str) -> set[str]:
    return {
        path.relative_to(ROOT).as_posix()
        for path in ROOT.rglob("*.py")
        if re.search(pattern, path.read_text(encoding="utf-8"), re.MULTILINE)
    }


def test_only_these_files_call_libraries_other_than_by_python() -> None:
    assert files(r"^\s*(import ctypes|from ctypes)") == CTYPES


def test_only_these_files_name_functions_of_cpp() -> None:
    assert files(r"_Z(N|TV)") == MANGLED


def test_participants_are_made_by_eight_functions_of_fast_dds() -> None:
    source = (ROOT / "middleware/fastdds/factory.py").read_text(encoding="utf-8")
    assert len(re.findall(r"f\"_ZN", source)) == FACTORY_SYMBOLS


def test_no_module_is_faked() -> None:
    assert files(r"sys\.modules\[[^]]+\]\s*=") == set()
