"""The order inside each transition: the framework's half, the user's, and what undoes them."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Generator
from typing import Any

import pytest

from lifecycle.manifest.model import Timeouts
from lifecycle.node.lifecycle.controller import Controller
from lifecycle.node.lifecycle.execution import Result
from lifecycle.node.lifecycle.machine import (
    CallbackOutcome,
    NodeState,
    TransitionRequest,
)


class FakeNode:
    """Writes down what it is asked; fails where the test says."""

    full_name = "/camera"

    def __init__(self) -> None:
        self.did: list[str] = []
        self.reports: list[Result] = []
        self.fail: dict[str, Exception] = {}
        self.callbacks: dict[str, Callable[..., Any]] = {}

    def _do(self, what: str) -> None:
        self.did.append(what)
        if what in self.fail:
            raise self.fail[what]

    def prepare(self) -> None:
        self._do("prepare")

    def unprepare(self) -> None:
        self._do("unprepare")

    def make_data_layer(self) -> None:
        self._do("make")

    def remove_data_layer(self) -> None:
        self._do("remove")

    def callback(self, name: str) -> Callable[..., Any]:
        self.did.append(name)
        return self.callbacks.get(name, lambda: None)

    def callback_argument(self, state: NodeState) -> object:
        return state

    def wake_at_deadline(self, deadline_s: float) -> Callable[[], None]:
        self.did.append(f"wake in {deadline_s:g} s")
        return lambda: self.did.append("call off")

    def wake(self) -> None:
        pass

    def report(self, result: Result) -> None:
        self.reports.append(result)


def run(coroutine: Coroutine[Any, Any, Result], *, turns: int = 5) -> Result:
    for _ in range(turns):
        try:
            coroutine.send(None)
        except StopIteration as stop:  # noqa: PERF203
            result: Result = stop.value
            return result
    raise AssertionError("still running")


@pytest.fixture
def node() -> FakeNode:
    return FakeNode()


@pytest.fixture
def controller(node: FakeNode) -> Controller:
    return Controller(node, Timeouts(), lambda change: None)


def bring(controller: Controller, node: FakeNode, *requests: TransitionRequest) -> None:
    for request in requests:
        assert run(controller.change(request)).outcome is CallbackOutcome.SUCCESS
    node.did.clear()


UP = (TransitionRequest.CONFIGURE, TransitionRequest.CONNECT, TransitionRequest.ACTIVATE)


@pytest.mark.parametrize(
    ("path", "asked", "did"),
    [
        ((), "configure", "prepare on_configure"),
        (UP[:1], "connect", "make on_connect"),
        (UP[:1], "activate", "make on_connect on_activate"),
        (UP[:2], "activate", "on_activate"),
        (UP, "deactivate", "on_deactivate"),
        (UP[:2], "disconnect", "on_disconnect remove"),
        (UP[:1], "cleanup", "on_cleanup unprepare"),
        (UP[:2], "cleanup", "on_disconnect remove on_cleanup unprepare"),
        ((), "shutdown", "on_shutdown remove unprepare"),
        (UP, "shutdown", "on_shutdown remove unprepare"),
    ],
)
def test_a_transition_does_these_things_in_this_order(
    controller: Controller,
    node: FakeNode,
    path: tuple[TransitionRequest, ...],
    asked: str,
    did: str,
) -> None:
    bring(controller, node, *path)
    result = run(controller.change(TransitionRequest(asked)))
    assert result.outcome is CallbackOutcome.SUCCESS
    assert node.did == did.split()


@pytest.mark.parametrize(
    ("path", "asked", "did", "state"),
    [
        ((), "configure", "prepare on_configure unprepare", NodeState.UNCONFIGURED),
        (UP[:1], "connect", "make on_connect remove", NodeState.INACTIVE_DISCONNECTED),
        (UP[:1], "activate", "make on_connect on_activate", NodeState.INACTIVE_CONNECTED),
        (UP[:2], "disconnect", "on_disconnect", NodeState.INACTIVE_CONNECTED),
        (UP[:2], "cleanup", "on_disconnect remove on_cleanup", NodeState.INACTIVE_DISCONNECTED),
        (UP, "deactivate", "on_deactivate", NodeState.ACTIVE),
        (UP, "shutdown", "on_shutdown remove unprepare", NodeState.FINALIZED),
    ],
)
def test_a_failure_undoes_its_own_step_and_no_other(
    controller: Controller,
    node: FakeNode,
    path: tuple[TransitionRequest, ...],
    asked: str,
    did: str,
    state: NodeState,
) -> None:
    bring(controller, node, *path)
    node.callbacks[f"on_{asked}"] = lambda: CallbackOutcome.FAILURE
    result = run(controller.change(TransitionRequest(asked)))
    assert result == Result(
        outcome=CallbackOutcome.FAILURE, error=f"/camera: on_{asked} returned FAILURE"
    )
    assert node.did == did.split()
    assert controller.machine.state is state


@pytest.mark.parametrize(
    "answer", [CallbackOutcome.SUCCESS, CallbackOutcome.FAILURE, CallbackOutcome.ERROR]
)
@pytest.mark.parametrize(("path", "request_"), [((), UP[0]), (UP[:1], UP[1]), (UP[:2], UP[2])])
def test_an_error_runs_on_error_and_takes_everything_down(
    controller: Controller,
    node: FakeNode,
    path: tuple[TransitionRequest, ...],
    request_: TransitionRequest,
    answer: CallbackOutcome,
) -> None:
    bring(controller, node, *path)
    node.callbacks[f"on_{request_.value}"] = lambda: CallbackOutcome.ERROR
    node.callbacks["on_error"] = lambda: answer
    result = run(controller.change(request_))
    assert result.error == f"/camera: on_{request_.value} returned ERROR"
    assert node.did[-3:] == ["on_error", "remove", "unprepare"]
    ends = NodeState.UNCONFIGURED if answer is CallbackOutcome.SUCCESS else NodeState.FINALIZED
    assert controller.machine.state is ends


def test_a_bug_of_ours_is_an_error_and_not_a_stuck_node(
    controller: Controller, node: FakeNode
) -> None:
    node.fail["prepare"] = ZeroDivisionError("ours")
    result = run(controller.change(TransitionRequest.CONFIGURE))
    assert result.outcome is CallbackOutcome.ERROR
    assert result.error == "cannot finish configuring of /camera: ZeroDivisionError('ours')"
    assert controller.machine.state is NodeState.UNCONFIGURED


class Turns:
    """Awaits until told."""

    done = False

    def __await__(self) -> Generator[None, None, None]:
        while not self.done:
            yield


def test_shutting_down_cancels_what_runs_first(controller: Controller, node: FakeNode) -> None:
    async def on_configure() -> None:
        await Turns()

    node.callbacks["on_configure"] = on_configure
    running = controller.change(TransitionRequest.CONFIGURE)
    running.send(None)
    ending = controller.shut_down("the supervisor has gone")
    ending.send(None)
    cancelled = run(running)
    assert cancelled.error == ("cannot go on with /camera: on_configure: the supervisor has gone")
    assert run(ending).outcome is CallbackOutcome.SUCCESS
    assert controller.machine.state is NodeState.FINALIZED


def test_shutting_down_a_finalized_node_is_done_already(
    controller: Controller, node: FakeNode
) -> None:
    bring(controller, node, TransitionRequest.SHUTDOWN)
    assert run(controller.shut_down("again")).outcome is CallbackOutcome.SUCCESS
    assert node.did == []
