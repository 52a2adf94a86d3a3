"""The parameters of other processes' nodes, through their parameter services.

Owns: what is asked of rcl_interfaces' services and how the answers become our types. Nodes that
serve no parameters have none of these services.
"""

from __future__ import annotations

import array
from typing import Any

from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters

from lifecycle.export.captured import CapturedParameter
from lifecycle.manifest.model import ParameterValue
from lifecycle.middleware.service_calls import ServiceCalls

_TYPES = {
    ParameterType.PARAMETER_BOOL: ("bool", "bool_value"),
    ParameterType.PARAMETER_INTEGER: ("int", "integer_value"),
    ParameterType.PARAMETER_DOUBLE: ("double", "double_value"),
    ParameterType.PARAMETER_STRING: ("string", "string_value"),
    ParameterType.PARAMETER_BYTE_ARRAY: ("byte_array", "byte_array_value"),
    ParameterType.PARAMETER_BOOL_ARRAY: ("bool_array", "bool_array_value"),
    ParameterType.PARAMETER_INTEGER_ARRAY: ("int_array", "integer_array_value"),
    ParameterType.PARAMETER_DOUBLE_ARRAY: ("double_array", "double_array_value"),
    ParameterType.PARAMETER_STRING_ARRAY: ("string_array", "string_array_value"),
}
"""rcl_interfaces/msg/ParameterType → our word, and where ParameterValue holds the value."""


async def read_parameters(
    calls: ServiceCalls, node: str, *, timeout_s: float
) -> tuple[CapturedParameter, ...]:
    """Read every parameter that a node declares: its type, value and description.

    Args:
        calls: makes the requests.
        node: fully qualified name.
        timeout_s: seconds, > 0, for each of three requests.

    Raises:
        ServiceUnansweredError: no such service, or no answer.
    """

    async def ask(service: str, type_: type[Any], request: object) -> Any:
        name = f"{node}/{service}"
        return await calls.call(name, type_, request, timeout_s=timeout_s, repeat=True)

    listed = await ask("list_parameters", ListParameters, ListParameters.Request())
    names = sorted(listed.result.names)
    if not names:
        return ()
    described = await ask(
        "describe_parameters", DescribeParameters, DescribeParameters.Request(names=names)
    )
    values = await ask("get_parameters", GetParameters, GetParameters.Request(names=names))
    found = {each.name: each for each in described.descriptors}
    return tuple(
        _parameter(name, found.get(name), value)
        for name, value in zip(names, values.values, strict=False)
    )


def _parameter(name: str, descriptor: Any, value: Any) -> CapturedParameter:
    told = _TYPES.get(value.type)
    return CapturedParameter(
        name=name,
        type=told[0] if told else "",
        value=_plain(getattr(value, told[1])) if told else None,
        description=descriptor.description if descriptor else "",
        read_only=bool(descriptor and descriptor.read_only),
    )


def _plain(value: Any) -> ParameterValue:
    """Arrays come as lists, array.array, or bytes one by one."""
    if isinstance(value, (list, tuple, array.array)):
        return tuple(each[0] if isinstance(each, bytes) else each for each in value)
    plain: ParameterValue = value
    return plain
