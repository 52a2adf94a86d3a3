"""The plan of a node, applied to its construction: its class, names, remaps and parameters.

Values of parameters come, weakest first, from the interface's default, parameter files, and the
manifest's `parameters:`. Parameters stay declared through cleanup, so that what an operator set
survives into the next configure.
"""

from __future__ import annotations

import copy
import functools
import importlib
import importlib.util
import os
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import msgspec
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.parameter import Parameter

from lifecycle.errors import BringUpError, LifecycleError, did_you_mean
from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.model import EndpointPolicy, Run, RunKind
from lifecycle.manifest.parameter_values import type_of
from lifecycle.middleware.rcl.conversions import (
    PARAMETER_TYPES,
    parameter_to_rclpy,
    parameter_value,
    type_word,
)
from lifecycle.plan.model import PlannedNode, raw_value
from lifecycle.plan.parameters import DEFAULT
from lifecycle.verify.observation import ParameterReport

if TYPE_CHECKING:
    from rclpy.node import Node


class Construction(msgspec.Struct, frozen=True, kw_only=True):
    """What a host says of a node that it is about to construct; it drives the node, too.

    Attributes:
        spec: the node's part of the plan; None for a node without a manifest.
        supervisor: name of the system whose gate holds it; empty for none.
    """

    spec: PlannedNode | None
    supervisor: str = ""


def is_auto(word: str) -> bool:
    """Return whether a node brings itself up, as `lifecycle=` says: "auto", or "manual"."""
    if word not in ("manual", "auto"):
        raise LifecycleError(f"cannot use lifecycle={word!r}; allowed: 'manual', 'auto'")
    return word == "auto"


def default_name(node_class: type) -> str:
    """Return a node name for a class: `FrontCamera` → `front_camera`."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", node_class.__name__).lower()


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

    It is looked for in the working directory, as `python -m` does, in `folders` (absolute, of the
    manifest), on PYTHONPATH, and in what is installed.

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
    what = "has no" if found is None else "has, but not as a node class or a function,"
    raise BringUpError(
        f"cannot use {reference!r}: {module_name} {what} {name!r}",
        hint=did_you_mean(name, vars(module)),
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


_ARRAYS = frozenset(each for name, each in PARAMETER_TYPES.items() if name.endswith("_array"))


def _overrides(spec: PlannedNode) -> list[Parameter]:
    """Return the plan's values as rclpy overrides; they win over parameter files."""
    declared = {each.name: each.type for each in spec.declared_parameters}
    expected = {each.name: each.type for each in spec.expected_parameters}
    found: list[Parameter] = []
    for name, written in spec.parameters:
        given = raw_value(written, expected.get(name, ""))  # doubles that JSON cannot carry
        value = parameter_to_rclpy(given, declared.get(name, "") or type_of(given))
        if value != []:
            found.append(Parameter(name, value=value))
    return found


def planned_options(node: Node, spec: PlannedNode, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return keywords to construct a node with: the plan's remaps, parameter files and values."""
    _give_empty_arrays(node, spec)
    return {
        **options,
        "cli_args": [*ros_arguments(spec), *(options.get("cli_args") or ())],
        "parameter_overrides": [*(options.get("parameter_overrides") or ()), *_overrides(spec)],
    }


def _give_empty_arrays(node: Node, spec: PlannedNode) -> None:
    """Have a node that is about to be constructed declare its empty arrays with their type.

    Neither rcl's parameter files nor rclpy's overrides and defaults have an empty array of another
    type than byte_array: each is declared without it, and set to it before anything can read it.
    """
    empty = {
        each.name: "" if each.type == "array" else each.type
        for each in spec.expected_parameters
        if each.value == () and each.source != DEFAULT
    }
    if not empty:
        return
    declare_all = node.declare_parameters

    @functools.wraps(declare_all)
    def declare_parameters(
        namespace: str, parameters: Iterable[tuple[Any, ...]], ignore_override: bool = False
    ) -> list[Parameter]:
        found: list[Parameter] = []
        for each in parameters:
            name = f"{namespace}.{each[0]}" if namespace else each[0]
            type_ = None if ignore_override else _array_type(each, empty.get(name))
            if type_ is None:
                found += declare_all(namespace, [each], ignore_override)
            else:
                descriptor = each[2] if len(each) > 2 else ParameterDescriptor()
                found.append(_declare_empty(node, declare_all, name, type_, descriptor))
        return found

    node.declare_parameters = declare_parameters


def _array_type(declared: tuple[Any, ...], wanted: str | None) -> Parameter.Type | None:
    """Return the type of an empty array that a declaration is to get; None if it is to get none.

    It is declared as rclpy's declare_parameters() has it; `wanted` is our name of the type, empty
    for that of the declaration.
    """
    if wanted is None:
        return None
    by_code = declared[1] if len(declared) > 1 else None
    if by_code is not None and not isinstance(by_code, Parameter.Type):
        by_code = Parameter.Type.from_parameter_value(by_code)
    # Where types differ, rclpy refuses the value, as any of another type.
    found = PARAMETER_TYPES[wanted] if wanted else by_code
    return found if found in _ARRAYS else None


def _declare_empty(
    node: Node,
    declare_all: Callable[..., list[Parameter]],
    name: str,
    type_: Parameter.Type,
    descriptor: ParameterDescriptor,
) -> Parameter:
    """Declare a parameter as an empty array; raises InvalidParameterValueException."""
    writable = copy.copy(descriptor)
    writable.read_only = False
    second = None if descriptor.dynamic_typing else type_
    declare_all("", [(name, second, writable)], ignore_override=True)
    value = Parameter(name, type_, [])
    (result,) = node.set_parameters([value])
    if not result.successful:
        node.undeclare_parameter(name)
        raise InvalidParameterValueException(name, [], result.reason)
    if descriptor.read_only:
        last = copy.copy(writable)
        last.read_only = True
        node.set_descriptor(name, last)
    return value


def declare_parameters(node: Node, spec: PlannedNode) -> None:
    """Declare the interface's parameters that the node does not have yet.

    Raises:
        LifecycleError: every value that does not fit its declaration.
    """
    problems: list[str] = []
    given = {each.name for each in spec.expected_parameters if each.source not in ("", DEFAULT)}
    for declared in spec.declared_parameters:
        if node.has_parameter(declared.name):
            continue
        descriptor = ParameterDescriptor(
            description=declared.description, read_only=declared.read_only
        )
        value: Any = PARAMETER_TYPES[declared.type]
        if declared.default is not None:
            value = parameter_to_rclpy(raw_value(declared.default, declared.type), declared.type)
        try:
            if value == [] and declared.name not in given:
                type_ = PARAMETER_TYPES[declared.type]
                _declare_empty(node, node.declare_parameters, declared.name, type_, descriptor)
            else:
                value = PARAMETER_TYPES[declared.type] if value == [] else value
                node.declare_parameter(declared.name, value, descriptor)
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            problems.append(
                f"{declared.at.spelled}: cannot declare parameter {declared.name!r} as "
                f"{declared.type}: {error}"
            )
    if problems:
        raise LifecycleError("\n".join(problems))


def parameter_reports(node: Node) -> tuple[ParameterReport, ...]:
    """Return what every parameter that `node` has declared is now, sorted by name."""
    found = sorted(node.get_parameters_by_prefix("").items())
    descriptors = node.describe_parameters([name for name, _ in found])
    return tuple(
        ParameterReport.of(
            name,
            type_word(parameter.type_.value) or type_word(descriptor.type),
            parameter_value(parameter.value),
            read_only=descriptor.read_only,
        )
        for (name, parameter), descriptor in zip(found, descriptors, strict=True)
    )
