"""The services of component containers with the fields of composition_interfaces, on other types.

The type that is sent has what it takes, parameters and a result with a text; the fields that it
lacks travel in these as JSON. A container that is to be loaded by this must import it too.
"""

from __future__ import annotations

import json
from typing import Any

import rclpy.parameter
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParametersAtomically

_EXTRA = "/extra/"
_FIELDS = "/fields"  # no parameter of a node has a slash in front


def _request(base: type[Any]) -> type[Any]:
    class Request(base):  # type: ignore[misc]
        def __init__(
            self, *, parameters: Any = (), extra_arguments: Any = (), **fields: Any
        ) -> None:
            text = ParameterValue(string_value=json.dumps(fields))
            extra = (
                Parameter(name=_EXTRA + each.name, value=each.value) for each in extra_arguments
            )
            rest = (*extra, Parameter(name=_FIELDS, value=text))
            super().__init__(parameters=[*parameters, *rest])

    return Request


def fields_of(request: Any) -> dict[str, Any]:
    """Return the fields of a request as it was received, lists of parameters among them."""
    *given, fields = request.parameters
    return {
        **json.loads(fields.value.string_value),
        "parameters": [each for each in given if not each.name.startswith(_EXTRA)],
        "extra_arguments": {
            each.name.removeprefix(_EXTRA): rclpy.parameter.parameter_value_to_python(each.value)
            for each in given
            if each.name.startswith(_EXTRA)
        },
    }


def respond(response: Any, **fields: Any) -> Any:
    """Fill a response in."""
    response.result.reason = json.dumps(fields)
    return response


def _field(name: str) -> property:
    return property(lambda response: json.loads(response.result.reason)[name])


_LISTS = ("full_node_names", "unique_ids")

for _name in ("success", "error_message", "full_node_name", "unique_id", *_LISTS):
    setattr(SetParametersAtomically.Response, _name, _field(_name))


class LoadNode(SetParametersAtomically):
    """Load a plugin of a package as a node."""

    Request = _request(SetParametersAtomically.Request)


class UnloadNode(SetParametersAtomically):
    """Unload the node of a number."""

    Request = _request(SetParametersAtomically.Request)


class ListNodes(SetParametersAtomically):
    """List the nodes that were loaded."""

    Request = _request(SetParametersAtomically.Request)
