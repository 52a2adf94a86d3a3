"""The node interface (connect_to, map_to, disconnect, remap) and the data layer behind it.

Owns: which connection each declared endpoint is mapped onto, the order in which connections and
mappings are made and removed, when that is allowed, and what is notified of it: one implementation
behind the local API, the ROS services and the control channel.

*configure* declares endpoints, *connect* maps those that are not mapped yet onto the connection
that the plan says, *disconnect* takes everything away. In between `connect_to`, `map_to`,
`disconnect` and `remap` change single ones. See *Topological Discovery and Communication
Negotiation*, "Node Interface".

`serve_interface` offers it as ROS services: a request is a list of names and values, the answer
says of each whether it succeeded and why not:

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
from rclpy.task import Future

from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import Authority
from lifecycle.node.connections.connection_status import ConnectionEvent, ConnectionStatus
from lifecycle.node.connections.connections import (
    ConnectError,
    Connection,
    Connections,
    connections_of,
)
from lifecycle.node.endpoints.endpoint_table import EndpointTable
from lifecycle.node.endpoints.making import Maker
from lifecycle.node.endpoints.mapper import Mapper
from lifecycle.node.endpoints.mapping import Mapping
from lifecycle.node.lifecycle.machine import NodeState
from lifecycle.plan.model import (
    ParticipantConnections,
    PlannedEndpoint,
    PlannedNode,
    PlannedParticipant,
)

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup

    from lifecycle.node.lifecycle.gate import NodeGate
    from lifecycle.node.lifecycle.services import Turns

HandlerOf = Callable[[PlannedEndpoint], Callable[..., Any] | None]

CONFIGURED = frozenset(
    {
        NodeState.CONFIGURING,  # in on_configure everything is declared already
        NodeState.INACTIVE_DISCONNECTED,
        NodeState.CONNECTING,
        NodeState.INACTIVE_CONNECTED,
        NodeState.ACTIVATING_DISCONNECTED,
        NodeState.ACTIVATING_CONNECTED,
        NodeState.ACTIVE,
        NodeState.DEACTIVATING,
    }
)
"""Where endpoints are declared and not being taken away."""


class NotConfiguredError(LifecycleError):
    """The node interface was used in a state in which nothing is declared."""


class NodeDataLayer:
    """Declared endpoints of one node and their mapping onto connections.

    Args:
        node: whose endpoints these are.
        gate: holds back its publishers and subscriptions.
        turns: of the node's executor.
        state: of the node, now.
        changed: called when the node configuration has changed, match counts included.
        notify: called with each connection event.

    Attributes:
        endpoints: what is declared.
        connections: what endpoints may be mapped onto.
        status: which of them have peers.
        is_made: connect has made all of it.
    """

    def __init__(
        self,
        node: Node,
        gate: NodeGate,
        turns: Turns,
        *,
        state: Callable[[], NodeState],
        changed: Callable[[], None],
        notify: Callable[[ConnectionEvent], None],
    ) -> None:
        self._name = node.get_fully_qualified_name()
        self._state = state
        self._changed = changed
        self._maker = Maker(node, gate, turns)
        self._spec: PlannedNode | None = None  # before anything is declared
        self.is_made = False
        self.endpoints = EndpointTable(node, gate, changed)
        self.connections = Connections(node)
        self.status = ConnectionStatus(self.connections, self.endpoints.mappings, notify)
        self._mapper = Mapper(
            node,
            self._maker,
            self.endpoints,
            connections=self.connections,
            status=self.status,
            turns=turns,
        )

    @property
    def mappings(self) -> tuple[Mapping, ...]:
        """Every declared endpoint, in the order of declaration."""
        return tuple(self.endpoints.mappings.values())

    @property
    def entities(self) -> tuple[Any, ...]:
        """Every rclpy object of a declared endpoint."""
        return self._mapper.entities

    # Declarations.

    def declare(self, spec: PlannedNode, handler: HandlerOf) -> None:
        """Import every type and make the publishers' handles; no endpoint exists yet.

        Raises:
            LifecycleError: types that are not installed, all of them at once.
        """
        self._spec = spec
        problems: list[str] = []
        for endpoint in spec.endpoints:
            try:
                self.endpoints.add(endpoint, handler(endpoint))
            except LifecycleError as error:  # noqa: PERF203 - all of them at once
                problems.append(str(error))
        if problems:
            self.undeclare()
            raise LifecycleError("\n".join(problems))

    def add_now(self, endpoint: PlannedEndpoint, handler: Callable[..., Any] | None) -> None:
        """Declare one more endpoint, and map it if the others are mapped by the node itself.

        Raises:
            LifecycleError: declared already, its type is not installed, or it cannot be made.
        """
        mapping = self.endpoints.add(endpoint, handler)
        if not self.is_made or self._is_mapped_by_others:
            return
        try:
            self._mapper.map(mapping, self._default(endpoint))
        except BaseException:
            self.endpoints.remove(mapping)
            raise

    def undeclare(self) -> None:
        """Forget the declarations, and unmap what was mapped before a connect."""
        self.remove()
        for mapping in self.mappings:
            self.endpoints.remove(mapping)
        self._changed()

    # The transitions.

    def make(self, spec: PlannedNode) -> None:
        """Map every endpoint that is mapped nowhere onto what the plan says, or none.

        Under an authority nothing is mapped here: it must have been done.

        Raises:
            ConnectError: the first endpoint that could not be made, with the RMW's reason; or all
                that are not mapped.
        """
        for mapping in self.mappings:
            mapping.error = ""
        if self._is_mapped_by_others:
            self._refuse_unmapped()
        else:
            self._map_all(spec)
            self._changed()
        self.is_made = True

    def remove(self) -> None:
        """Remove every endpoint and every connection but the node's own participant."""
        for mapping in reversed(self.mappings):
            self._mapper.unmap(mapping)
            if mapping.handle is not None:
                mapping.handle.forget()
        for connection in reversed(self.connections.named):
            self._close(connection)
        self.connections.close_all()
        self.is_made = False
        self._changed()

    @property
    def _is_mapped_by_others(self) -> bool:
        return self._spec is not None and self._spec.authority is Authority.SUPERVISOR

    def _map_all(self, spec: PlannedNode) -> None:
        before = {mapping.key for mapping in self.mappings if mapping.placement}
        names_before = {each.name for each in self.connections.named}
        current: Mapping | None = None
        try:
            for planned in spec.participants:
                if planned.connection:
                    self.status.opened(self.connections.carrier(planned))
            for current in self.mappings:
                if current.placement is None:
                    self._mapper.map(current, self._default(current.endpoint))
        except Exception as error:
            for each in reversed(self.mappings):
                if each.placement is not None and each.key not in before:
                    self._mapper.unmap(each)
            for connection in self.connections.named:
                if connection.name not in names_before:
                    self._close(connection)
            if current is None:
                raise ConnectError(str(error)) from error
            endpoint = current.endpoint
            current.error = str(error)
            raise ConnectError(
                f"cannot connect {endpoint.kind.noun} {endpoint.name!r} of {spec.full_name}: "
                f"{error}"
            ) from error

    def _default(self, endpoint: PlannedEndpoint) -> Connection:
        """Return the connection that the plan says; make its participant at first use."""
        if not endpoint.participant or self._spec is None:
            return self.connections.own
        for planned in self._spec.participants:
            if planned.name == endpoint.participant:
                connection = self.connections.carrier(planned)
                if connection.warning and endpoint.enforce_dscp:
                    key = (endpoint.kind, endpoint.name)
                    self.endpoints.mappings[key].error = connection.warning
                return connection
        raise ConnectError(
            f"cannot find participant {endpoint.participant!r} in the plan of {self._name}"
        )

    def _own_flow(self, endpoint: PlannedEndpoint) -> Connection:
        """Return the participant that gives a publisher its own flow, or the node's own."""
        participants = self._spec.participants if self._spec else ()
        named = {each.name for each in participants if each.connection}
        return self.connections.own if endpoint.participant in named else self._default(endpoint)

    def _refuse_unmapped(self) -> None:
        missing = [each.spelling for each in self.mappings if each.placement is None]
        if missing:
            names = [repr(each.name) for each in self.connections.named]
            raise ConnectError(
                f"cannot connect {self._name}: nobody has mapped "
                f"{', '.join(map(repr, missing))}; its authority is the supervisor, which "
                f"connected it to {', '.join(names) or 'nothing'}",
                hint=f"call {self._name}/map_to for each, or write data_layer.authority: nodes",
            )

    def _close(self, connection: Connection) -> None:
        self.connections.close(connection)
        self.status.closed(connection)

    # The node interface.

    def connect_to(self, name: str, how: ParticipantConnections) -> Connection:
        """Make a connection, or return the one of that name and those URLs.

        Args:
            name: an empty one lets one be made up.
            how: at least one URL.

        Raises:
            ConnectError: it cannot be made; nothing is left but the report of it.
            NotConfiguredError: not in this state.
        """
        where = ", ".join(how.urls) or repr(name)
        self._refuse_unconfigured(f"connect {self._name} to {where}")
        name = name or self.connections.free_name()
        participants: tuple[PlannedParticipant, ...] = self._spec.participants if self._spec else ()
        planned = next((each for each in participants if each.connection == name), None)
        try:
            connection = self.connections.connect_to(name, how, planned)
        finally:
            self._changed()
        self.status.opened(connection)
        return connection

    def map_to(self, spelling: str, connection: Connection | str) -> Future:
        """Map an endpoint onto a connection, or hand it over from the one that it is on.

        Args:
            spelling: `video` or `publishers/video`.
            connection: what `connect_to` returned, or its name; the empty name is where the plan
                would have it: the node's own participant, or the one that gives a publisher its
                own flow.

        Returns:
            Done once the endpoint is on the new connection alone; it may be ignored.

        Raises:
            UnknownEndpointError: no such declaration.
            UnknownConnectionError: no such connection.
            ConnectError: it cannot be made there; where it was it still is.
            NotConfiguredError: not in this state.
        """
        self._refuse_unconfigured(f"map {spelling!r} of {self._name}")
        mapping = self.endpoints.find(spelling)
        target = self.connections.find(connection)
        noun = mapping.endpoint.kind.noun
        try:
            if target is self.connections.own:
                target = self._own_flow(mapping.endpoint)
            return self._mapper.move(mapping, target)
        except LifecycleError as error:
            message = (
                f"cannot map {noun} {mapping.endpoint.name!r} of {self._name} to "
                f"{target.name!r}: {error.message}"
            )
            if mapping.placement is None:
                mapping.error = message
            raise ConnectError(message, hint=error.hint) from error
        finally:
            self._mapper.tidy()
            self._changed()

    def disconnect(self, connection: Connection | str) -> None:
        """Unmake a connection; what was mapped onto it is then mapped nowhere.

        Raises:
            UnknownConnectionError: no such connection.
            ConnectError: it is the node's own participant.
            NotConfiguredError: not in this state.
        """
        name = connection if isinstance(connection, str) else connection.name
        self._refuse_unconfigured(f"disconnect {self._name} from {name!r}")
        if self.connections.forget(name):
            self._changed()
            return
        found = self.connections.find(connection)
        if found is self.connections.own:
            raise ConnectError(
                f"cannot disconnect {self._name} from its own participant: its services are on it",
                hint="map its endpoints onto another connection, or take transition 'disconnect'",
            )
        for mapping in self.mappings:
            self._mapper.take_off(mapping, found)
        self._close(found)
        self._changed()

    def remap(self, spelling: str, name: str) -> None:
        """Call an endpoint otherwise from now on; an empty name gives it its declared one again.

        Raises:
            UnknownEndpointError: no such declaration.
            LifecycleError: not a name, or the endpoint cannot be made so; it is as it was.
            NotConfiguredError: not in this state.
        """
        self._refuse_unconfigured(f"remap {spelling!r} of {self._name}")
        mapping = self.endpoints.find(spelling)
        expanded = self._maker.expand(mapping.endpoint, name) if name else ""
        self._mapper.rename(mapping, expanded)

    def _refuse_unconfigured(self, what: str) -> None:
        state = self._state()
        if state not in CONFIGURED:
            raise NotConfiguredError(
                f"cannot {what}: it is {state.value!r}",
                hint="endpoints are declared from configure until cleanup; configure it first",
            )


def serve_interface(
    node: Node, interface: NodeDataLayer, group: CallbackGroup, *names: str
) -> None:
    """Serve a node's interface.

    Args:
        node: that has it.
        interface: does it.
        group: reentrant, so that others can ask while a transition runs or a handover lasts.
        names: of the services; all of them if left out.
    """

    def connect_to(asked: Parameter) -> None:
        interface.connect_to(asked.name, connections_of(_texts(asked, "a URL or several")))

    def map_to(asked: Parameter) -> Future:
        return interface.map_to(asked.name, _text(asked, "the connection's name"))

    def disconnect(asked: Parameter) -> None:
        interface.disconnect(asked.name)

    def remap(asked: Parameter) -> None:
        interface.remap(asked.name, _text(asked, "the new name"))

    log = node.get_logger().error
    for act in (connect_to, map_to, disconnect, remap):
        if not names or act.__name__ in names:
            Node.create_service(
                node, SetParameters, f"~/{act.__name__}", _serving(act, log), callback_group=group
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
