"""Endpoints that code makes with rclpy's own factories: on no interface, and yet of the node.

Owns: knowing them, so that the node configuration can tell of them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

from rclpy.exceptions import InvalidHandle

from lifecycle.manifest.model import EndpointKind
from lifecycle.node.endpoints.making import wire_name


class Undeclared:
    """The endpoints that the code of one node made by itself.

    Args:
        changed: told when one comes or goes.
    """

    def __init__(self, changed: Callable[[], None]) -> None:
        self._changed = changed
        self._made: dict[int, tuple[EndpointKind, Any]] = {}

    def add(self, kind: EndpointKind, entity: Any) -> None:
        """Note one that rclpy's factory returned; those of the data layer are sorted out later."""
        self._made[id(entity)] = (kind, entity)
        self._changed()

    def remove(self, entity: Any) -> None:
        """Forget one that is being destroyed."""
        if self._made.pop(id(entity), None) is not None:
            self._changed()

    def beside(self, declared: Collection[Any]) -> tuple[tuple[EndpointKind, Any], ...]:
        """Return (kind, rclpy object) of those that stand for nothing declared."""
        known = {id(each) for each in declared}
        found = []
        for key, (kind, entity) in tuple(self._made.items()):
            if key in known:
                continue
            try:
                wire_name(entity)
            except InvalidHandle:
                del self._made[key]  # destroyed behind its node's back
                continue
            found.append((kind, entity))
        return tuple(found)
