"""From `module:Class` to a node object. Owns: finding the class, and saying why it cannot be."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from lifecycle.errors import BringUpError
from lifecycle.node.author.handlers import nearest

if TYPE_CHECKING:
    from rclpy.node import Node


def load_class(reference: str) -> type[Node]:
    """Import `package.module:Class`; the working directory is looked in, as `python -m` does.

    Raises:
        BringUpError: malformed, no such module, no such class, or not an rclpy node. What the
            module itself raises while it is imported passes through.
    """
    from rclpy.node import Node

    module_name, separator, class_name = reference.partition(":")
    if not separator or not module_name or not class_name.isidentifier():
        raise BringUpError(f"cannot read {reference!r}; write package.module:Class")
    here = str(Path.cwd())
    if here not in sys.path and "" not in sys.path:
        sys.path.insert(0, here)
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        # A module that itself lacks one is another matter: let its traceback be seen.
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise
        raise BringUpError(
            f"cannot import {reference!r}: no module {error.name!r}",
            hint=f"it is looked for in {here} and in what is installed",
        ) from error
    found = getattr(module, class_name, None)
    if not isinstance(found, type) or not issubclass(found, Node):
        nodes = [
            name
            for name, value in vars(module).items()
            if isinstance(value, type) and issubclass(value, Node)
        ]
        near = nearest(class_name, nodes)
        what = "has no" if found is None else "has, but not as a node class,"
        raise BringUpError(
            f"cannot use {reference!r}: {module_name} {what} {class_name!r}",
            hint=f"did you mean {near!r}?" if near else f"node classes there: {nodes or 'none'}",
        )
    return found
