"""Programs of others: a node on a participant of its own, and questions to nodes of a system."""

from __future__ import annotations

import asyncio
import contextlib
import gc
from collections.abc import Callable, Coroutine, Iterator
from typing import Any

import rclpy
from rclpy.node import Node

from lifecycle.middleware.rcl.graph import GraphObserver
from lifecycle.middleware.services.clients import NodeClients


@contextlib.contextmanager
def stranger(domain_id: int, name: str = "intruder") -> Iterator[Node]:
    """Have a node that no supervisor started; at the end it has left the graph."""
    context = rclpy.Context()
    context.init(args=[], domain_id=domain_id)
    node = Node(name, context=context, enable_rosout=False)
    try:
        yield node
    finally:
        node.destroy_node()
        context.try_shutdown()
        context.destroy()
        gc.collect()  # what a cycle holds stays in the graph until it is found


def ask(domain_id: int, what: Callable[[NodeClients], Coroutine[Any, Any, Any]]) -> Any:
    """Ask nodes through their services; return the answer."""
    with GraphObserver(domain_id) as observer:
        clients = NodeClients(observer)
        try:
            return asyncio.run(what(clients))
        finally:
            clients.destroy()
