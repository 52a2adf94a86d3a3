"""The goals that an action server's handler works on: from acceptance to the answer, or to its end.

Owns: what a handler's return value or exception makes of its goal, and how a goal that can be
worked on no longer is taken from its handler. Which goals are accepted when is making.py's.
"""

from __future__ import annotations

import dataclasses
import inspect
import traceback
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from lifecycle.node.actions.goal_run import GoalInterruptedError, GoalRun
from lifecycle.node.author.handlers import ActionHandler
from lifecycle.node.lifecycle.execution import hint

if TYPE_CHECKING:
    from rclpy.action.server import ServerGoalHandle

    from lifecycle.middleware.services.action_server import GoalServer


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ActionWords:
    """How messages name an action server.

    Attributes:
        action: as declared.
        node: fully qualified.
        error: the node's logger.
        warn: the node's logger.
    """

    action: str
    node: str
    error: Callable[[str], object]
    warn: Callable[[str], object]

    @property
    def subject(self) -> str:
        """`action server 'dock' of /base`."""
        return f"action server {self.action!r} of {self.node}"


class Goals:
    """The goals of one action server. Closing it ends them all; that is what makes it `Gated`.

    Args:
        handler: the author's methods.
        action_type: the action class.
        words: for messages.
        is_open: the node is active.

    Attributes:
        server: set by who makes it, before it can have a goal.
    """

    def __init__(
        self,
        handler: Callable[..., Any],
        action_type: type[Any],
        words: ActionWords,
        *,
        is_open: Callable[[], bool],
    ) -> None:
        self._handler = handler
        self._accept = handler.accept if isinstance(handler, ActionHandler) else None
        self._is_open = is_open
        self._type = action_type
        self._words = words
        self._runs: dict[bytes, GoalRun] = {}
        self.server: GoalServer | None = None

    def open(self) -> None:
        """Goals come by themselves."""

    def close(self) -> None:
        """End what is left: the node is no longer active."""
        self.interrupt(f"{self._words.node} is no longer active")

    def interrupt(self, reason: str) -> None:
        """Take every goal from its handler, and answer those that wait for its result.

        A handler that causes this by what it does itself is left alone: it can still return.
        """
        if self.server is None:
            return
        for goal in self.server.goals:
            run = self._runs.get(bytes(goal.goal_id.uuid))
            if run is None:
                self.server.finish(goal, None)  # accepted, and not begun
                continue
            error = GoalInterruptedError(
                f"cannot go on with a goal of {self._words.subject}: {reason}"
            )
            if run.interrupt(error):
                self.server.finish(goal, self._outcome(goal, run) if run.done else None)

    async def accept(self, goal: Any) -> bool:
        """Decide on a goal: never unless active, and as the author's method says."""
        if self._is_open() and self._accept is not None:
            try:
                answer = self._accept(goal)
                if inspect.isawaitable(answer):
                    answer = await answer
            except Exception as error:  # noqa: BLE001 - the author's code: reported, and no
                self._words.error(traceback.format_exc())
                self._words.error(
                    f"cannot decide on a goal of {self._words.subject}, so it is rejected: "
                    f"{_told(error)}"
                )
                return False
            if not isinstance(answer, bool):
                self._words.error(
                    f"cannot use {answer!r} as a decision on a goal of {self._words.subject}, so "
                    "it is rejected: return True or False"
                )
                return False
            if not answer:
                return False
        if not self._is_open():
            self._words.warn(f"cannot accept a goal of {self._words.subject}: it is not active")
        return self._is_open()

    async def execute(self, goal: ServerGoalHandle) -> Any | None:
        """Have the handler work on a goal; returns its result, None for an empty one."""
        if not goal.is_active:
            return None  # interrupted before it began
        key = bytes(goal.goal_id.uuid)
        run = self._runs[key] = GoalRun(self._handler, goal)
        try:
            await run
        finally:
            del self._runs[key]
        return None if run.judged else self._outcome(goal, run)

    def _outcome(self, goal: ServerGoalHandle, run: GoalRun) -> Any | None:
        """Say what is wrong with what a handler did, once; return the result, None for none."""
        run.judged = True
        if run.failure is not None:
            if run.interruption is None or not isinstance(run.failure, GoalInterruptedError):
                self._words.error(run.trace)
                self._words.error(
                    f"cannot go on with a goal of {self._words.subject}: its handler raised "
                    f"{_told(run.failure)}"
                )
            return None
        returned = run.returned
        if returned is not None and not isinstance(returned, self._type.Result):
            self._words.error(
                f"cannot send {returned!r} as a result of {self._words.subject}: return a "
                f"{self._type.__name__}.Result, or None for an empty one"
            )
            return None
        if goal.is_active and run.interruption is None:
            self._words.error(
                f"cannot tell what a goal of {self._words.subject} came to, so it is aborted: its "
                "handler returned without succeed(), abort() or canceled()"
            )
        return returned


def _told(error: Exception) -> str:
    todo = hint(error)
    return f"{type(error).__name__}: {error}" + (f"; {todo}" if todo else "")
