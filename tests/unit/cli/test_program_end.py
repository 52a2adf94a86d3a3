"""How the process of `lifecycle` ends: at once, unless Fast DDS has shared memory to remove."""

from __future__ import annotations

import os
import subprocess
import sys
import types
from collections.abc import Callable

import pytest

from lifecycle import cli
from lifecycle.errors import ExitCode


class _EndedAtOnce(BaseException):
    """In the place of os._exit, with its code."""


class _Streams:
    def settled(self, code: int) -> int:
        return code


@pytest.fixture
def end(monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """Run `lifecycle verify` that is violated to its end."""

    def leave(code: int) -> None:
        raise _EndedAtOnce(code)

    def run(*, holds: bool) -> int:
        monkeypatch.setattr("lifecycle.middleware.holds_shared_memory", lambda: holds)
        return cli.program()

    monkeypatch.setattr(sys, "argv", ["lifecycle", "verify"])
    monkeypatch.setattr(cli, "main", lambda: ExitCode.VIOLATED)
    monkeypatch.setattr(cli, "own_streams", lambda **_: _Streams())
    monkeypatch.setattr(os, "_exit", leave)
    monkeypatch.setitem(sys.modules, "rclpy", types.ModuleType("rclpy"))
    return run


def test_a_process_that_used_ros_ends_at_once(end: Callable[..., int]) -> None:
    with pytest.raises(_EndedAtOnce) as ended:
        end(holds=False)
    assert ended.value.args == (ExitCode.VIOLATED,)


def test_fast_dds_is_unloaded_where_it_still_has_shared_memory(end: Callable[..., int]) -> None:
    assert end(holds=True) is ExitCode.VIOLATED


@pytest.mark.parametrize(
    ("verb", "code", "collects"),
    [
        ("verify", ExitCode.OK, False),
        ("verify", ExitCode.VIOLATED, False),
        ("verify", ExitCode.INTERRUPTED, True),
        ("up", ExitCode.INTERRUPTED, False),
        ("up", ExitCode.BRING_UP_FAILED, True),
    ],
)
def test_only_what_may_have_failed_is_searched_for_participants(
    end: Callable[..., int],
    monkeypatch: pytest.MonkeyPatch,
    verb: str,
    code: ExitCode,
    *,
    collects: bool,
) -> None:
    collected: list[bool] = []
    monkeypatch.setattr(sys, "argv", ["lifecycle", verb])
    monkeypatch.setattr(cli, "main", lambda: code)
    monkeypatch.setattr(cli.gc, "collect", lambda: collected.append(True))
    monkeypatch.setattr(cli.signal, "signal", lambda *_: None)
    with pytest.raises(_EndedAtOnce):
        end(holds=False)
    assert bool(collected) is collects


def test_a_process_without_ros_ends_at_once_and_loads_none_of_it(
    end: Callable[..., int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "rclpy")
    with pytest.raises(_EndedAtOnce) as ended:
        end(holds=True)
    assert ended.value.args == (ExitCode.VIOLATED,)


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


@pytest.mark.parametrize("code", [_MAKES_A_CLASS, _IMPORTS], ids=["a class", "an import"])
def test_an_interrupt_that_python_raises_something_else_for_is_no_bug(code: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _INTERRUPTED_WHILE.format(code), "graph", "interrupted"],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert (done.returncode, done.stderr) == (ExitCode.INTERRUPTED, "")


def test_an_error_without_an_interrupt_is_reported_as_a_bug() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _INTERRUPTED_WHILE.format("pass"), "graph", "fails"],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert done.returncode == ExitCode.INTERNAL
    assert "ZeroDivisionError" in done.stderr
    assert "this is a bug in lifecycle" in done.stderr
