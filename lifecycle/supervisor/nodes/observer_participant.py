"""The supervisor's participant: it observes the graph, and other supervisors see it.

Owns: one `lifecycle.graph.Graph` and what else is on its participant. It imports rclpy: elsewhere
in this room it is imported late, where a participant is made.
"""

from __future__ import annotations

import asyncio
import functools
import os
import shlex
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import rclpy

from lifecycle.errors import MiddlewareError
from lifecycle.graph.graph import Graph
from lifecycle.middleware.fastdds.factory import unknown_versions
from lifecycle.middleware.fastdds.participant import republish_names
from lifecycle.middleware.fastdds.sockets import (
    give_up_dead_connections,
    send_again_soon,
    widen_discovery_buffers,
)
from lifecycle.middleware.rcl.graph import GraphObserver
from lifecycle.middleware.services.supervisor_topics import (
    AlivePublisher,
    AliveSubscription,
    PlanNotices,
)
from lifecycle.plan.model import ParticipantConnections
from lifecycle.supervisor.control.ros_interface import Answer
from lifecycle.supervisor.nodes.driver import where_it_runs
from lifecycle.verify.observation import ObservedEndpoint, ObservedNode
from lifecycle.verify.tool_filter import known_node

if TYPE_CHECKING:
    from lifecycle.middleware.services.supervisor_topics import RosInterface


class ObserverParticipant:
    """What a supervisor observes and reaches of one domain. `destroy` it, or use it in a `with`.

    Attributes:
        graph: what is observed.
        discovery: what its participant discovers.
        clients: of other nodes' services.
        rmw: name of the RMW implementation.
        unknown_versions: which installed libraries are not known, and what that costs; empty if
            all are.
        announce_alive: asserts by DDS liveliness that we live.
        watch_alive: watches the liveliness of another supervisor.
        plan_notices: takes part in the exchange of plans.
        republish_names: announces our node to the graph again.
        send_again_soon: has what waits for a link to come back be sent soon when it does.
        prepare_to_leave: lets go of connections that do not answer: all that is sent would wait
            for their ends.
    """

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.discovery = graph.discovery
        self.clients = graph.clients
        self.rmw = str(rclpy.get_rmw_implementation_identifier())
        self.unknown_versions = unknown_versions()
        self._node = node = graph.discovery.node
        self.announce_alive = functools.partial(AlivePublisher, node)
        self.watch_alive = functools.partial(AliveSubscription, node)
        self.plan_notices = functools.partial(PlanNotices, node)
        self.republish_names = functools.partial(republish_names, [node])
        self.send_again_soon = send_again_soon
        self.prepare_to_leave = give_up_dead_connections

    @classmethod
    def open(
        cls,
        domain_id: int,
        connections: ParticipantConnections = ParticipantConnections(),
        *,
        unplanned: bool = False,
        events: bool = False,
        settle_s: float | None = None,
    ) -> ObserverParticipant:
        """Make the participant; before any process, so that each is discovered at once.

        Args:
            domain_id: 0–232.
            connections: how it is connected; by default as the RMW likes.
            unplanned: also read the configurations of nodes that are not planned.
            events: receive graph messages, and look again at nodes that changed.
            settle_s: see Discovery; None takes what Fast DDS needs.

        Raises:
            MiddlewareError: it cannot be made.
        """
        graph = Graph.in_loop(domain_id, connections, messages=events, unplanned=unplanned)
        widen_discovery_buffers(domain_id)
        if settle_s is not None:
            graph.discovery.settling.within(settle_s)
        return cls(graph)

    async def running(self) -> tuple[dict[str, str], str]:
        """Return the nodes once discovery has settled, and what it lacked in the end.

        By full name, with the process that each is in as people read it, empty if not known.
        """
        (nodes, _), unsettled = await settled(self.discovery, SETTLE_S)
        processes = self.processes()
        names = (each.full_name for each in nodes)
        return {name: where_it_runs(processes.get(name, {})) for name in names}, unsettled

    def processes(self) -> dict[str, dict[int, str]]:
        """Return the command lines of this host's processes by full node name and pid."""
        return {
            name: {each.process_id: shlex.join(each.argv) for each in programs.values()}
            for name, programs in self.discovery.programs(os.environ).items()
        }

    def ros_interface(
        self,
        prefix: str,
        services: Iterable[str],
        on_call: Callable[[str, Answer], None],
        *,
        diagnoses: bool,
    ) -> RosInterface:
        """Make the topics and services by which ROS programs reach the supervisor.

        Raises:
            MiddlewareError: a package cannot be loaded, or rcl refuses.
        """
        try:
            from lifecycle.middleware.services.supervisor_topics import RosInterface

            return RosInterface(self._node, prefix, services, on_call, diagnoses=diagnoses)
        except Exception as error:  # rclpy has no root of its own errors
            raise MiddlewareError(" ".join(str(error).split())) from error

    def destroy(self) -> None:
        """Leave the graph."""
        self.graph.close()

    def __enter__(self) -> ObserverParticipant:  # noqa: PYI034 - typing.Self is not in Python 3.10
        return self

    def __exit__(self, *_: object) -> None:
        self.destroy()


SETTLE_S = 5.0
"""For discovery to show all that runs; usually it has settled within a second."""

_SETTLED_S = 0.5
"""Discovery has settled once nothing changed for so long and everything has a node."""

_LOOK_S = 0.05

Snapshot = tuple[tuple[ObservedNode, ...], tuple[ObservedEndpoint, ...]]


async def settled(graph: GraphObserver, wait_s: float) -> tuple[Snapshot, str]:
    """Wait until the graph changes no more; return it, and what it still lacked in the end."""
    clock = asyncio.get_running_loop().time
    snapshot, since_s = graph.snapshot(), clock()
    deadline_s = since_s + wait_s
    while True:
        lacking = dict.fromkeys(
            f"nobody tells whose {each.name} is"
            for each in snapshot[1]
            if not known_node(each.node)
        )
        if graph.settling.left_s() > 0:
            lacking["a participant whose node is not known"] = None
        if not lacking and clock() - since_s >= _SETTLED_S:
            return snapshot, ""
        if clock() >= deadline_s:
            what = ", ".join(lacking) or "it still changed"
            return snapshot, f"discovery had not settled after {wait_s:g} s: {what}"
        await asyncio.sleep(_LOOK_S)
        if (found := graph.snapshot()) != snapshot:
            snapshot, since_s = found, clock()
