"""How the process of `lifecycle` ends where it is interrupted, and where it fails."""

from __future__ import annotations

import subprocess
import sys

import pytest

from lifecycle.errors import ExitCode

_INTERRUPTED_WHILE = """
import os, signal, sys
from lifecycle import cli

class Named:
    def __set_name__(self, owner, name):
        os.kill(os.getpid(), signal.SIGINT)

def interrupted(**_):
    {}

if sys.argv.pop() == "interrupted":
    cli.cli.main = interrupted
else:
    cli.cli.main = lambda **_: 1 / 0
sys.exit(cli.program())
"""
_MAKES_A_CLASS = 'type("Made", (), {"named": Named()})'
_IMPORTS = """
    try:
        os.kill(os.getpid(), signal.SIGINT)
    except KeyboardInterrupt:
        pass
    raise ImportError("rclpy: initialization failed", name="rclpy")
"""


def ended(code: str, how: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", _INTERRUPTED_WHILE.format(code), "graph", how],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )


@pytest.mark.parametrize("code", [_MAKES_A_CLASS, _IMPORTS], ids=["a class", "an import"])
def test_an_interrupt_that_python_raises_something_else_for_is_no_bug(code: str) -> None:
    done = ended(code, "interrupted")
    assert (done.returncode, done.stderr) == (ExitCode.INTERRUPTED, "")


def test_an_error_without_an_interrupt_is_reported_as_a_bug() -> None:
    done = ended("pass", "fails")
    assert done.returncode == ExitCode.INTERNAL
    assert "ZeroDivisionError" in done.stderr
    assert "this is a bug in lifecycle" in done.stderr
