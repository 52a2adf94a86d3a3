"""Who is told of the configuration, when, and how often."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from lifecycle.node.configuration import ConfigurationChanges


def unexpected(trace: str) -> None:
    raise AssertionError(trace)


class Executor:
    """Runs what it is given when it is told to."""

    def __init__(self) -> None:
        self.tasks: list[Callable[[], Any]] = []

    def later(self, task: Callable[[], Any]) -> bool:
        self.tasks.append(task)
        return True

    def turn(self) -> None:
        while self.tasks:
            returned = self.tasks.pop(0)()
            if returned is not None:
                for _ in returned.__await__():
                    raise AssertionError("the listeners of these tests do not wait")


def test_many_changes_of_one_turn_are_one_notice_and_are_collected_once() -> None:
    executor = Executor()
    collected: list[Any] = []
    heard: list[Any] = []

    def collect() -> Any:
        collected.append(object())
        return collected[-1]

    changes = ConfigurationChanges(executor.later, collect, failed=unexpected)
    changes.touch()
    assert executor.tasks == []  # nobody listens, so nothing is collected
    changes.listen(heard.append)
    changes.touch()
    changes.touch()
    executor.turn()
    assert heard == collected
    assert len(collected) == 1
    changes.touch()
    executor.turn()
    assert len(heard) == 2


def test_a_node_that_cannot_be_described_tells_the_log_and_nobody_else() -> None:
    executor = Executor()
    log: list[str] = []
    heard: list[Any] = []

    def collect() -> Any:
        raise OSError("no such file")

    changes = ConfigurationChanges(executor.later, collect, failed=log.append)
    changes.listen(heard.append)
    changes.touch()
    executor.turn()
    assert heard == []
    assert log[0].endswith("OSError: no such file\n")


def test_a_change_while_the_configuration_is_collected_is_told() -> None:
    executor = Executor()
    heard: list[Any] = []

    def collect() -> Any:
        if not heard:
            changes.touch()
        return object()

    changes = ConfigurationChanges(executor.later, collect, failed=unexpected)
    changes.listen(heard.append)
    changes.touch()
    executor.turn()
    assert len(heard) == 2
