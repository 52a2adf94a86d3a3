"""Run one user callback with a deadline, sync or async, inside rclpy's executor.

Owns: how a callback's return value or exception becomes an Outcome, and what a deadline does.
An `async def` callback that exceeds its deadline gets `DeadlineError` thrown in where it awaits,
so that its traceback shows what it was waiting for. A sync callback cannot be interrupted in
Python: it is judged when it returns, and a supervisor that lost patience ends the process.
"""

from __future__ import annotations

import contextlib
import enum
import inspect
import time
import traceback
from collections.abc import Callable, Coroutine, Generator
from typing import Any

import msgspec

from lifecycle.errors import LifecycleError


class CallbackOutcome(enum.Enum):
    """The outcome of a transition callback; values are rcl_lifecycle's transition labels."""

    SUCCESS = "transition_success"
    FAILURE = "transition_failure"
    ERROR = "transition_error"


class DeadlineError(LifecycleError):
    """A transition callback took longer than its deadline."""


class CancelledError(LifecycleError):
    """A running transition was cancelled because its process must end."""


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

_RCLPY_TYPE = "TransitionCallbackReturnType"


class Interruptible:
    """Awaits a coroutine inside rclpy's executor and can be made to stop.

    rclpy has no running asyncio loop: an awaiting task is resumed each time its executor wakes.
    This steps the inner coroutine itself and looks at its deadline on every resumption, so
    something must wake the executor at the deadline (the node keeps a timer for that).
    """

    def __init__(
        self, coroutine: Coroutine[Any, Any, Any], *, deadline_s: float, what: str
    ) -> None:
        self._coroutine = coroutine
        self._ends = time.monotonic() + deadline_s
        self._deadline_s = deadline_s
        self._what = what
        self._interruption: LifecycleError | None = None

    def cancel(self, reason: str) -> None:
        """Make the coroutine fail with CancelledError at its next resumption."""
        self._interruption = CancelledError(f"cannot go on with {self._what}: {reason}")

    def __await__(self) -> Generator[Any, None, Any]:
        try:
            while True:
                try:
                    yielded = self._coroutine.send(None)
                except StopIteration as stop:
                    return stop.value
                yield yielded
                if self._interruption is None and time.monotonic() >= self._ends:
                    self._interruption = DeadlineError(
                        f"cannot finish {self._what} within its deadline of {self._deadline_s:g} s"
                    )
                if self._interruption is not None:
                    self._stop(self._interruption)
        finally:
            self._coroutine.close()

    def _stop(self, interruption: LifecycleError) -> None:
        """Throw into the coroutine; whatever it makes of that, it does not run on."""
        with contextlib.suppress(StopIteration):  # it returned instead of passing it on
            self._coroutine.throw(interruption)
        raise interruption


async def call(
    callback: Callable[..., Any],
    arguments: tuple[object, ...],
    *,
    what: str,
    deadline_s: float,
    started: Callable[[Interruptible], None],
) -> Result:
    """Run a transition callback and return its result; never raises for what the user did.

    Args:
        callback: sync or async; may take fewer arguments than given (`on_configure(self)`).
        arguments: what the callback may take.
        what: for messages, "/camera: on_configure".
        deadline_s: seconds, > 0.
        started: called with the Interruptible before an async callback first runs.
    """
    began = time.monotonic()
    try:
        returned = callback(*arguments[: positional_count(callback, len(arguments))])
        if inspect.isawaitable(returned):
            coroutine = returned if inspect.iscoroutine(returned) else _await(returned)
            running = Interruptible(coroutine, deadline_s=deadline_s, what=what)
            started(running)
            returned = await running
        elif time.monotonic() - began >= deadline_s:
            took_s = time.monotonic() - began
            return Result(
                outcome=CallbackOutcome.ERROR,
                error=f"cannot accept {what}: it blocked for {took_s:.1f} s, its deadline is "
                f"{deadline_s:g} s; make it `async def` so that it can be interrupted",
            )
    except LifecycleError as error:
        return Result(outcome=CallbackOutcome.ERROR, error=str(error), trace=traceback.format_exc())
    except Exception as error:  # noqa: BLE001 - the user's code: reported, then ERROR
        line = f"{type(error).__name__}: {error}" + (f"; {todo}" if (todo := hint(error)) else "")
        return Result(
            outcome=CallbackOutcome.ERROR,
            error=f"{what} raised {line}",
            trace=traceback.format_exc(),
        )
    return judge(returned, what=what)


def hint(error: Exception) -> str:
    """Return what to do about an exception whose text does not say it; empty if there is nothing.

    asyncio says `no running event loop` of whatever is awaited of it, `asyncio.sleep` first of all.
    """
    if isinstance(error, RuntimeError) and str(error).startswith("no running event loop"):
        return (
            "callbacks run in rclpy's executor, which has no asyncio loop: await what rclpy gives, "
            "as client.call_async(request) does, and wait by self.sleep(seconds)"
        )
    return ""


def judge(returned: object, *, what: str) -> Result:
    """Turn a callback's return value into a Result.

    None means SUCCESS. rclpy's TransitionCallbackReturn is known by its name, so that this needs no
    rclpy. Anything else is an ERROR, also where rclpy would break.
    """
    name = "SUCCESS" if returned is None else getattr(returned, "name", "")
    known = (
        returned is None
        or isinstance(returned, CallbackOutcome)
        or type(returned).__name__ == _RCLPY_TYPE
    )
    if not known or name not in CallbackOutcome.__members__:
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


async def _await(awaitable: Any) -> Any:
    return await awaitable
