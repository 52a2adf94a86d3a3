"""Who is notified of changes of a node's configuration, and that nobody is forgotten."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from lifecycle.node.configuration import ConfigurationChanges


def test_each_change_is_notified_though_the_executor_is_faster_than_who_asks_it() -> None:
    seen: list[Any] = []

    def at_once(task: Callable[[], Any]) -> object:
        task()
        return True

    changes = ConfigurationChanges(at_once, lambda: "now", failed=seen.append)  # type: ignore[arg-type,return-value]
    changes.listen(seen.append)
    for _ in range(3):
        changes.touch()
    assert seen == ["now"] * 3


def test_changes_before_a_notification_are_one() -> None:
    seen: list[Any] = []
    tasks: list[Callable[[], Any]] = []

    def later(task: Callable[[], Any]) -> object:
        tasks.append(task)
        return True

    changes = ConfigurationChanges(later, lambda: "now", failed=seen.append)  # type: ignore[arg-type,return-value]
    changes.listen(seen.append)
    changes.touch()
    changes.touch()
    assert len(tasks) == 1
    tasks.pop()()
    assert seen == ["now"]


def test_a_process_that_left_and_came_back_is_asked_again() -> None:
    asked: list[object] = []
    changes = ConfigurationChanges(asked.append, lambda: None, failed=print)  # type: ignore[arg-type,return-value]
    changes.listen(lambda _: None)
    changes.touch()
    changes.touch()
    assert len(asked) == 2
