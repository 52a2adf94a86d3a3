"""The node interface as ROS services: connect_to, map_to, disconnect and remap.

A request is a list of names and values, the answer says of each whether it succeeded and why not:

    ros2 service call /camera/connect_to rcl_interfaces/srv/SetParameters \
        "{parameters: [{name: net, value: {type: 4, string_value: 'udpv4://10.77.0.1:7911'}}]}"
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue, SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node

from lifecycle.errors import LifecycleError
from lifecycle.node.connections.connections import connections_of

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup

    from lifecycle.node.endpoints.data_layer import DataLayer

Acts = Mapping[str, Callable[[Parameter], Any]]
"""By name of the service: does one of the things that a request asks for; may return a future."""


def acts_of(data_layer: DataLayer) -> Acts:
    """Return what the services of one of our nodes do."""

    def connect_to(asked: Parameter) -> None:
        data_layer.connect_to(asked.name, connections_of(_texts(asked, "a URL or several")))

    return {
        "connect_to": connect_to,
        "map_to": lambda asked: data_layer.map_to(
            asked.name, _text(asked, "the connection's name")
        ),
        "disconnect": lambda asked: data_layer.disconnect(asked.name),
        "remap": lambda asked: data_layer.remap(asked.name, _text(asked, "the new name")),
    }


def serve_interface(node: Node, acts: Acts, group: CallbackGroup) -> None:
    """Serve a node's interface.

    Args:
        node: that has it.
        acts: what its services do.
        group: reentrant, so that others can ask while a transition runs or a handover lasts.
    """
    log = node.get_logger().error
    for name, act in acts.items():
        Node.create_service(
            node, SetParameters, f"~/{name}", _serving(act, log), callback_group=group
        )


def _serving(
    act: Callable[[Parameter], Any], log: Callable[[str], object]
) -> Callable[[Any, Any], Any]:
    """Return what answers a request for several things at once."""

    def begin(asked: Parameter) -> tuple[SetParametersResult, Any]:
        try:
            return SetParametersResult(successful=True), act(asked)
        except LifecycleError as error:
            return SetParametersResult(successful=False, reason=str(error)), None
        except Exception as error:  # noqa: BLE001 - asking must not end the node
            log(traceback.format_exc())
            reason = f"cannot do this: {error!r}"
            return SetParametersResult(successful=False, reason=reason), None

    async def serve(
        request: SetParameters.Request, response: SetParameters.Response
    ) -> SetParameters.Response:
        # All are begun before any is waited for: handovers then last as long as one.
        for result, lasting in [begin(each) for each in request.parameters]:
            if lasting is not None:
                await lasting
            response.results.append(result)
        return response

    return serve


def _text(parameter: Parameter, what: str) -> str:
    (text,) = _texts(parameter, what, several=False)
    return text


def _texts(parameter: Parameter, what: str, *, several: bool = True) -> Sequence[str]:
    value: ParameterValue = parameter.value
    one, many = ParameterType.PARAMETER_STRING, ParameterType.PARAMETER_STRING_ARRAY
    if value.type == one:
        return (str(value.string_value),)
    if several and value.type == many:
        return tuple(value.string_array_value)
    wanted, hint = f"a string, type {one}", "write {type: 4, string_value: '…'}"
    if several:
        wanted = f"a string or an array of strings, type {one} or {many}"
        hint += " or {type: 9, string_array_value: ['…']}"
    raise LifecycleError(
        f"cannot use the value given for {parameter.name!r}: {what} is {wanted}, not type "
        f"{value.type}",
        hint=hint,
    )
