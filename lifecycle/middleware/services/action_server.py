"""rclpy's action server, whose goals can be ended from outside and whose answers are sent at once.

Owns: the private names of `rclpy.action.server` that this takes. What works on a goal, and when one
has to end, is `lifecycle.node`'s. Import it late: rclpy.action imports numpy, 100 ms.
"""

from __future__ import annotations

import typing
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import RCLError, ServerGoalHandle
from rclpy.exceptions import InvalidHandle

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup
    from rclpy.node import Node


@typing.final
class GoalServer(ActionServer):  # type: ignore[misc]  # rclpy is not typed
    """An action server that tells what it works on and can be made to stop.

    Args:
        node: whose participant it is on.
        action_type: action class.
        name: as given to rcl, which expands it and applies the node's remapping rules.
        execute: works on a goal and returns its result, or None for an empty one; must not raise.
            It should have brought the goal to an end: one that it did not is aborted.
        accept: decides on a goal.
        group: callback group of its requests.

    Attributes:
        action_name: fully qualified, set by who made it; empty while unknown.
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
        self._destroyed = False
        self.action_name = ""
        super().__init__(
            node,
            action_type,
            name,
            execute,
            callback_group=group,
            goal_callback=self._respond,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    @property
    def goals(self) -> tuple[ServerGoalHandle, ...]:
        """The goals that were accepted and have not come to an end."""
        return tuple(each for each in self._goal_handles.values() if each.is_active)

    def finish(self, goal: ServerGoalHandle, result: Any | None) -> None:
        """Answer everybody who waits for a goal, now; the first answer counts.

        Args:
            goal: aborted, if it has not come to an end.
            result: of the action's result class; None for an empty one.
        """
        future = self._result_futures.get(bytes(goal.goal_id.uuid))
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
        future._set_executor(None)  # noqa: SLF001
        future.set_result(response)

    async def execute(self, taken_data: Any) -> None:
        """As rclpy's; what is decided on when the server is destroyed stays unanswered."""
        try:
            await super().execute(taken_data)
        except InvalidHandle:
            self._logger.warning(
                f"cannot answer a request to action server {self.action_name!r}: it was "
                "disconnected meanwhile"
            )

    def destroy(self) -> None:
        """As rclpy's; again is harmless. Its goals should have been finished."""
        if not self._destroyed:
            self._destroyed = True
            super().destroy()

    async def _respond(self, goal: Any) -> GoalResponse:
        return GoalResponse.ACCEPT if await self._accept(goal) else GoalResponse.REJECT

    async def _execute_goal(self, execute_callback: Any, goal_handle: ServerGoalHandle) -> None:
        result = await execute_callback(goal_handle)
        self.finish(goal_handle, result)

    def _send_result_response(self, request_header: Any, future: Any) -> None:
        try:
            super()._send_result_response(request_header, future)
        except InvalidHandle:
            self._logger.warning(
                f"cannot send a result of action server {self.action_name!r}: it was disconnected "
                "before its goal had ended"
            )
