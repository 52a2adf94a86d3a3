"""Parameters of other processes' nodes, read and set through their parameter services.

Owns: the requests that read them, what a plan gives, and how rcl_interfaces' types become ours,
those of a node in this process too.
"""

from __future__ import annotations

import array
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import ParameterDescriptor
from rcl_interfaces.msg import ParameterValue as ParameterValueMessage
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters
from rclpy.parameter import Parameter, parameter_value_to_python

from lifecycle.manifest.model import ParameterValue
from lifecycle.plan.model import PlannedNode
from lifecycle.plan.parameters import COMMAND, DEFAULT
from lifecycle.verify.observation import ParameterReport

if TYPE_CHECKING:
    from lifecycle.middleware.services.service_calls import ServiceCalls

TYPES = {
    "bool": Parameter.Type.BOOL,
    "int": Parameter.Type.INTEGER,
    "double": Parameter.Type.DOUBLE,
    "string": Parameter.Type.STRING,
    "byte_array": Parameter.Type.BYTE_ARRAY,
    "bool_array": Parameter.Type.BOOL_ARRAY,
    "int_array": Parameter.Type.INTEGER_ARRAY,
    "double_array": Parameter.Type.DOUBLE_ARRAY,
    "string_array": Parameter.Type.STRING_ARRAY,
}
"""Our type name → rclpy's type, whose value is rcl_interfaces/msg/ParameterType's."""

_WORDS = {each.value: word for word, each in TYPES.items()}


async def read_parameters(
    calls: ServiceCalls, node: str, names: Collection[str] | None, *, timeout_s: float
) -> list[tuple[ParameterDescriptor, str, ParameterValue | None]]:
    """Read parameters of a node: descriptor, our name of the type, and value; sorted by name.

    One that is declared and not set has an empty type and no value.

    Args:
        calls: makes the requests.
        node: fully qualified name.
        names: those that it has of these; None for all.
        timeout_s: seconds, > 0, for each request; raises as `ServiceCalls.call`.
    """
    import asyncio  # late: a host, which needs `parameter_value` only, has no use for it

    async def ask(service: str, type_: type[Any], **fields: Any) -> Any:
        return await calls.call(f"{node}/{service}", type_, timeout_s, **fields)

    async def get(asked: list[str]) -> list[Any]:
        return list((await ask("get_parameters", GetParameters, names=asked)).values)

    has = set((await ask("list_parameters", ListParameters)).result.names)
    wanted = sorted(has if names is None else has.intersection(names))
    if not wanted:
        return []
    described, values = await asyncio.gather(
        ask("describe_parameters", DescribeParameters, names=wanted), get(wanted)
    )
    if len(values) != len(wanted):
        # One that is declared and not set makes rclpy and rclcpp answer with none at all.
        alone = await asyncio.gather(*(get([name]) for name in wanted))
        values = [each[0] if each else ParameterValueMessage() for each in alone]
    found = {each.name: each for each in described.descriptors}
    return [
        (
            found.get(name, ParameterDescriptor(name=name)),
            type_word(value.type),
            parameter_value(parameter_value_to_python(value)) if value.type in _WORDS else None,
        )
        for name, value in zip(wanted, values, strict=True)
    ]


def type_word(type_: int) -> str:
    """Return our name of a rcl_interfaces/msg/ParameterType; empty for one that is not set."""
    return _WORDS.get(type_, "")


def parameter_value(value: Any) -> ParameterValue | None:
    """Return a value as rclpy has it in our types: arrays are tuples, bytes are integers."""
    if isinstance(value, (bytes, list, tuple, array.array)):
        return tuple(each[0] if isinstance(each, bytes) else each for each in value)
    plain: ParameterValue | None = value
    return plain


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


def given_values(planned: PlannedNode, has: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return what a plan gives a node's parameters, by name, but by its command line.

    Empty arrays are among them, too: rcl reads none from a command line. One whose type is declared
    nowhere is given by the type that the node has for it, and not at all where that is unknown.

    Args:
        planned: the node.
        has: types of what the node has, by name; None while it is not made.
    """
    given = {}
    for each in planned.expected_parameters:
        word = (has or {}).get(each.name, "") if each.type == "array" else each.type
        is_known = word in TYPES and (each.type != "array" or word.endswith("_array"))
        is_given = each.value is not None and each.source != DEFAULT
        if is_known and is_given and (each.source != COMMAND or each.value == ()):
            given[each.name] = Parameter(each.name, TYPES[word], to_rclpy(each.raw, word))
    return given


def differs(has: ParameterReport, given: Parameter) -> bool:
    """Whether a node has another value than it is given; what is not a number equals itself."""
    type_, value = type_word(given.type_.value), parameter_value(given.value)
    return has != ParameterReport.of(has.name, type_, value, read_only=has.read_only)
