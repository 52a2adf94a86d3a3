"""Public names of rooms that load on first use (PEP 562), so that a room's types need no ROS."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any


def names(room: str, **public: str) -> Callable[[str], Any]:
    """Return the `__getattr__` of a room, which programs import names from.

    Args:
        room: full name of the package.
        **public: by module of the room, its public names with spaces between them.
    """
    homes = {name: module for module, listed in public.items() for name in listed.split()}

    def find(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {room!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"{room}.{homes[name]}"), name)

    return find
