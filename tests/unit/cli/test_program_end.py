"""How the process of `lifecycle` ends: at once, unless Fast DDS has shared memory to remove."""

from __future__ import annotations

import os
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
