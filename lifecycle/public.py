"""Public names of rooms that load on first use (PEP 562), so that a room's types need no ROS."""

from __future__ import annotations

import importlib
from collections.abc import Collection, Mapping


def public_name(room: str, public: Mapping[str, Collection[str]], name: str) -> object:
    """Return a name that programs import from a room, for the room's `__getattr__`.

    Args:
        room: full name of the package.
        public: its public names, by the module that has them.
        name: what is asked for.

    Raises:
        AttributeError: the room offers no such name.
    """
    for module, names in public.items():
        if name in names:
            return getattr(importlib.import_module(module), name)
    raise AttributeError(f"module {room!r} has no attribute {name!r}")
