"""Action client and server on rclpy's that never wait for ever: goals can be ended from outside.

Owns: the private names of `rclpy.action.server` that this takes. Callers that wait for a client's
answer learn that it is gone, and that they must not block; a server's answers are sent at once.
Import it late: rclpy.action imports numpy, 100 ms.
"""

from __future__ import annotations

import functools
import threading
import typing
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import RCLError, ServerGoalHandle
from rclpy.exceptions import InvalidHandle
from rclpy.task import Future

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.versions import private

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup
    from rclpy.node import Node


class ActionClientGoneError(MiddlewareError):
    """An awaited answer will not arrive: the action client it was asked with is gone."""


@typing.final
class GoalClient(ActionClient):  # type: ignore[misc]  # rclpy is not typed
    """An action client whose callers never wait for ever.

    Args:
        node: whose participant it is on.
        action_type: action class.
        name: as given to rcl, which expands and remaps it.
        group: callback group of its answers.
        refuse_to_block: called with what blocks and what does not, before something blocks; raises
            where that would wait for ever.

    Attributes:
        action_name: fully qualified, set by its maker; empty while unknown.
    """

    def __init__(
        self,
        node: Node,
        action_type: type[Any],
        name: str,
        *,
        group: CallbackGroup,
        refuse_to_block: Callable[[str, str], None],
    ) -> None:
        self._refuse_to_block = refuse_to_block
        self._goal_type = action_type.Goal
        self._what = f"action {name!r}"
        self._awaited: dict[Future, str] = {}  # what each says
        self._lock = threading.Lock()  # of the next two
        self._held: list[Callable[[], None]] = []
        self._destroyed = False
        self.action_name = ""
        super().__init__(node, action_type, name, callback_group=group)

    def send_goal(self, goal: Any, **options: Any) -> Any:
        """As rclpy's, outside of callbacks: it waits for the result."""
        self._refuse_to_block(f"a result of {self._what}", "send_goal_async(goal)")
        return _wait(_wait(self.send_goal_async(goal, **options)).get_result_async())

    def send_goal_async(self, goal: Any, *arguments: Any, **options: Any) -> Future:
        """As rclpy's; a goal is held until a server is matched, before which DDS would lose it.

        Whoever made this calls `send_held` when one may be.
        """
        if not isinstance(goal, self._goal_type):
            raise TypeError(f"{goal!r} is no goal of {self._what}")
        promised = self._await(Future(), "whether a goal is accepted")

        def send() -> None:
            sent = ActionClient.send_goal_async(self, goal, *arguments, **options)
            sent.add_done_callback(lambda _: self._accepted(sent, promised))

        if self.server_is_ready():
            send()
        else:
            with self._lock:
                self._held.append(send)
            self.send_held()  # one may have been matched meanwhile
        return promised

    def destroy(self) -> None:
        """As rclpy's; pending answers raise ActionClientGoneError. Again is harmless."""
        with self._lock:
            if self._destroyed:
                return
            self._destroyed = True
        for future, what in tuple(self._awaited.items()):
            if not future.done():
                future.set_exception(
                    ActionClientGoneError(
                        f"cannot learn {what} of {self._what}: the action client was disconnected"
                    )
                )
        super().destroy()

    def send_held(self) -> None:
        """Send what was held, if a server is matched now; in the executor."""
        with self._lock:
            if self._destroyed or not self.server_is_ready():
                return
            held, self._held = self._held, []
        for send in held:
            send()

    def _await(self, future: Future, what: str) -> Future:
        """Have an answer end with this client at the latest."""
        self._awaited[future] = what
        future.add_done_callback(lambda done: self._awaited.pop(done, None))
        return future

    def _accepted(self, sent: Future, promised: Future) -> None:
        """Pass on whether a goal is accepted, and have its handle ask as this client does."""
        if promised.done():
            return
        if (error := sent.exception()) is not None:
            promised.set_exception(error)
            return
        goal = sent.result()
        for what, answer, method in (
            (f"a result of {self._what}", "the result of a goal", "get_result"),
            (f"{self._what} to cancel a goal", "whether a goal is cancelled", "cancel_goal"),
        ):
            ask = functools.partial(self._ask, getattr(goal, f"{method}_async"), answer)
            setattr(goal, f"{method}_async", ask)
            setattr(goal, method, functools.partial(self._ask_and_wait, ask, what, method))
        promised.set_result(goal)

    def _ask(self, ask: Callable[[], Future], answer: str) -> Future:
        return self._await(ask(), answer)

    def _ask_and_wait(self, ask: Callable[[], Future], what: str, method: str) -> Any:
        self._refuse_to_block(what, f"goal_handle.{method}_async()")
        return _wait(ask())


def _wait(future: Future) -> Any:
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    done.wait()
    return future.result()


@typing.final
class GoalServer(ActionServer):  # type: ignore[misc]  # rclpy is not typed
    """An action server that lists the goals it works on and can be made to stop.

    Args:
        node: whose participant it is on.
        action_type: action class.
        name: as given to rcl, which expands and remaps it.
        execute: works on a goal and returns its result, or None for an empty one; must not raise. A
            goal that it did not bring to an end is aborted.
        accept: decides on a goal.
        group: callback group of its requests.

    Attributes:
        action_name: fully qualified, set by its maker; empty while unknown.
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
        self._log = node.get_logger().get_child("action_server")
        self._destroyed = False
        self.action_name = ""
        for private_name in ("_execute_goal", "_send_result_response"):
            private(super(), private_name, f"make action server {name!r}")
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

    @property
    def goals(self) -> tuple[ServerGoalHandle, ...]:
        """The goals that were accepted and have not ended."""
        return tuple(each for each in self._accepted if each.is_active)

    def finish(self, goal: ServerGoalHandle, result: Any | None) -> None:
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

    async def execute(self, taken_data: Any) -> None:
        """As rclpy's; what is decided on when the server is destroyed stays unanswered."""
        try:
            await super().execute(taken_data)
        except InvalidHandle:
            self._log.warning(
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

    def _begin(self, goal: ServerGoalHandle) -> None:
        self._accepted = (*self.goals, goal)
        goal.execute()

    async def _execute_goal(self, execute_callback: Any, goal_handle: ServerGoalHandle) -> None:
        result = await execute_callback(goal_handle)
        self.finish(goal_handle, result)

    def _send_result_response(self, request_header: Any, future: Any) -> None:
        try:
            super()._send_result_response(request_header, future)
        except InvalidHandle:
            self._log.warning(
                f"cannot send a result of action server {self.action_name!r}: it was disconnected "
                "before its goal had ended"
            )
