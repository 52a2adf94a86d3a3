"""An action server on rclpy's whose goals can be ended from outside.

Owns: the private names of `rclpy.action.server` that this takes. Import it late: rclpy.action
imports numpy, 100 ms.
"""

from __future__ import annotations

import typing
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import RCLError, ServerGoalHandle

from lifecycle.middleware.versions import private

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup
    from rclpy.node import Node


@typing.final
class GoalServer(ActionServer):  # type: ignore[misc]  # rclpy is not typed
    """An action server that can answer for the goals it works on.

    Args:
        node: whose participant it is on.
        action_type: action class.
        name: as given to rcl, which expands and remaps it.
        execute: works on a goal and returns its result, or None for an empty one; must not raise. A
            goal that it did not bring to an end is aborted.
        accept: decides on a goal.
        group: callback group of its requests.
    """

    def __init__(
        self,
        node: Node,
        action_type: type[Any],
        name: str,
        execute: Callable[[ServerGoalHandle], Awaitable[Any]],
        *,
        accept: Callable[[Any], Awaitable[bool]],
        group: CallbackGroup,
    ) -> None:
        self._accept = accept
        self._accepted: tuple[ServerGoalHandle, ...] = ()
        private(super(), "_execute_goal", f"make action server {name!r}")
        super().__init__(
            node,
            action_type,
            name,
            execute,
            callback_group=group,
            goal_callback=self._respond,
            handle_accepted_callback=self._begin,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    def finish_all(self) -> None:
        """Abort every goal that has not ended, and answer all who wait for one."""
        for goal in self._accepted:
            self._finish(goal, None)
        self._accepted = ()

    def _finish(self, goal: ServerGoalHandle, result: Any | None) -> None:
        """Answer all who wait for a goal, aborted if it has not ended; the first answer counts."""
        futures = private(self, "_result_futures", "answer who waits for a goal")
        future = futures.get(bytes(goal.goal_id.uuid))
        if future is None or future.done():  # None: rcl has forgotten a goal that ended long ago
            return
        if goal.is_active:
            try:
                goal.abort()
            except RCLError:
                if goal.is_active:
                    raise
                # its handler, in another thread, has just brought it to an end itself
        response = self.action_type.Impl.GetResultService.Response()
        response.status = goal.status
        response.result = self.action_type.Result() if result is None else result
        # By the executor's next turn the server may be gone; without one, it is sent here.
        private(future, "_set_executor", "answer who waits for a goal")(None)
        future.set_result(response)

    async def _respond(self, goal: Any) -> GoalResponse:
        return GoalResponse.ACCEPT if await self._accept(goal) else GoalResponse.REJECT

    def _begin(self, goal: ServerGoalHandle) -> None:
        self._accepted = (*(each for each in self._accepted if each.is_active), goal)
        goal.execute()

    async def _execute_goal(self, execute_callback: Any, goal_handle: ServerGoalHandle) -> None:
        result = await execute_callback(goal_handle)
        self._finish(goal_handle, result)
