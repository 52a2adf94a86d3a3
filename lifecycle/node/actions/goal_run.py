"""One handler at work on one goal of an action, and how it is stopped.

Owns: driving the handler by hand, so that it can be stopped where it awaits. What becomes of its
goal is goals.py's to say.
"""

from __future__ import annotations

import inspect
import threading
import traceback
from collections.abc import Callable, Coroutine, Generator
from typing import TYPE_CHECKING, Any

from lifecycle.errors import LifecycleError

if TYPE_CHECKING:
    from rclpy.action.server import ServerGoalHandle


class GoalInterruptedError(LifecycleError):
    """Raised in the handler of an action where it awaits: its goal cannot be worked on any longer.

    A handler may catch it to leave things as they should be, and may still say what its goal came
    to and return a result; it must not await anything any more.
    """


class GoalRun:
    """One handler at work on one goal.

    Attributes:
        returned: what the handler returned.
        failure: what it raised; None if it did not.
        trace: of the failure.
        interruption: why it was stopped; None if it was not.
        done: the handler works no longer.
        judged: what it did has been looked at.
    """

    def __init__(self, handler: Callable[..., Any], goal: ServerGoalHandle) -> None:
        self._handler = handler
        self._goal = goal
        self._coroutine: Coroutine[Any, Any, Any] | None = None
        self._lock = threading.Lock()
        self._thread = 0
        self.done = False
        self.judged = False
        self.returned: Any | None = None
        self.failure: Exception | None = None
        self.trace = ""
        self.interruption: GoalInterruptedError | None = None

    def __await__(self) -> Generator[Any, None, None]:
        while not self.done:
            with self._lock:
                yielded = self._step()
            if not self.done:
                yield yielded

    def interrupt(self, error: GoalInterruptedError) -> bool:
        """Stop the handler; false if it is the one that asks, which it then outlives."""
        if self._thread == threading.get_ident():
            return False
        self.interruption = error
        if not self._lock.acquire(blocking=False):
            return True  # at work in another thread, it is stopped at its next await
        self._thread = threading.get_ident()
        try:
            self._stop(error)
        finally:
            self._thread = 0
            self._lock.release()
        return True

    def _step(self) -> Any:
        """Run the handler until it awaits; return what it yields."""
        if self.done:
            return None
        self._thread = threading.get_ident()
        try:
            if self._coroutine is None:
                self._coroutine = self._begin()
            yielded = self._coroutine.send(None)
        except StopIteration as stop:
            self.returned, self.done = stop.value, True
        except Exception as error:  # noqa: BLE001 - the author's code: reported, then aborted
            self._fail(error)
        else:
            if self.interruption is None:
                return yielded
            self._stop(self.interruption)
        finally:
            self._thread = 0
        return None

    async def _begin(self) -> Any:
        """Call the handler, sync or async."""
        returned = self._handler(self._goal)
        return await returned if inspect.isawaitable(returned) else returned

    def _stop(self, error: GoalInterruptedError) -> None:
        """Throw into the handler where it awaits; whatever it makes of that, it does not run on."""
        if self.done or self._coroutine is None:
            return
        try:
            self._coroutine.throw(error)
            self._coroutine.close()
        except StopIteration as stop:
            self.returned = stop.value
        except Exception as raised:  # noqa: BLE001 - likewise
            self._fail(raised)
        self.done = True

    def _fail(self, error: Exception) -> None:
        self.failure, self.trace, self.done = error, traceback.format_exc(), True
