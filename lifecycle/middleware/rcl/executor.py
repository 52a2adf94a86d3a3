"""rclpy's single-threaded executor, one callback at a time.

Owns: `NodeExecutor`, whose user runs each callback itself and so knows when one begins and ends.
"""

from __future__ import annotations

from typing import Any

from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.task import Task
from rclpy.timer import Timer


class Callback:
    """One callback, or the next part of one that was suspended; call it to run it.

    Attributes:
        entity: what it is of; None for a task.
    """

    def __init__(self, task: Task, entity: Any) -> None:
        self._task = task
        self.entity = entity

    def __call__(self) -> None:
        """Run it; raises what it raises."""
        self._task()
        if (error := self._task.exception()) is not None:
            raise error


class NodeExecutor(SingleThreadedExecutor):  # type: ignore[misc]  # rclpy is not typed
    """Waits for the entities of its nodes and says which callback is next.

    Example:
        >>> executor = NodeExecutor(context=context)
        >>> executor.add_node(node)
        >>> while True:
        ...     executor.next_callback()()
    """

    def next_callback(self) -> Callback:
        """Wait for what is next.

        Raises:
            ShutdownException: the executor was shut down.
            ExternalShutdownException: the context was.
        """
        while True:
            try:
                task, entity, _ = self.wait_for_ready_callbacks()
            except InvalidHandle:  # destroyed in another thread meanwhile
                continue
            return Callback(task, entity)


def described(entity: Any) -> str:
    """Return what a callback is of, in words; empty where there is nothing to say."""
    try:
        if isinstance(entity, Subscription):
            return f"of the subscription of {entity.topic_name}"
        if isinstance(entity, Service):
            return f"of the service {entity.service_name}"
        if isinstance(entity, Timer):
            return f"of a timer of {entity.timer_period_ns / 1e9:g} s"
    except InvalidHandle:
        pass  # a callback before it has destroyed it
    return ""
