"""The services of component containers with the fields of composition_interfaces, on other types.

The type that is sent has what it takes, parameters and a result with a text; the fields that it
lacks travel in these as JSON. A container that is to be loaded by this must import it too.
"""

from __future__ import annotations

import json
from typing import Any

from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParametersAtomically

_FIELDS = "/fields"  # no parameter of a node has a slash in front


def _request(base: type[Any]) -> type[Any]:
    class Request(base):  # type: ignore[misc]
        def __init__(self, *, parameters: Any = (), **fields: Any) -> None:
            text = ParameterValue(string_value=json.dumps(fields))
            super().__init__(parameters=[*parameters, Parameter(name=_FIELDS, value=text)])

    return Request


def fields_of(request: Any) -> dict[str, Any]:
    """Return the fields of a request as it was received, `parameters` among them."""
    *parameters, fields = request.parameters
    return {**json.loads(fields.value.string_value), "parameters": parameters}


def respond(response: Any, **fields: Any) -> Any:
    """Fill a response in."""
    response.result.reason = json.dumps(fields)
    return response


def _field(name: str) -> property:
    return property(lambda response: json.loads(response.result.reason)[name])


for _name in ("success", "error_message", "full_node_name", "unique_id"):
    setattr(SetParametersAtomically.Response, _name, _field(_name))


class LoadNode(SetParametersAtomically):
    """Load a plugin of a package as a node."""

    Request = _request(SetParametersAtomically.Request)


class UnloadNode(SetParametersAtomically):
    """Unload the node of a number."""

    Request = _request(SetParametersAtomically.Request)
