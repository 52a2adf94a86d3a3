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


class NodeExecutor(SingleThreadedExecutor):  # type: ignore[misc]  # rclpy is not typed
    """Waits for the entities of its nodes and says which callback is next.

    Example:
        >>> executor = NodeExecutor(context=context)
        >>> executor.add_node(node)
        >>> while True:
        ...     task, entity = executor.next_callback()
        ...     run(task)
    """

    def next_callback(self) -> tuple[Task, Any]:
        """Wait for a callback, or the next part of one, and return it and what it is of, or None.

        Raises:
            ShutdownException: the executor was shut down.
            ExternalShutdownException: the context was.
        """
        while True:
            try:
                task, entity, _ = self.wait_for_ready_callbacks()
            except InvalidHandle:  # destroyed in another thread meanwhile
                continue
            return task, entity


def run(task: Task) -> None:
    """Run a callback; raises what it raises."""
    task()
    if (error := task.exception()) is not None:
        raise error


def described(entity: Any) -> str:
    """Return what a callback is of, in words; empty for a task."""
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
