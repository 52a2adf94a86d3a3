"""The plan of a node before it is constructed: its PlannedNode, remappings and `module:Class`."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import os
import re
import sys
from collections.abc import Callable, Iterable
from typing import Any

import msgspec

from lifecycle.errors import BringUpError, LifecycleError, did_you_mean
from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.model import EndpointPolicy, Run, RunKind
from lifecycle.plan.model import PlannedNode


class Construction(msgspec.Struct, frozen=True, kw_only=True):
    """What a host says of a node that it is about to construct; it drives the node, too.

    Attributes:
        spec: the node's part of the plan; None for a node without a manifest.
        supervisor: name of the system whose supervisor alone may activate the node, once its gate
            is open; empty for a node that runs by itself.
    """

    spec: PlannedNode | None
    supervisor: str = ""


def is_auto(word: str) -> bool:
    """Return whether a node brings itself up, as `lifecycle=` says: "auto", or "manual".

    Raises:
        LifecycleError: neither of them.
    """
    if word not in ("manual", "auto"):
        raise LifecycleError(f"cannot use lifecycle={word!r}; allowed: 'manual', 'auto'")
    return word == "auto"


def default_name(node_class: type) -> str:
    """Return a node name for a class: `FrontCamera` → `front_camera`."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", node_class.__name__).lower()


def calling_position(*, depth: int) -> Position:
    """Return the file and line `depth` calls above this function's caller."""
    frame = inspect.currentframe()
    for _ in range(depth + 1):
        frame = frame.f_back if frame is not None else None
    if frame is None:
        return Position(file="<code>", line=1, column=1)
    return Position(file=frame.f_code.co_filename, line=frame.f_lineno, column=1)


def plan_without_manifest(node_class: type, *, name: str, namespace: str) -> PlannedNode:
    """Return the plan of an unplanned node: no endpoints yet, default deadlines."""
    module = sys.modules.get(node_class.__module__)
    at = Position(file=getattr(module, "__file__", None) or "<code>", line=1, column=1)
    return PlannedNode(
        key=name,
        name=name,
        namespace=namespace,
        machine="",
        process=name,
        run=Run(kind=RunKind.ATTACH),
        endpoints=(),
        declared_parameters=(),
        participants=(),
        endpoint_policy=EndpointPolicy.OPEN,
        events=True,
        at=at,
    )


def ros_arguments(spec: PlannedNode) -> list[str]:
    """Return the `--ros-args …` of one node: remaps and parameter files, as rcl applies them."""
    words: list[str] = []
    for source, target in spec.remap:
        words += ["-r", f"{source}:={target}"]
    for file in spec.parameter_files:
        words += ["--params-file", file]
    return ["--ros-args", *words] if words else []


def load_nodes(reference: str, folders: Iterable[str] = ()) -> Callable[..., Any]:
    """Import `package.module:Class` or `package.module:function`.

    It is looked for in the working directory, as `python -m` does, in `folders`, on PYTHONPATH, and
    in what is installed.

    Args:
        reference: as the manifest has it.
        folders: absolute; where the manifest is.

    Raises:
        BringUpError: malformed, no such module, no such name, or a class that is no rclpy node.
            What the module itself raises while it is imported passes through.
    """
    from rclpy.node import Node

    module_name, separator, name = reference.partition(":")
    if not separator or not module_name or not name.isidentifier():
        raise BringUpError(f"cannot read {reference!r}; write package.module:Class")
    looked = _look_in(folders)
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        # A module that itself lacks one is another matter: let its traceback be seen.
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise
        raise BringUpError(
            f"cannot import {reference!r}: no module {error.name!r}",
            hint=f"it is looked for in {', '.join(looked)} and in what is installed",
        ) from error
    found = getattr(module, name, None)
    if isinstance(found, type) and issubclass(found, Node):
        return found
    if callable(found) and not isinstance(found, type):
        function: Callable[..., Any] = found
        return function
    nodes = [
        each
        for each, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, Node)
    ]
    what = "has no" if found is None else "has, but not as a node class or a function,"
    raise BringUpError(
        f"cannot use {reference!r}: {module_name} {what} {name!r}",
        hint=did_you_mean(name, nodes) or f"node classes there: {nodes or 'none'}",
    )


def _look_in(folders: Iterable[str]) -> tuple[str, ...]:
    """Have modules looked for in more places, and return these."""
    # PYTHONPATH of the manifest's own `environment:` came after this interpreter started.
    given = [each for each in os.environ.get("PYTHONPATH", "").split(os.pathsep) if each]
    current = os.getcwd()  # noqa: PTH109 - it is a text
    here = [] if "" in sys.path else [current]
    for each in reversed([*here, *folders, *given]):
        if each not in sys.path:
            sys.path.insert(0, each)
    return tuple(dict.fromkeys([current, *folders, *given]))
