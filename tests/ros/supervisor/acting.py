"""Node classes of the tests of actions in systems: one counts, one has it count."""

from __future__ import annotations

from typing import Any

from test_msgs.action import Fibonacci

from lifecycle import LifecycleNode, on_action, on_timer


class Counter(LifecycleNode):
    @on_action("count")
    async def count(self, goal: Any) -> Fibonacci.Result:
        counted: list[int] = []
        while len(counted) < goal.request.order and goal.is_active:
            counted.append(len(counted))
            goal.publish_feedback(Fibonacci.Feedback(sequence=counted))
            await self.sleep(0.01)
        if goal.is_active:
            goal.succeed()
        return Fibonacci.Result(sequence=counted)


class Failing(LifecycleNode):
    @on_action("count")
    async def count(self, goal: Any) -> Fibonacci.Result:
        raise OSError("no such number")


class Asking(LifecycleNode):
    """Sends one goal after the other, whatever becomes of them."""

    @on_timer(period_s=0.1)
    async def ask(self) -> None:
        await self.action_client("count").send_goal_async(Fibonacci.Goal())


class Caller(LifecycleNode):
    _endless: Any = None

    async def on_activate(self) -> None:
        goal = await self.action_client("count").send_goal_async(Fibonacci.Goal(order=3))
        answer = await goal.get_result_async()
        print(f"counted {list(answer.result.sequence)}, status {answer.status}", flush=True)

    @on_timer(period_s=0.02)
    async def count_for_ever(self) -> None:
        if self._endless is None:
            action = self.action_client("count")
            self._endless = action.send_goal_async(Fibonacci.Goal(order=2**31 - 1))
            await self._endless
            print("counts for ever", flush=True)
