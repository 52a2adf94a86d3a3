"""Action servers on real DDS: goals accepted, executed, cancelled and ended with the activity."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest
from asking import Asking
from counting import ABORTED, CANCELED, SUCCEEDED, Counting, server, step
from lifecycle_driver import Driver
from planning import publisher
from test_msgs.action import Fibonacci

from lifecycle import LifecycleNode, codec, on_action, on_goal
from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import EndpointPolicy
from lifecycle.verify.observation import NodeConfiguration

Active = Callable[..., Any]
Ask = Callable[..., Asking]


def said(capfd: pytest.CaptureFixture[str]) -> list[str]:
    """Return what nodes logged as errors and warnings, tracebacks shortened to their last line."""
    lines = re.split(
        r"^\[(?:ERROR|WARN)\] \[[\d.]+\] \[it\]: ", capfd.readouterr().err, flags=re.MULTILINE
    )
    return [line.rstrip().rpartition("\n")[2] for line in lines[1:]]


@pytest.fixture
def counting(driver: Driver, active: Active, ask: Ask) -> tuple[Counting, Asking]:
    """An active counter, and a client of it."""
    node = active(Counting, server(), publisher("stop"))
    node.said = []
    return node, ask("/count", node)


def test_a_goal_has_feedback_and_a_result(
    driver: Driver, counting: tuple[Counting, Asking]
) -> None:
    node, asking = counting
    goal = asking.goal(order=3)
    assert goal.accepted
    for count in (1, 2, 3):
        step(driver, node)
        driver.spin_until(lambda count=count: len(asking.feedback) == count)
    assert asking.result(goal) == (SUCCEEDED, [0, 1, 2])
    assert asking.feedback == [[0], [0, 1], [0, 1, 2]]


def test_a_goal_that_is_cancelled_says_how_far_it_came(
    driver: Driver, counting: tuple[Counting, Asking]
) -> None:
    node, asking = counting
    goal = asking.goal(order=9)
    step(driver, node)
    driver.spin_until(lambda: asking.feedback == [[0]])
    assert asking.cancel(goal) == 1
    step(driver, node)
    assert asking.result(goal) == (CANCELED, [0, 1])


def test_goals_are_accepted_only_while_active(
    driver: Driver, active: Active, ask: Ask, capfd: pytest.CaptureFixture[str]
) -> None:
    node = active(Counting, server(), publisher("stop"), to="connect")
    asking = ask("/count", node)
    assert not asking.goal().accepted
    assert said(capfd) == ["cannot accept a goal of action server 'count' of /it: it is not active"]
    assert driver.set("/it", "activate")
    goal = asking.goal()
    assert goal.accepted
    step(driver, node)
    assert asking.result(goal) == (SUCCEEDED, [0])
    assert driver.set("/it", "deactivate")
    assert not asking.goal().accepted


class Order(Counting):
    """Notes what comes first."""

    def on_deactivate(self, state: object) -> None:
        self.said.append("on_deactivate")


@pytest.mark.parametrize("transition", ["deactivate", "shutdown"])
def test_goals_are_aborted_and_answered_with_the_activity_and_others_taken_with_the_next(
    driver: Driver, active: Active, ask: Ask, transition: str
) -> None:
    node = active(Order, server(), publisher("stop"))
    node.said = []
    asking = ask("/count", node)
    goals = [asking.goal(order=2), asking.goal(order=3)]
    results = [goal.get_result_async() for goal in goals]
    driver.settle()
    assert driver.set("/it", transition)
    for result in results:
        driver.spin_until(result.done)
    assert [result.result().status for result in results] == [ABORTED, ABORTED]
    step(driver, node)
    driver.spin_until(lambda: node.said[-1:] == ["not active"])
    if transition == "deactivate":
        assert node.said == ["on_deactivate", "not active"]
        assert driver.set("/it", "activate")
        goal = asking.goal()
        step(driver, node)
        assert asking.result(goal) == (SUCCEEDED, [0])


class Odd(LifecycleNode):
    """Does what the order of a goal says."""

    @on_action("count")
    def count(self, goal: Any) -> Any:
        if goal.request.order == 0:
            raise OSError("no such number")
        if goal.request.order == 1:
            return Fibonacci.Result(sequence=[1])
        goal.succeed()
        return "two" if goal.request.order == 2 else None


@pytest.mark.parametrize(
    ("order", "status", "expected"),
    [
        (
            0,
            ABORTED,
            (
                "cannot go on with a goal of action server 'count' of /it: its handler raised "
                "OSError: no such number"
            ),
        ),
        (
            1,
            ABORTED,
            (
                "cannot tell what a goal of action server 'count' of /it came to, so it is "
                "aborted: its handler returned without succeed(), abort() or canceled()"
            ),
        ),
        (
            2,
            SUCCEEDED,
            (
                "cannot go on with a goal of action server 'count' of /it: its handler raised "
                "TypeError: cannot send 'two' as a result"
            ),
        ),
        (3, SUCCEEDED, ""),
    ],
)
def test_what_a_sync_handler_does_wrong_is_said_and_ends_its_goal_alone(
    driver: Driver,
    active: Active,
    ask: Ask,
    capfd: pytest.CaptureFixture[str],
    order: int,
    status: int,
    expected: str,
) -> None:
    node = active(Odd, server())
    asking = ask("/count", node)
    sequence = [1] if order == 1 else []
    assert asking.result(asking.goal(order)) == (status, sequence)
    _, raised, fault = expected.partition("its handler raised ")
    assert said(capfd) == [*([fault] if raised else []), *([expected] if expected else [])]
    fault = raised + fault
    assert fault_of(driver) == fault
    assert asking.result(asking.goal(3)) == (SUCCEEDED, [])
    assert fault_of(driver) == ""


def fault_of(driver: Driver) -> str:
    """Return what /it reports of its action server's handler."""
    (report,) = codec.from_json(driver.configuration("/it"), NodeConfiguration).endpoints
    return report.fault


class Choosy(Counting):
    """Decides on goals."""

    @on_goal("count")
    async def may_count(self, goal: Fibonacci.Goal) -> Any:
        if goal.order > 8:
            raise ValueError("too many")
        return goal.order < 6


def test_a_node_decides_on_goals(
    driver: Driver, active: Active, ask: Ask, capfd: pytest.CaptureFixture[str]
) -> None:
    node = active(Choosy, server(), publisher("stop"))
    asking = ask("/count", node)
    assert [asking.goal(order).accepted for order in (9, 6)] == [False, False]
    assert said(capfd) == [
        "ValueError: too many",
        ("cannot accept a goal of action server 'count' of /it: ValueError: too many"),
    ]
    goal = asking.goal(1)
    step(driver, node)
    assert asking.result(goal) == (SUCCEEDED, [0])


def test_an_action_declared_later_takes_its_handlers_with_it(
    driver: Driver, active: Active, ask: Ask
) -> None:
    class Open(LifecycleNode):
        """Declares an action while it is active."""

    node = active(Open, endpoint_policy=EndpointPolicy.OPEN)

    def count(goal: Any) -> None:
        goal.succeed()

    node.declare_action("later", Fibonacci, callback=count, accept=lambda goal: goal.order < 3)
    asking = ask("/later", node)
    assert [asking.goal(order).accepted for order in (2, 3)] == [True, False]
    with pytest.raises(LifecycleError) as error:
        node.declare_action("never", Fibonacci, accept=lambda goal: True)
    assert str(error.value) == (
        "cannot decide on goals of action server 'never' by accept= alone; give callback= too, or "
        "decorate a method with @on_goal('never')"
    )


def test_a_handler_may_sleep_while_its_node_goes_on(
    driver: Driver, active: Active, ask: Ask
) -> None:
    class Sleeping(LifecycleNode):
        @on_action("count")
        async def count(self, goal: Any) -> None:
            while not goal.is_cancel_requested:
                await self.sleep(0.01)
            goal.canceled()

    node = active(Sleeping, server())
    asking = ask("/count", node)
    goal = asking.goal()
    assert asking.cancel(goal) == 1
    assert asking.result(goal) == (CANCELED, [])


def test_a_missing_handler_and_one_too_many_are_told_at_configure(
    driver: Driver, active: Active
) -> None:
    node = active(Choosy, server("cuont"), publisher("stop"), to="")
    assert driver.run(node.lifecycle.change, "configure").error.splitlines() == [
        (
            "cannot use handler Choosy.may_count: @on_goal('count') names no action server that "
            "/it declares; did you mean 'cuont'? declared: 'cuont'"
        ),
        (
            "cannot use handler Choosy.count: @on_action('count') names no action server that /it "
            "declares; did you mean 'cuont'? declared: 'cuont'"
        ),
        (
            "cannot serve action server 'cuont' of /it: no method of Choosy is decorated with "
            "@on_action('cuont')"
        ),
    ]
    assert driver.state("/it") == (1, "unconfigured")
