"""The gate of a hosted rclpy.lifecycle node: an activate that does not succeed leaves it closed."""

from __future__ import annotations

import asyncio
import contextlib
import enum
import time
import types
from typing import Any

import pytest

pytest.importorskip("rclpy")

from lifecycle.manifest.model import Timeouts
from lifecycle.middleware.rcl.rclpy_nodes import RCLError
from lifecycle.node.gate import NodeGate
from lifecycle.node.host.foreign import ForeignNode
from lifecycle.node.machine import RefusedError


class Returned(enum.Enum):
    """As rclpy's TransitionCallbackReturn."""

    SUCCESS = 0
    FAILURE = 1
    ERROR = 2


class Machine:
    """Does what the test says at `activate`, and goes to inactive at `deactivate`."""

    def __init__(self, activate: Any) -> None:
        self.label = "inactive"
        self._activate = activate

    def change(self, operation: str) -> Any:
        if operation == "deactivate":
            self.label = "inactive"
            return Returned.SUCCESS
        returned = self._activate()
        if returned is Returned.SUCCESS:
            self.label = "active"
        return returned


def _refuse() -> Any:
    raise RCLError("not now")


def _leave() -> Any:
    raise SystemExit(1)


def _late() -> Any:
    time.sleep(0.06)
    return Returned.SUCCESS


def _node(activate: Any) -> ForeignNode:
    node = ForeignNode.__new__(ForeignNode)
    members: dict[str, Any] = {
        "full_name": "/base",
        "gate": NodeGate(),
        "_machine": Machine(activate),
        "_is_constructed": True,
        "is_destroyed": False,
        "_let_through": False,
        "_supervisor": "robot",
        "spec": types.SimpleNamespace(timeouts=Timeouts(activate_s=0.05)),
        "log": types.SimpleNamespace(error=lambda _: None),
    }
    for name, value in members.items():
        setattr(node, name, value)
    return node


@pytest.mark.parametrize(
    "activate",
    [_refuse, _leave, _late, lambda: Returned.FAILURE, lambda: Returned.ERROR],
    ids=["refused", "raised", "too late", "failed", "error"],
)
def test_an_activate_that_does_not_succeed_leaves_the_gate_closed(activate: Any) -> None:
    node = _node(activate)
    with contextlib.suppress(RefusedError, SystemExit):
        asyncio.run(node.change_for_supervisor("activate"))
    assert not node.gate.is_open
    assert not node.may_activate()
    assert node.reported.label == "inactive"


def test_one_that_succeeds_opens_it_and_a_second_changes_nothing() -> None:
    node = _node(lambda: Returned.SUCCESS)
    asyncio.run(node.change_for_supervisor("activate"))
    assert node.gate.is_open
    node._machine._activate = _refuse  # type: ignore[union-attr]
    with pytest.raises(RefusedError):
        asyncio.run(node.change_for_supervisor("activate"))
    assert node.gate.is_open
    assert node.may_activate()


def test_one_that_was_too_late_and_cannot_be_deactivated_leaves_it_closed() -> None:
    node = _node(_late)
    machine: Any = node._machine
    change = machine.change

    def refuse(operation: str) -> Any:
        return _refuse() if operation == "deactivate" else change(operation)

    machine.change = refuse
    with pytest.raises(RefusedError):
        asyncio.run(node.change_for_supervisor("activate"))
    assert not node.gate.is_open
    assert not node.may_activate()
