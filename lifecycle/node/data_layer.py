"""The data layer of a node: what it declares, and which connection each of it is mapped onto.

*configure* imports what is declared, *connect* maps what is not mapped yet onto the connection
that the plan says, *disconnect* takes everything away. In between `connect_to`, `map_to`,
`disconnect` and `remap` change single ones, asked by the node's code, by a ROS service or by the
control channel: "Node Interface" of *Topological Discovery and Communication Negotiation*.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from rclpy.duration import Duration
from rclpy.task import Future

from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import Authority, EndpointKind, EndpointPolicy
from lifecycle.middleware.rcl.conversions import import_interface
from lifecycle.middleware.rcl.graph_queries import watch_server
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.node.connections import ConnectError, Connection, Connections
from lifecycle.node.endpoint import (
    CLIENTS,
    Endpoint,
    Handover,
    Placement,
    count_peers,
    expand,
    find_endpoint,
    make_entity,
    unmake,
    watch_matches,
)
from lifecycle.node.gate import DeclaredPublisher, Kept
from lifecycle.node.handlers import Key, needs_handler
from lifecycle.node.machine import NodeState
from lifecycle.plan.model import ParticipantConnections, PlannedEndpoint

if TYPE_CHECKING:
    from lifecycle.node.managed import Managed

_CONFIGURED = ("configuring", "inactive", "activating", "active", "deactivating")
"""Where endpoints are declared (in on_configure they are already) and not being taken away."""

_DECLARING = {
    EndpointKind.SUBSCRIPTION: "declare_subscription",
    EndpointKind.SERVICE_SERVER: "declare_service",
    EndpointKind.ACTION_SERVER: "declare_action",
}
"""Those that take a handler."""

_ACKNOWLEDGED = Duration(seconds=0.1)
"""How long a reliable publisher that is handed over is waited for; on one network a millisecond."""


SETTLE_S = 0.25
"""An old endpoint lives on after the new one has matched as many peers as it had: a match that is
seen here does not prove that the other side has seen it."""

PATIENCE_S = 4.0
"""Both live at most so long, if the new one never matches as many.

A participant that others have not noticed at once is announced again after 3 s.
"""


class NotConfiguredError(LifecycleError):
    """The node interface was used in a state in which nothing is declared."""


class DataLayer:
    """Declared endpoints of one node and their mapping onto connections.

    Attributes:
        endpoints: from configure to cleanup every declared endpoint, in the order of declaration.
        connections: what endpoints may be mapped onto.
        is_made: connect has made all of it, or found it made by the authority.
    """

    def __init__(self, managed: Managed) -> None:
        self._managed = managed
        self._node = managed.node
        self._name = managed.full_name
        spec = self._spec = managed.spec
        self._gate = managed.gate
        self._turns = managed.turns
        self._changed = managed.configuration_changes.touch
        self._declared = {(each.kind, each.name): Endpoint(planned=each) for each in spec.endpoints}
        self.endpoints: dict[Key, Endpoint] = {}
        self.connections = Connections(self._node, spec.participants)
        self.is_made = False

    # What is declared.

    def declare(self, planned: PlannedEndpoint, callback: Callable[..., Any] | None) -> Endpoint:
        """Have one more endpoint, made at once where the others are.

        What a manifest says of the same name is kept. The same may be declared again: on_activate
        runs more than once. Raises LifecycleError.
        """
        is_early = self._managed.state is NodeState.UNCONFIGURED
        if not is_early:
            self._refuse_late(planned)
        endpoint = self._declared.get((planned.kind, planned.name))
        if endpoint is not None:
            if endpoint.planned.type != planned.type:
                raise LifecycleError(
                    f"cannot declare {endpoint.spelling} of {self._name} as {planned.type}: "
                    f"it is declared as {endpoint.planned.type} already"
                )
        else:
            endpoint = Endpoint(planned=planned, callback=callback, is_late=not is_early)
            if not is_early:
                self._add_late(endpoint)
            self._declared[endpoint.key] = endpoint
        if is_early and callback is not None:
            endpoint.callback = callback
        return endpoint

    def _refuse_late(self, planned: PlannedEndpoint) -> None:
        state = self._managed.state
        what = (
            f"cannot declare {planned.kind.noun} {planned.name!r} while {self._name} is "
            f"{state.value!r}"
        )
        if state.seen.label not in _CONFIGURED:
            raise LifecycleError(
                what, hint="declare endpoints in __init__, or from on_configure until cleanup"
            )
        if self._spec.endpoint_policy is EndpointPolicy.DECLARED:
            raise LifecycleError(
                f"{what}: nodes.{self._spec.key}.endpoints is 'declared' in its manifest, which "
                "fixes them at configure",
                hint=f"write nodes.{self._spec.key}.endpoints: open, or declare it in the manifest",
            )

    def _add_late(self, endpoint: Endpoint) -> None:
        """Add what is declared after configure; map it if the others are mapped by the node."""
        kind, name = endpoint.key
        if endpoint.callback is None and needs_handler(kind):
            raise LifecycleError(
                f"cannot serve {kind.noun} {name!r} of {self._name} that is "
                "declared after configure: it has no handler",
                hint=f"give one, {_DECLARING[kind]}({name!r}, …, callback=…)",
            )
        self._prepare(endpoint, endpoint.callback)
        if not self.is_made or self._is_mapped_by_others:
            return
        try:
            self._move(endpoint, self.connections.planned(endpoint.planned.participant))
        except BaseException:
            self._forget(endpoint)
            raise

    def set_options(self, spelling: str, options: dict[str, Any]) -> None:
        """Keep how an endpoint is to be made: LifecycleNode.set_options."""
        endpoint = self.find(spelling)
        if endpoint.placement is not None:
            raise LifecycleError(
                f"cannot set options of {endpoint.spelling} of {self._name}: it exists already",
                hint="call set_options in __init__ or in on_configure",
            )
        endpoint.options = options

    def find(self, spelling: str) -> Endpoint:
        """Return the endpoint `video`, or `publishers/video`; raises UnknownEndpointError."""
        is_early = self._managed.state is NodeState.UNCONFIGURED
        declared = self._declared if is_early else self.endpoints
        return declared[find_endpoint(spelling, declared, node=self._name)]

    def declared(self, kind: EndpointKind, name: str) -> Endpoint:
        """Return a declared endpoint, from configure on; raises UnknownEndpointError."""
        return self.endpoints[find_endpoint(kind.spell(name), self.endpoints, node=self._name)]

    def entity(self, kind: EndpointKind, name: str) -> Any:
        """Return the rclpy object of a declared endpoint: LifecycleNode.client."""
        entity = self.declared(kind, name).entity
        if entity is None:
            raise LifecycleError(
                f"cannot use {kind.noun} {name!r}: {self._name} is not connected; "
                "endpoints exist from connect until disconnect"
            )
        return entity

    # The transitions.

    @property
    def unhandled(self) -> tuple[PlannedEndpoint, ...]:
        """What is declared without a handler in code."""
        return tuple(e.planned for e in self._declared.values() if e.callback is None)

    def prepare(self, handlers: Mapping[Key, Callable[..., Any]]) -> None:
        """Import every type and make the publishers' handles; no endpoint exists yet.

        Handlers are those of what has none in code. Raises LifecycleError with every type that is
        not installed.
        """
        problems: list[str] = []
        for endpoint in self._declared.values():
            try:
                self._prepare(endpoint, endpoint.callback or handlers.get(endpoint.key))
            except LifecycleError as error:  # noqa: PERF203 - all of them are said
                problems.append(str(error))
        if problems:
            self.unprepare()
            raise LifecycleError("\n".join(problems))

    def unprepare(self) -> None:
        """Undo `prepare`, unmap what was mapped before a connect, and forget what came later."""
        self.remove()
        for endpoint in tuple(self.endpoints.values()):
            self._forget(endpoint)
            endpoint.error = endpoint.fault = endpoint.given_name = ""
            if endpoint.is_late:
                del self._declared[endpoint.key]
        self._changed()

    def _prepare(self, endpoint: Endpoint, handler: Callable[..., Any] | None) -> None:
        planned = endpoint.planned
        try:
            endpoint.interface = import_interface(planned.type)
        except LifecycleError as error:
            raise LifecycleError(f"{planned.kind.noun} {planned.name!r}: {error}") from error
        endpoint.handler = handler
        self.endpoints[endpoint.key] = endpoint
        if planned.kind is EndpointKind.PUBLISHER:
            warn = self._managed.log.warning
            endpoint.handle = DeclaredPublisher(planned.name, warn, Kept.of(planned.qos))
            self._gate.add(endpoint.handle, endpoint.handle)
        self._changed()

    def _forget(self, endpoint: Endpoint) -> None:
        del self.endpoints[endpoint.key]
        if endpoint.handle is not None:
            self._gate.remove(endpoint.handle)
            endpoint.handle = None

    def make(self) -> None:
        """Map every endpoint that is mapped nowhere onto what the plan says, or none.

        Raises ConnectError with the RMW's reason; or, under an authority that maps them, with all
        that are not mapped.
        """
        for endpoint in self.endpoints.values():
            endpoint.error = ""
        if self._is_mapped_by_others:
            self._refuse_unmapped()
        else:
            self._map_all()
            self._changed()
        self.is_made = True

    def undo(self) -> None:
        """Undo `make`, if it has made all of it."""
        if self.is_made:
            self.remove()

    def remove(self) -> None:
        """Remove every endpoint and every connection but the node's own participant."""
        for endpoint in reversed(self.endpoints.values()):
            self._unmap(endpoint)
            if endpoint.handle is not None:
                endpoint.handle.forget()
        self.connections.close_all()
        self.is_made = False
        self._changed()

    @property
    def _is_mapped_by_others(self) -> bool:
        return self._spec.authority is Authority.SUPERVISOR

    def _map_all(self) -> None:
        before = [each for each in self.endpoints.values() if each.placement]
        connected_before = self.connections.named
        current: Endpoint | None = None
        try:
            for planned in self._spec.participants:
                if planned.connection:
                    self.connections.planned(planned.name)
            for current in self.endpoints.values():
                if current.placement is None:
                    self._move(current, self.connections.planned(current.planned.participant))
        except Exception as error:
            for each in reversed(self.endpoints.values()):
                if each not in before:
                    self._unmap(each)
            for connection in self.connections.named:
                if connection not in connected_before:
                    self.connections.close(connection)
            if current is None:
                raise ConnectError(str(error)) from error
            current.error = str(error)
            raise ConnectError(
                f"cannot connect {current.kind.noun} {current.name!r} of {self._name}: {error}"
            ) from error

    def _refuse_unmapped(self) -> None:
        missing = [each.spelling for each in self.endpoints.values() if each.placement is None]
        if missing:
            names = [repr(each.name) for each in self.connections.named]
            raise ConnectError(
                f"cannot connect {self._name}: nobody has mapped "
                f"{', '.join(map(repr, missing))}; its authority is the supervisor, which "
                f"connected it to {', '.join(names) or 'nothing'}",
                hint=f"call {self._name}/map_to for each, or write data_layer.authority: nodes",
            )

    # The node interface.

    def connect_to(self, name: str, how: ParticipantConnections) -> Connection:
        """Make a connection, or return the present one: LifecycleNode.connect_to."""
        self._refuse_unconfigured(f"connect {self._name} to {', '.join(how.urls) or repr(name)}")
        taken = {each.name for each in self.connections.named}
        name = name or next(
            made for made in map("connection_{}".format, itertools.count(1)) if made not in taken
        )
        try:
            return self.connections.connect_to(name, how)
        finally:
            self._changed()

    def map_to(self, spelling: str, connection: Connection | str) -> Future:
        """Map an endpoint, or hand it over from where it is: LifecycleNode.map_to.

        The empty name is where the plan would have it: the node's own participant, or the one that
        gives a publisher its own flow.
        """
        self._refuse_unconfigured(f"map {spelling!r} of {self._name}")
        endpoint = self.find(spelling)
        target = self.connections.find(connection)
        try:
            planned = endpoint.planned.participant
            if target is self.connections.own and not self.connections.is_named(planned):
                target = self.connections.planned(planned)
            if endpoint.connection is target:
                return endpoint.handover.done if endpoint.handover is not None else _done()
            return self._move(endpoint, target)
        except LifecycleError as error:
            message = (
                f"cannot map {endpoint.kind.noun} {endpoint.name!r} of {self._name} to "
                f"{target.name!r}: {error.message}"
            )
            if endpoint.placement is None:
                endpoint.error = message
            raise ConnectError(message, hint=error.hint) from error
        finally:
            self._tidy()
            self._changed()

    def disconnect(self, connection: Connection | str) -> None:
        """Unmake a connection: LifecycleNode.disconnect."""
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
        for endpoint in self.endpoints.values():
            handover = endpoint.handover
            if handover and handover.old and handover.old.connection is found:
                self._end_handover(endpoint)
            if endpoint.connection is found:
                self._unmap(endpoint)
        self.connections.close(found)
        self._changed()

    def remap(self, spelling: str, name: str) -> None:
        """Make an endpoint anew under another name, where it is: LifecycleNode.remap."""
        self._refuse_unconfigured(f"remap {spelling!r} of {self._name}")
        endpoint = self.find(spelling)
        before = endpoint.given_name
        expanded = expand(self._managed, endpoint, name) if name else ""
        if expanded == before:
            return
        endpoint.given_name = expanded
        if endpoint.connection is not None:
            try:
                self._move(endpoint, endpoint.connection, at_once=True)
            except BaseException:
                endpoint.given_name = before
                raise
        self._changed()

    def _refuse_unconfigured(self, what: str) -> None:
        state = self._managed.state
        if state.seen.label not in _CONFIGURED:
            raise NotConfiguredError(
                f"cannot {what}: it is {state.value!r}",
                hint="endpoints are declared from configure until cleanup; configure it first",
            )

    # Single endpoints.

    def _unmap(self, endpoint: Endpoint) -> None:
        """Take an endpoint off where it is; harmless if it is nowhere."""
        self._end_handover(endpoint)
        placement = endpoint.placement
        if placement is None:
            return
        if endpoint.handle is not None:
            endpoint.handle.detach()
        endpoint.placement = None
        self._unplace(endpoint, placement)

    def _move(self, endpoint: Endpoint, connection: Connection, *, at_once: bool = False) -> Future:
        """Make an endpoint on a connection, before it breaks where it was; done once it has."""
        self._end_handover(endpoint)
        old, peers = endpoint.placement, _peers(endpoint)
        endpoint.placement, endpoint.error = self._place(endpoint, connection), ""
        handover = endpoint.handover = Handover(old=old, peers=peers or 1)
        # Two servers would both answer; and a client's answers may still be under way.
        lives_on = peers > 0 if endpoint.kind.is_topic else endpoint.kind in CLIENTS
        if old is None or at_once or not lives_on or self._node.executor is None:
            self._end_handover(endpoint)
        else:
            self._end_handover_in(PATIENCE_S, endpoint, handover)
            self._matched(endpoint)
        return handover.done

    def _end_handover_in(self, delay_s: float, endpoint: Endpoint, handover: Handover) -> None:
        def end() -> None:
            if endpoint.handover is handover:
                self._end_handover(endpoint)

        self._turns.call_after(delay_s, end)

    def _end_handover(self, endpoint: Endpoint) -> None:
        """Have an endpoint where it is mapped, and there alone; harmless if it is."""
        handover, endpoint.handover = endpoint.handover, None
        if handover is None:
            return
        old, qos = handover.old, endpoint.planned.qos
        if endpoint.handle is not None:
            if old is not None and (qos is None or qos.reliability.name != "BEST_EFFORT"):
                old.entity.wait_for_all_acked(_ACKNOWLEDGED)
            endpoint.handle.attach(endpoint.entity)
        if old is not None:
            self._unplace(endpoint, old)
            self._tidy()
        self._changed()
        handover.done.set_result(None)

    def _place(self, endpoint: Endpoint, connection: Connection) -> Placement:
        """Make an endpoint on a connection; where it is now is left alone."""
        self._refuse_shared_flow(endpoint, connection)
        entity = make_entity(self._managed, endpoint, connection)
        unwatch: Callable[[], None] | None = None
        if endpoint.kind.is_topic:
            unwatch = watch_matches(
                self._node, entity, self._turns.group, lambda: self._matched(endpoint)
            )
        elif endpoint.kind in CLIENTS:  # their peers are not counted
            unwatch = watch_server(connection.node or self._node, entity, self._changed)
        return Placement(connection=connection, entity=entity, unwatch=unwatch)

    def _unplace(self, endpoint: Endpoint, placement: Placement) -> None:
        if placement.unwatch is not None:
            placement.unwatch()
        unmake(self._managed, endpoint.kind, placement.entity, placement.connection)

    def _matched(self, endpoint: Endpoint) -> None:
        """Some entity of an endpoint has been matched or unmatched."""
        handover = endpoint.handover
        if handover is not None and _peers(endpoint) >= handover.peers:
            self._end_handover_in(SETTLE_S, endpoint, handover)
        self._changed()  # as many peers as before may be others

    def _tidy(self) -> None:
        places = [each.placement for each in self.endpoints.values()]
        places += [each.handover.old for each in self.endpoints.values() if each.handover]
        self.connections.close_unused([each.connection for each in places if each])

    def _refuse_shared_flow(self, endpoint: Endpoint, connection: Connection) -> None:
        """Keep a strictly unique publisher alone: a participant's publishers share its sockets."""
        if endpoint.kind is not EndpointKind.PUBLISHER:
            return
        there = [e for e in self.endpoints.values() if e is endpoint or e.connection is connection]
        there = [each for each in there if each.kind is EndpointKind.PUBLISHER]
        strict = UniqueRequirement.STRICTLY_REQUIRED
        alone = next((each for each in there if each.planned.unique is strict), None)
        if alone is not None and (len(there) > 1 or connection.participant is None):
            raise ConnectError(
                f"publisher {alone.name!r} must have a network flow for itself "
                "(strictly_required), and would share one",
                hint="give it a connection of its own",
            )


def _peers(endpoint: Endpoint) -> int:
    """Return how many peers an endpoint has where it is now; 0 of what has no count."""
    return count_peers(endpoint.entity) if endpoint.kind.is_topic and endpoint.placement else 0


def _done() -> Future:
    done: Future = Future()
    done.set_result(None)
    return done
