"""Message, service and action classes by their ROS name.

Owns: `package/msg/Type` → Python class, and the message that says what is wrong with a name.
"""

from __future__ import annotations

import difflib
import importlib
import re
from typing import Any

from lifecycle.errors import MiddlewareError

_NAME = re.compile(r"(?P<package>[a-z][a-z0-9_]*)/(?P<kind>msg|srv|action)/(?P<type>[A-Z]\w*)")


class UnknownInterfaceError(MiddlewareError):
    """An interface type that is not spelled as ROS does, or is not installed."""


def import_interface(name: str) -> type[Any]:
    """Return the class of `package/msg/Type`, `package/srv/Type` or `package/action/Type`.

    Raises:
        UnknownInterfaceError: malformed, or the package or the type is not installed.
    """
    parts = _NAME.fullmatch(name)
    if parts is None:
        raise UnknownInterfaceError(
            f"cannot read interface type {name!r}: write package/msg/Type, package/srv/Type or "
            "package/action/Type"
        )
    package, kind, type_ = parts["package"], parts["kind"], parts["type"]
    try:
        module = importlib.import_module(f"{package}.{kind}")
    except ModuleNotFoundError as error:
        if error.name not in (package, f"{package}.{kind}"):
            raise
        raise UnknownInterfaceError(
            f"cannot find interface type {name!r}: no package {package!r} with {kind} interfaces "
            "is installed",
            hint=f"install {package}, or source the workspace that has it",
        ) from error
    found = getattr(module, type_, None)
    if not isinstance(found, type):
        near = difflib.get_close_matches(type_, dir(module), n=1)
        raise UnknownInterfaceError(
            f"cannot find interface type {name!r}: package {package!r} has no {kind} {type_!r}",
            hint=f"did you mean {package}/{kind}/{near[0]}?" if near else "",
        )
    return found
