"""Action goals of a node: from acceptance through the handler to the result, abort or cancel.

rcl of ROS 2 Jazzy remaps an action's hidden topics and services one by one and never the action, so
that its name is what is left of theirs. `manifest.names.resolve` is the same without ROS.
"""

from __future__ import annotations

import traceback
from typing import TYPE_CHECKING, Any

from rclpy.node import Node

from lifecycle.errors import LifecycleError
from lifecycle.manifest.names import action_of, hidden_names
from lifecycle.node.callbacks import Running, called, error_text

if TYPE_CHECKING:
    from rclpy.action.server import ServerGoalHandle

    from lifecycle.middleware.services.actions import GoalServer
    from lifecycle.node.endpoint import Endpoint
    from lifecycle.node.managed import Managed


class GoalInterruptedError(LifecycleError):
    """Raised in the handler of an action where it awaits: its goal cannot be worked on any longer.

    A handler may catch it to leave things as they should be, and may still set its goal's final
    state and return a result; it must not await anything any more.
    """


class Goals:
    """The goals of one action server, of which `fault` is what its handler raised last."""

    def __init__(self, managed: Managed, endpoint: Endpoint) -> None:
        assert endpoint.handler is not None
        self._node = managed.full_name
        self._endpoint = endpoint
        self._what = f"action server {endpoint.name!r} of {self._node}"
        self._log = managed.log
        self._handler = endpoint.handler
        self._accept = getattr(endpoint.handler, "accept", None)
        self._gate = managed.gate
        self._changed = managed.configuration_changes.touch
        self._runs: dict[bytes, Running] = {}
        self.server: GoalServer | None = None  # set by its maker, before it can have a goal

    def end(self) -> None:
        """Take every goal from its handler, and answer those that wait for its result.

        A handler that causes this by what it does itself is left alone: it can still return.
        """
        reason = f"{self._node} is no longer active"
        if self._gate.is_open:
            reason = "it was taken off where it was mapped"
        if self.server is None:
            return
        for goal in self.server.goals:
            key = bytes(goal.goal_id.uuid)
            run = self._runs.get(key)
            if run is None:
                self.server.finish(goal, None)  # accepted, and not begun
                continue
            error = GoalInterruptedError(f"cannot go on with a goal of {self._what}: {reason}")
            if not run.interrupt(error):
                continue
            result = None
            if run.done:
                del self._runs[key]
                result = self._outcome(goal, run)
            self.server.finish(goal, result)

    async def accept(self, goal: Any) -> bool:
        """Decide on a goal: never unless active, and as the author's method says."""
        if self._gate.is_open and self._accept is not None:
            try:
                answer = await called(self._accept, goal)
            except Exception as error:  # noqa: BLE001 - the author's code: reported, and no
                self._log.error(traceback.format_exc())
                self._log.error(
                    f"cannot decide on a goal of {self._what}, so it is rejected: "
                    f"{error_text(error)}"
                )
                return False
            if not isinstance(answer, bool):
                self._log.error(
                    f"cannot use {answer!r} as a decision on a goal of {self._what}, so "
                    "it is rejected: return True or False"
                )
                return False
            if not answer:
                return False
        if not self._gate.is_open:
            self._log.warning(f"cannot accept a goal of {self._what}: it is not active")
        return self._gate.is_open

    async def execute(self, goal: ServerGoalHandle) -> Any | None:
        """Have the handler work on a goal; returns its result, None for an empty one."""
        if not goal.is_active:
            return None  # interrupted before it began
        key = bytes(goal.goal_id.uuid)
        run = self._runs[key] = Running(called(self._handler, goal))
        try:
            await run
        finally:
            is_open = self._runs.pop(key, None) is not None
        return self._outcome(goal, run) if is_open else None

    def _outcome(self, goal: ServerGoalHandle, run: Running) -> Any | None:
        """Say what is wrong with what a handler did; return the result, None for none."""
        failure = run.failure
        if run.interruption is not None and isinstance(failure, GoalInterruptedError):
            return None
        fault = "" if failure is None else f"its handler raised {error_text(failure)}"
        if fault != self._endpoint.fault:
            self._endpoint.fault = fault
            self._changed()
        if fault:
            self._log.error(run.trace)
            self._log.error(f"cannot go on with a goal of {self._what}: {fault}")
            return None
        returned = run.returned
        if returned is not None and not isinstance(returned, self._endpoint.interface.Result):
            self._log.error(
                f"cannot send {returned!r} as a result of {self._what}: return a "
                f"{self._endpoint.interface.__name__}.Result, or None for an empty one"
            )
            return None
        if goal.is_active and run.interruption is None:
            self._log.error(
                f"cannot tell what a goal of {self._what} came to, so it is aborted: its "
                "handler returned without succeed(), abort() or canceled()"
            )
        return returned


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
