"""Run the author's callbacks, sync or async, in rclpy's executor: transitions, `health`, goals.

An `async def` callback that exceeds its deadline gets `DeadlineError` thrown in, so that its
traceback shows what it was waiting for. A sync callback cannot be interrupted in Python: it is
judged when it returns, and a supervisor that lost patience ends the process.

rcl of ROS 2 Jazzy remaps an action's hidden topics and services one by one and never the action, so
that its name is what is left of theirs. `manifest.names.resolve` is the same without ROS.
"""

from __future__ import annotations

import enum
import inspect
import threading
import time
import traceback
from collections.abc import Callable, Coroutine, Generator
from typing import TYPE_CHECKING, Any

import msgspec

from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import Health
from lifecycle.manifest.names import action_of, hidden_names
from lifecycle.verify.observation import HealthReport

if TYPE_CHECKING:
    from rclpy.action.server import ServerGoalHandle
    from rclpy.node import Node

    from lifecycle.middleware.services.actions import GoalServer
    from lifecycle.node.endpoint import Endpoint
    from lifecycle.node.machine import NodeState
    from lifecycle.node.managed import Managed


class CallbackOutcome(enum.Enum):
    """The outcome of a transition callback; values are rcl_lifecycle's transition labels."""

    SUCCESS = "transition_success"
    FAILURE = "transition_failure"
    ERROR = "transition_error"


class DeadlineError(LifecycleError):
    """A transition callback took longer than its deadline."""


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """The result of a step.

    Attributes:
        error: why not SUCCESS, one line for people; empty on SUCCESS.
        trace: the exception's traceback for the log; empty where there was none.
    """

    outcome: CallbackOutcome
    error: str = ""
    trace: str = ""


SUCCESS = Result(outcome=CallbackOutcome.SUCCESS)


class Running:
    """A coroutine of the author's at work in rclpy's executor; it is stopped where it awaits.

    An awaiting task is resumed each time that the executor wakes: whoever interrupts it wakes it.

    Attributes:
        returned: what it returned.
        failure: what it raised, whose traceback is `trace`; None if it did not.
        interruption: why it was stopped; None if it was not.
        awaits: it has awaited something: only there it can be stopped.
        done: it works no longer.
    """

    def __init__(self, coroutine: Coroutine[Any, Any, Any]) -> None:
        self._coroutine = coroutine
        self._lock = threading.Lock()
        self._thread = 0
        self.awaits = False
        self.done = False
        self.returned: Any = None
        self.failure: Exception | None = None
        self.trace = ""
        self.interruption: LifecycleError | None = None

    def __await__(self) -> Generator[Any, None, None]:
        while not self.done:
            with self._lock:
                yielded = self._step()
            if not self.done:
                self.awaits = True
                yield yielded

    def interrupt(self, error: LifecycleError) -> None:
        """Raise an error where it awaits; if it is the one that asks it goes on."""
        if self._thread == threading.get_ident():
            return
        self.interruption = error
        if not self._lock.acquire(blocking=False):
            return  # at work in another thread, it is stopped at its next await
        self._thread = threading.get_ident()
        try:
            self._stop(error)
        finally:
            self._thread = 0
            self._lock.release()

    def _step(self) -> Any:
        """Run it until it awaits; return what it yields."""
        if self.done:
            return None
        self._thread = threading.get_ident()
        try:
            yielded = self._coroutine.send(None)
        except StopIteration as stop:
            self.returned, self.done = stop.value, True
        except Exception as error:  # noqa: BLE001 - the author's code: reported
            self._fail(error)
        else:
            if self.interruption is None:
                return yielded
            self._stop(self.interruption)
        finally:
            self._thread = 0
        return None

    def _stop(self, error: LifecycleError) -> None:
        """Throw into it; whatever it makes of that, it does not run on."""
        if self.done:
            return
        try:
            self._coroutine.throw(error)
            self._coroutine.close()
        except StopIteration as stop:
            self.returned = stop.value
        except Exception as raised:  # noqa: BLE001 - the author's code: reported
            self._fail(raised)
        self.done = True

    def _fail(self, error: Exception) -> None:
        self.failure, self.trace, self.done = error, traceback.format_exc(), True


async def called(callback: Callable[..., Any], *arguments: object) -> Any:
    """Call what is sync or async, and may take fewer arguments than are given."""
    returned = callback(*arguments[: positional_count(callback, len(arguments))])
    return await returned if inspect.isawaitable(returned) else returned


async def result_of(running: Running, *, what: str, deadline_s: float) -> Result:
    """Run a transition callback and return its result; never raises for what the user did.

    Whoever awaits this interrupts it at its deadline, where it awaits.
    """
    began = time.monotonic()
    await running
    took_s = time.monotonic() - began
    failure = running.failure or (running.interruption if running.awaits else None)
    if failure is not None:
        text = str(failure)
        if not isinstance(failure, LifecycleError):
            text = f"{what} raised {error_text(failure)}"
        return Result(outcome=CallbackOutcome.ERROR, error=text, trace=running.trace)
    if took_s >= deadline_s and not running.awaits:
        return Result(
            outcome=CallbackOutcome.ERROR,
            error=f"cannot accept {what}: it blocked for {took_s:.1f} s, its deadline is "
            f"{deadline_s:g} s; make it `async def` so that it can be interrupted",
        )
    return judge(running.returned, what=what)


def error_text(error: Exception) -> str:
    """Return what was raised in one line, and what to do about it."""
    todo = hint(error)
    return f"{type(error).__name__}: {error}" + (f"; {todo}" if todo else "")


def hint(error: Exception) -> str:
    """Return what to do about an exception whose text does not say it, or nothing."""
    if isinstance(error, RuntimeError) and str(error).startswith("no running event loop"):
        return (
            "callbacks run in rclpy's executor, which has no asyncio loop: await what rclpy gives, "
            "as client.call_async(request) does, and wait by self.sleep(seconds)"
        )
    return ""


def judge(returned: object, *, what: str) -> Result:
    """Turn a callback's return value into a Result; another value than those known is an ERROR.

    None means SUCCESS. rclpy's TransitionCallbackReturn is known by its name.
    """
    name = "SUCCESS" if returned is None else str(getattr(returned, "name", ""))
    if name not in CallbackOutcome.__members__:
        return Result(
            outcome=CallbackOutcome.ERROR,
            error=f"cannot use {returned!r}, returned by {what}; return SUCCESS, FAILURE, ERROR, "
            "or None for SUCCESS",
        )
    outcome = CallbackOutcome[name]
    if outcome is CallbackOutcome.SUCCESS:
        return SUCCESS
    return Result(outcome=outcome, error=f"{what} returned {name}")


def positional_count(callback: Callable[..., Any], available: int) -> int:
    """Return how many of `available` positional arguments a callback takes."""
    kinds = [parameter.kind for parameter in inspect.signature(callback).parameters.values()]
    if inspect.Parameter.VAR_POSITIONAL in kinds:
        return available
    positional = {
        inspect.Parameter.POSITIONAL_ONLY,
        inspect.Parameter.POSITIONAL_OR_KEYWORD,
    }
    return min(available, sum(kind in positional for kind in kinds))


_LONGEST = 200
"""Characters of an answer that are passed on."""


class HealthCheck:
    """Asks one node how it is: once connected, at each change of its state, and at an interval.

    Args:
        managed: the node, whose configuration has changed with each other `report`.
        check: returns None, True or "" if all is well, else what is wrong; may be async.

    Attributes:
        report: the last answer; None while the node is not connected.
    """

    def __init__(self, managed: Managed, check: Callable[[], Any]) -> None:
        self._managed = managed
        self._check = check
        self._how = managed.spec.health or Health()
        self._end: Callable[[], None] | None = None
        self._asked_s: float | None = None
        self._round = 0
        self._is_stale = False
        self.report: HealthReport | None = None

    def follow(self, state: NodeState) -> None:
        """Begin to ask, ask again or stop, as the node's new state says."""
        if not state.steady:
            return
        self._asked_s = None  # what it says of the state before counts no more
        self._round += 1
        if not state.connected:
            if self._end is not None:
                self._end()
            self._end = self.report = None
            return
        if self._end is None:
            self._end = self._managed.turns.call_every(self._how.interval_s, self._ask)
        self._is_stale = True
        self._ask()

    def _ask(self) -> None:
        if self._asked_s is not None:
            waited_s = time.monotonic() - self._asked_s
            if waited_s >= self._how.timeout_s:
                late = f"it has not answered within {self._how.timeout_s:g} s"
                self._take(HealthReport(ok=None, message=late))
            return
        try:
            answer = self._check()
        except Exception as error:  # noqa: BLE001 - the user's code: reported
            self._take(self._raised(error))
            return
        if not inspect.isawaitable(answer):
            self._take(_report(answer))
            return
        self._asked_s = time.monotonic()
        if self._is_stale:
            self._take(HealthReport(ok=None, message="it has not answered since its state changed"))
        round_ = self._round

        async def wait() -> None:
            try:
                report = _report(await answer)
            except Exception as error:  # noqa: BLE001 - the user's code: reported
                report = self._raised(error)
            if round_ == self._round:
                self._asked_s = None
                self._take(report)

        self._managed.turns.call_soon(wait)

    def _raised(self, error: Exception) -> HealthReport:
        said = f"it raised {type(error).__name__}: {error}"[:_LONGEST]
        if self.report is None or self.report.message != said:
            self._managed.log.error("".join(traceback.format_exception(error)))
        return HealthReport(ok=False, message=said)

    def _take(self, report: HealthReport) -> None:
        is_stale, self._is_stale = self._is_stale, False
        if is_stale or report != self.report:
            self.report = report
            self._managed.configuration_changes.touch()


def _report(answer: object) -> HealthReport:
    if answer is None or answer is True or answer == "":
        return HealthReport(ok=True)
    said = "it is not" if answer is False else str(answer)
    return HealthReport(ok=False, message=said[:_LONGEST])


class Goals:
    """The goals of one action server: taken while its node is active, aborted when it is not."""

    def __init__(self, managed: Managed, endpoint: Endpoint) -> None:
        self._managed = managed
        self._log = managed.log
        self._endpoint = endpoint
        self._what = f"a goal of action server {endpoint.name!r} of {managed.full_name}"
        self._working: set[bytes] = set()
        self.server: GoalServer | None = None  # set by its maker, before it can have a goal

    def open(self) -> None:
        """Goals are accepted from now on."""

    def close(self) -> None:
        """Abort every goal, and answer those that wait for its result."""
        self._working.clear()
        if self.server is not None:
            self.server.finish_all()

    async def accept(self, goal: Any) -> bool:
        """Decide on a goal: never unless active, and as the author's method says."""
        gate = self._managed.gate
        decide = getattr(self._endpoint.handler, "accept", None)
        if gate.is_open and decide is not None:
            try:
                if not await called(decide, goal):
                    return False
            except Exception as error:  # noqa: BLE001 - the author's code: reported, and no
                self._log.error(traceback.format_exc())
                self._log.error(f"cannot accept {self._what}: {error_text(error)}")
                return False
        if not gate.is_open:
            self._log.warning(f"cannot accept {self._what}: it is not active")
        return gate.is_open

    async def execute(self, goal: ServerGoalHandle) -> Any | None:
        """Have the handler work on a goal; returns its result, None for an empty one."""
        handler = self._endpoint.handler
        assert handler is not None
        if not goal.is_active:
            return None  # aborted before it began
        key = bytes(goal.goal_id.uuid)
        self._working.add(key)
        result, failure = None, None
        try:
            result = await called(handler, goal)
            if not isinstance(result, (self._endpoint.interface.Result, type(None))):
                raise TypeError(f"cannot send {result!r} as a result")  # noqa: TRY301
        except Exception as error:  # noqa: BLE001 - the author's code: reported
            result, failure = None, error
            trace = traceback.format_exc()
        if key not in self._working:
            return None  # aborted meanwhile: whatever became of its handler
        self._working.discard(key)
        if fault := self._managed.note_fault(self._endpoint, failure):
            self._log.error(trace)
            self._log.error(f"cannot go on with {self._what}: {fault}")
        elif goal.is_active:
            self._log.error(
                f"cannot tell what {self._what} came to, so it is aborted: its handler returned "
                "without succeed(), abort() or canceled()"
            )
        return result


def resolve_action_name(node: Node, name: str) -> str:
    """Return the fully qualified name of an action of `node`, after its remapping rules.

    Raises:
        NameNotLegalError: the rules give its hidden names different actions.
    """
    resolved = {}
    for hidden, kind in hidden_names(name):
        resolve = node.resolve_topic_name if kind.is_topic else node.resolve_service_name
        resolved[hidden] = str(resolve(hidden))
    return action_of(name, resolved)
