"""The node interface as ROS services: connect_to, map_to, disconnect, remap, alias from outside.

Owns: translation between rcl_interfaces/srv/SetParameters and data_layer.py, nothing else. A
request is a list of names and values, the answer says of each whether it succeeded and why not:

    ros2 service call /camera/connect_to rcl_interfaces/srv/SetParameters \
        "{parameters: [{name: net, value: {type: 4, string_value: 'udpv4://10.77.0.1:7911'}}]}"
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue, SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node

from lifecycle.errors import LifecycleError
from lifecycle.node.connections.connections import connections_of
from lifecycle.node.connections.data_layer import NodeInterface

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup


class RemoteInterface:
    """Serves one node's interface.

    Args:
        node: that has it.
        interface: does it.
        log: called with a fault of ours and its traceback.
        group: reentrant, so that others can ask while a transition runs or a handover lasts.
    """

    def __init__(
        self,
        node: Node,
        interface: NodeInterface,
        *,
        log: Callable[[str], None],
        group: CallbackGroup,
    ) -> None:
        self._interface = interface
        self._log = log
        for name, act in (
            ("connect_to", self._connect_to),
            ("map_to", self._map_to),
            ("disconnect", self._disconnect),
            ("remap", self._remap),
            ("alias", self._alias),
        ):
            Node.create_service(
                node, SetParameters, f"~/{name}", self._served(act), callback_group=group
            )

    def _served(self, act: Callable[[Parameter], Any]) -> Callable[[Any, Any], Any]:
        async def serve(
            request: SetParameters.Request, response: SetParameters.Response
        ) -> SetParameters.Response:
            # All are begun before any is waited for: handovers then last as long as one.
            begun = [self._try(act, each) for each in request.parameters]
            for result, lasting in begun:
                if lasting is not None:
                    await lasting
                response.results.append(result)
            return response

        return serve

    def _try(
        self, act: Callable[[Parameter], Any], parameter: Parameter
    ) -> tuple[SetParametersResult, Any]:
        try:
            return SetParametersResult(successful=True), act(parameter)
        except LifecycleError as error:
            return SetParametersResult(successful=False, reason=str(error)), None
        except Exception as error:  # noqa: BLE001 - asking must not end the node
            self._log(traceback.format_exc())
            reason = f"cannot do this: {error!r}"
            return SetParametersResult(successful=False, reason=reason), None

    def _connect_to(self, parameter: Parameter) -> None:
        urls = _texts(parameter, "a URL or several")
        self._interface.connect_to(parameter.name, connections_of(urls))

    def _map_to(self, parameter: Parameter) -> Any:
        return self._interface.map_to(parameter.name, _text(parameter, "the connection's name"))

    def _disconnect(self, parameter: Parameter) -> None:
        self._interface.disconnect(parameter.name)

    def _remap(self, parameter: Parameter) -> None:
        self._interface.remap(parameter.name, _text(parameter, "the new name"))

    def _alias(self, parameter: Parameter) -> None:
        self._interface.alias(parameter.name, _texts(parameter, "the further names"))


def _text(parameter: Parameter, what: str) -> str:
    value: ParameterValue = parameter.value
    if value.type != ParameterType.PARAMETER_STRING:
        raise LifecycleError(
            f"cannot use the value given for {parameter.name!r}: {what} is a string, type "
            f"{ParameterType.PARAMETER_STRING}, not type {value.type}",
            hint="write {type: 4, string_value: '…'}",
        )
    return str(value.string_value)


def _texts(parameter: Parameter, what: str) -> Sequence[str]:
    value: ParameterValue = parameter.value
    if value.type == ParameterType.PARAMETER_STRING:
        return (str(value.string_value),)
    if value.type == ParameterType.PARAMETER_STRING_ARRAY:
        return tuple(value.string_array_value)
    raise LifecycleError(
        f"cannot use the value given for {parameter.name!r}: {what} is a string or an array of "
        f"strings, type {ParameterType.PARAMETER_STRING} or {ParameterType.PARAMETER_STRING_ARRAY},"
        f" not type {value.type}",
        hint="write {type: 4, string_value: '…'} or {type: 9, string_array_value: ['…']}",
    )
