"""rclpy's action client, whose waiting callers learn that it is gone and that they must not block.

Owns: the private names of `rclpy.action.client` that this takes. Import it late: rclpy.action
imports numpy, 100 ms.
"""

from __future__ import annotations

import typing
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rclpy.action import ActionClient
from rclpy.task import Future

from lifecycle.errors import MiddlewareError

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup
    from rclpy.node import Node

_LOOK_S = 0.05
"""How often a goal that is held looks for its server; rclpy's wait_for_server looks four times a
second, and tells of nothing by itself."""


class ActionClientGoneError(MiddlewareError):
    """An answer that was awaited will not come: the action client it was asked with is gone."""


@typing.final
class GoalClient(ActionClient):  # type: ignore[misc]  # rclpy is not typed
    """An action client that leaves nobody waiting for ever.

    Args:
        node: whose participant it is on.
        action_type: action class.
        name: as given to rcl, which expands it and applies the node's remapping rules.
        group: callback group of its answers.
        refuse_to_block: called with what blocks and what does not, before something blocks; raises
            where that would wait for ever.
        after: calls back once, in so many seconds, in the executor; returns what calls that off.

    Attributes:
        action_name: fully qualified, set by who made it; empty while unknown.
    """

    def __init__(
        self,
        node: Node,
        action_type: type[Any],
        name: str,
        *,
        group: CallbackGroup,
        refuse_to_block: Callable[[str, str], None],
        after: Callable[[float, Callable[[], None]], Callable[[], None]],
    ) -> None:
        self._refuse_to_block = refuse_to_block
        self._after = after
        self._held: list[Future] = []
        self._destroyed = False
        self.action_name = ""
        super().__init__(node, action_type, name, callback_group=group)

    def send_goal(self, goal: Any, **options: Any) -> Any:
        """As rclpy's, outside of callbacks: it waits for the result."""
        self._refuse_to_block(f"a result of action {self._action_name!r}", "send_goal_async(goal)")
        return super().send_goal(goal, **options)

    def send_goal_async(self, goal: Any, *arguments: Any, **options: Any) -> Future:
        """As rclpy's; a goal is held until a server is matched, before which DDS would lose it."""
        if self.server_is_ready() or not isinstance(goal, self._action_type.Goal):
            return super().send_goal_async(goal, *arguments, **options)
        promised: Future = Future()
        self._held.append(promised)

        def tell(sent: Future) -> None:
            error = sent.exception()
            if error is not None:
                promised.set_exception(error)
            else:
                promised.set_result(sent.result())

        def send() -> None:
            if self._destroyed:
                return
            if not self.server_is_ready():
                self._after(_LOOK_S, send)
                return
            self._held.remove(promised)
            sent = super(GoalClient, self).send_goal_async(goal, *arguments, **options)
            sent.add_done_callback(tell)

        self._after(_LOOK_S, send)
        return promised

    def destroy(self) -> None:
        """As rclpy's; whoever awaits an answer gets an ActionClientGoneError. Again is harmless."""
        if self._destroyed:
            return
        self._destroyed = True
        for pending, what in (
            (self._held, "whether a goal is accepted"),
            (self._pending_goal_requests.values(), "whether a goal is accepted"),
            (self._pending_cancel_requests.values(), "whether a goal is cancelled"),
            (self._pending_result_requests.values(), "the result of a goal"),
        ):
            for future in tuple(pending):
                future.set_exception(
                    ActionClientGoneError(
                        f"cannot learn {what} of action {self._action_name!r}: the action client "
                        "was disconnected"
                    )
                )
        super().destroy()

    def _cancel_goal(self, goal_handle: Any) -> Any:
        self._refuse_to_block(
            f"action {self._action_name!r} to cancel a goal", "goal_handle.cancel_goal_async()"
        )
        return super()._cancel_goal(goal_handle)

    def _get_result(self, goal_handle: Any) -> Any:
        self._refuse_to_block(
            f"a result of action {self._action_name!r}", "goal_handle.get_result_async()"
        )
        return super()._get_result(goal_handle)
