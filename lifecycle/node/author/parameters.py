"""Parameters of a node: what its interface declares, with the values the plan gives.

Values come, weakest first, from the interface's default, parameter files, and the manifest's
`parameters:`. Parameters stay declared through cleanup, so that what an operator set survives into
the next configure.
"""

from __future__ import annotations

import copy
import functools
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
)
from rclpy.parameter import Parameter

from lifecycle.errors import LifecycleError
from lifecycle.manifest.parameter_files import type_of
from lifecycle.middleware.rcl.conversions import (
    PARAMETER_TYPES,
    parameter_to_rclpy,
    parameter_value,
    type_word,
)
from lifecycle.node.author.spec import ros_arguments
from lifecycle.plan.model import raw_value
from lifecycle.plan.parameters import DEFAULT
from lifecycle.verify.observation import ParameterReport

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from rclpy.node import Node

    from lifecycle.plan.model import PlannedNode

_ARRAYS = frozenset(each for name, each in PARAMETER_TYPES.items() if name.endswith("_array"))


def overrides(spec: PlannedNode) -> list[Parameter]:
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
        "parameter_overrides": [*(options.get("parameter_overrides") or ()), *overrides(spec)],
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

    Args:
        declared: name, value or type, and descriptor, as rclpy's declare_parameters() has them.
        wanted: our name of the type; empty: that of the declaration; None: no array is given.
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
    """Declare a parameter as an empty array of a type, read-only or not.

    Raises:
        InvalidParameterValueException: a callback of the node refuses it.
    """
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


def declare(node: Node, spec: PlannedNode) -> None:
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


def reports(node: Node) -> tuple[ParameterReport, ...]:
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
