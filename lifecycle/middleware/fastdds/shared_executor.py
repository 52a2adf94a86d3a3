"""Endpoints of one participant whose callbacks another node's executor runs.

Owns: showing an endpoint to the node that it serves instead of to the hidden node that made it. An
executor asks its nodes for their entities each time it waits, and rcl waits for entities of any
context together; so a guest is spun by whatever spins the host, now and later, is gated by the
host's callback groups, and costs no thread and nothing while idle.
"""

from __future__ import annotations

import typing
import weakref
from typing import Any

from rclpy.client import Client
from rclpy.node import Node
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.waitable import Waitable

Action: typing.TypeAlias = Waitable
"""An action server or client; importing their classes takes 100 ms."""

Guest: typing.TypeAlias = Subscription | Service | Client | Action

_LISTS = {Subscription: "_subscriptions", Service: "_services", Client: "_clients"}
_guests: weakref.WeakSet[Any] = weakref.WeakSet()


def move(entity: Guest, maker: Node, host: Node) -> None:
    """Have `host`'s executor run the callbacks of an endpoint that `maker` has just made.

    Its callback group must be one of `host`'s. `host.destroy_…` takes it away again.
    """
    if isinstance(entity, Waitable):
        maker.remove_waitable(entity)
        entity._node = host  # noqa: SLF001 - whose executor works on goals, and which removes it
        host.add_waitable(entity)
        return
    name = _LISTS[type(entity)]
    getattr(maker, name).remove(entity)
    getattr(host, name).append(entity)
    for handler in entity.event_handlers if isinstance(entity, Subscription) else ():
        maker.remove_waitable(handler)
        host.add_waitable(handler)
    _guests.add(entity)
    host._wake_executor()  # noqa: SLF001 - as Node.create_… does


def is_guest(entity: object) -> bool:
    """Whether an endpoint is on a node whose participant is not its own."""
    return entity in _guests


def dismiss(entity: Guest, host: Node) -> None:
    """Destroy a guest; harmless if `host` did, or was destroyed itself."""
    if isinstance(entity, Waitable):
        entity.destroy()
        return
    for kind, destroy in (
        (Subscription, host.destroy_subscription),
        (Service, host.destroy_service),
        (Client, host.destroy_client),
    ):
        if isinstance(entity, kind):
            destroy(entity)
