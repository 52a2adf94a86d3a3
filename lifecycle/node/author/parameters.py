"""Parameters of a node: what its interface declares, with the values the plan gives.

Owns: from ParameterDeclaration to rclpy's declared parameters, and what a node reports of them.
Values come, weakest first, from the interface's default, parameter files, and the manifest's
`parameters:`. Parameters stay declared through cleanup, so that what an operator set survives into
the next configure.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
)
from rclpy.parameter import Parameter
from rclpy.parameter_service import ParameterService

from lifecycle.errors import LifecycleError
from lifecycle.manifest import ParameterDeclaration, ParameterValue
from lifecycle.middleware import parameter_value, type_word
from lifecycle.verify import ParameterReport

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rclpy.node import Node
    from rclpy.service import Service

    from lifecycle.plan import PlannedNode

_TYPES = {
    "bool": Parameter.Type.BOOL,
    "int": Parameter.Type.INTEGER,
    "double": Parameter.Type.DOUBLE,
    "string": Parameter.Type.STRING,
    "bool_array": Parameter.Type.BOOL_ARRAY,
    "int_array": Parameter.Type.INTEGER_ARRAY,
    "double_array": Parameter.Type.DOUBLE_ARRAY,
    "string_array": Parameter.Type.STRING_ARRAY,
    "byte_array": Parameter.Type.BYTE_ARRAY,
}


def overrides(spec: PlannedNode) -> list[Parameter]:
    """Return the plan's values as rclpy overrides; they win over parameter files."""
    types = {declared.name: declared.type for declared in spec.declared_parameters}
    return [
        Parameter(name, value=to_rclpy(value, types.get(name, "")))
        for name, value in spec.parameters
    ]


_MAKES_MORE = (
    "allow_undeclared_parameters",
    "automatically_declare_parameters_from_overrides",
    "start_parameter_services",
)
"""rclpy's options by which a node may have parameters that no declaration of its code adds."""


def may_have_none(spec: PlannedNode | None, options: Mapping[str, Any]) -> bool:
    """Return whether, for all that is known before it is made, a node declares no parameter."""
    if spec is None or spec.declared_parameters or spec.parameters:
        return False
    return not options.get("parameter_overrides") and not any(
        each in options for each in _MAKES_MORE
    )


def serve(node: Node) -> tuple[Service, ...]:
    """Make rclpy's parameter services for a node that was made without; return them."""
    before = set(node.services)
    node._parameter_service = ParameterService(node)  # noqa: SLF001 - where rclpy keeps it
    return tuple(each for each in node.services if each not in before)


def declare(node: Node, spec: PlannedNode) -> None:
    """Declare the interface's parameters that the node does not have yet.

    Raises:
        LifecycleError: every value that does not fit its declaration.
    """
    problems: list[str] = []
    for declared in spec.declared_parameters:
        if node.has_parameter(declared.name):
            continue
        descriptor = ParameterDescriptor(
            description=declared.description, read_only=declared.read_only
        )
        value: Any = _TYPES[declared.type]
        if declared.default is not None:
            value = to_rclpy(declared.default, declared.type)
        try:
            node.declare_parameter(declared.name, value, descriptor)
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            problems.append(_problem(declared, error))
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


def to_rclpy(value: ParameterValue, type_: str) -> Any:
    """Return `value` as rclpy wants it for a parameter of `type_`.

    YAML writes 5 where a double is meant, and bytes as a list of integers.
    """
    if isinstance(value, tuple):
        if type_ == "double_array":
            return [float(each) for each in value]
        if type_ == "byte_array":
            return [bytes((int(each),)) for each in value]
        return list(value)
    if type_ == "double" and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return value


def _problem(declared: ParameterDeclaration, error: Exception) -> str:
    at = declared.at
    return (
        f"{at.file}:{at.line}:{at.column}: cannot declare parameter {declared.name!r} as "
        f"{declared.type}: {error}"
    )
