"""The supervisor's participant: its eyes on the graph and its hands on nodes that are not ours.

Owns: making and destroying them in the right order; rclpy is imported here, late, and nowhere else
in this room.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from lifecycle.plan.model import ParticipantConnections, Plan, PlannedNode
from lifecycle.supervisor.health.peer_supervisors import Listener
from lifecycle.supervisor.nodes.driver import NodeDriver, ServiceDriver, ServiceHand
from lifecycle.verify.observation import NodeConfiguration, Observation

if TYPE_CHECKING:
    from lifecycle.graph import DdsTransport, Observer
    from lifecycle.middleware.discovery.liveliness import AlivePublisher, AliveSubscription
    from lifecycle.middleware.discovery.plan_notices import PlanNotices
    from lifecycle.middleware.rcl.graph import GraphObserver
    from lifecycle.middleware.services.clients import NodeClients

_logger = logging.getLogger(__name__)

_QUIET_S = 0.005
_BURST_S = 0.05
"""Shorter than an observer's own: bring-up is a race, and a look costs a few milliseconds."""


class ObserverParticipant:
    """What a supervisor sees and reaches of one domain. `destroy` it, or use it in a `with`."""

    def __init__(self, observer: Observer, clients: NodeClients, graph: GraphObserver) -> None:
        self._observer = observer
        self._clients = clients
        self._graph = graph
        self._transport: DdsTransport | None = None

    @classmethod
    def open(
        cls,
        domain_id: int,
        connections: ParticipantConnections = ParticipantConnections(),
        *,
        guests: bool = False,
        events: bool = False,
    ) -> ObserverParticipant:
        """Make the participant; before any process, so that each is discovered at once.

        Args:
            domain_id: 0–232.
            connections: how it is connected; by default as the RMW likes.
            guests: also read the configurations of nodes that are not planned.
            events: listen to what nodes tell the graph, and look again at those that changed.

        Raises:
            MiddlewareError: it cannot be made.
        """
        from lifecycle.graph import Observer
        from lifecycle.middleware import GraphObserver, NodeClients

        graph = GraphObserver(domain_id, connections)
        clients = NodeClients(graph)
        observer = Observer(graph, clients, quiet_s=_QUIET_S, burst_s=_BURST_S, guests=guests)
        observer_participant = cls(observer, clients, graph)
        if events:
            observer_participant._listen()
        return observer_participant

    @property
    def rmw(self) -> str:
        """Name of the RMW implementation."""
        import rclpy

        return str(rclpy.get_rmw_implementation_identifier())

    def reaches_servers(self) -> bool:
        """Wait, bounded, until a TCP discovery server can be asked; False if it never will be."""
        return self._graph.reaches_servers()

    def driver(self, node: PlannedNode) -> NodeDriver:
        """Return the driver of a managed node that is not hosted by us."""
        return ServiceDriver(self._clients, node)

    def hand(self, node: str) -> ServiceHand:
        """Return the hand on any node that has a node interface, by full name."""
        return ServiceHand(self._clients, node)

    async def observe(self, plan: Plan) -> Observation:
        """Return what is there now."""
        return await self._observer.observe(plan)

    @property
    def changes(self) -> int:
        """Changes so far, before their bursts have passed."""
        return self._observer.changes

    async def wait_change(self) -> None:
        """Wait until something changed."""
        await self._observer.wait_change()

    def put_configuration(self, configuration: NodeConfiguration) -> None:
        """Give what a node reported over its control channel."""
        self._observer.put_configuration(configuration)

    def drop_configuration(self, node: str) -> None:
        """Forget what a node reported whose process ended."""
        self._observer.drop_configuration(node)

    def participants_of(
        self, pid: int, *, nodes: Iterable[str], reported: Iterable[str]
    ) -> frozenset[str]:
        """Return the GUID prefixes of the participants that discovery shows of a process."""
        return self._graph.participants_of(pid, nodes=nodes, reported=reported)

    def remove_participants(self, prefixes: Iterable[str], pids: Iterable[int]) -> None:
        """Have everybody forget participants whose process is dead."""
        self._graph.remove_participants(prefixes, pids)

    def machine_voice(self, system: str, machine: str) -> AlivePublisher:
        """Be heard as the supervisor of a machine."""
        from lifecycle.middleware.discovery.liveliness import AlivePublisher, machine_topic

        return AlivePublisher(self._graph.node, machine_topic(system, machine))

    def machine_ear(self, system: str, machine: str, to: Listener) -> AliveSubscription:
        """Hear the supervisor of a machine."""
        from lifecycle.middleware.discovery.liveliness import machine_topic

        return self._ear(machine_topic(system, machine), to)

    def node_ear(self, node: str, to: Listener) -> AliveSubscription:
        """Hear a node that somebody runs by itself."""
        from lifecycle.middleware.discovery.liveliness import node_topic

        return self._ear(node_topic(node), to)

    def plan_notices(self, on_notice: Callable[[str], None]) -> PlanNotices:
        """Take part in the exchange of plans."""
        from lifecycle.middleware.discovery.plan_notices import PlanNotices

        return PlanNotices(self._graph.node, on_notice)

    def call_out(self, addresses: Iterable[str]) -> None:
        """Make everybody announce themselves, as far as the system's discovery allows."""
        from lifecycle.middleware.discovery.rediscovery import call_out

        call_out(self._graph.domain_id, self._graph.urls, addresses, os.environ)

    def send_again_soon(self) -> None:
        """Have what waits for a link to come back be sent soon when it does."""
        from lifecycle.middleware.discovery.rediscovery import send_again_soon

        send_again_soon()

    def tell_names(self) -> None:
        """Tell the graph anew that we are here."""
        from lifecycle.middleware.discovery.rediscovery import tell_names

        tell_names([self._graph.node])

    def _ear(self, topic: str, to: Listener) -> AliveSubscription:
        from lifecycle.middleware.discovery.liveliness import AliveSubscription

        return AliveSubscription(
            self._graph.node, topic, on_heard=to.heard, on_left=to.left, on_told=to.told
        )

    def _listen(self) -> None:
        """Take what nodes tell the graph as a reason to look again."""
        from lifecycle.graph import DdsTransport, GraphMessageError, Heartbeat, decode

        def arrived(data: bytes) -> None:
            try:
                message = decode(data)
            except GraphMessageError as error:
                _logger.info("passed over: %s", error)
                return
            checksum = message.checksum if isinstance(message, Heartbeat) else ""
            self._observer.hear(message.node, checksum)

        self._transport = DdsTransport(self._graph.node)
        self._transport.receive(arrived)

    def prepare_to_leave(self) -> None:
        """Let go of connections that nobody answers: whatever is sent would wait for their ends."""
        from lifecycle.middleware.discovery.dead_peers import give_up_dead_connections

        give_up_dead_connections()

    def destroy(self) -> None:
        """Leave the graph."""
        if self._transport is not None:
            self._transport.close()
        self._observer.destroy()

    def __enter__(self) -> ObserverParticipant:  # noqa: PYI034 - typing.Self is not in Python 3.10
        return self

    def __exit__(self, *_: object) -> None:
        self.destroy()
