"""Type hashes (REP-2016) as discovery announces them, in the user data of each DDS endpoint.

Owns: finding the request and reply endpoints of a service by their DDS names. rmw_fastrtps and
rmw_cyclonedds announce hashes since Iron.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import TYPE_CHECKING

from lifecycle.manifest import EndpointKind, join
from lifecycle.middleware.rcl.graph_queries import EndpointInfo, endpoints_of
from lifecycle.verify import ObservedEndpoint

if TYPE_CHECKING:
    from rclpy.node import Node


def with_service_hashes(
    node: Node, endpoints: Iterable[ObservedEndpoint]
) -> tuple[ObservedEndpoint, ...]:
    """Return `endpoints` with the type hashes of services filled in, in the same order.

    The graph lists services by name and type only; their requests and replies are DDS topics like
    all others, `rq/NAMERequest` and `rr/NAMEReply`, whose endpoints announce the hashes.

    Args:
        node: that queries.
        endpoints: topics, servers and clients; the parts of actions not yet folded.
    """
    seen: dict[str, _Service] = {}
    found = []
    for each in endpoints:
        if each.kind in (EndpointKind.SERVICE_SERVER, EndpointKind.SERVICE_CLIENT):
            if each.name not in seen:
                seen[each.name] = _Service.of(node, each.name)
            found.append(dataclasses.replace(each, type_hash=seen[each.name].hash_of(each)))
        else:
            found.append(each)
    return tuple(found)


@dataclasses.dataclass(frozen=True, slots=True)
class _Service:
    """Endpoints of one service: writers and readers of its requests, then of its replies."""

    clients: tuple[list[EndpointInfo], list[EndpointInfo]]
    servers: tuple[list[EndpointInfo], list[EndpointInfo]]

    @classmethod
    def of(cls, node: Node, name: str) -> _Service:
        requests, replies = f"rq{name}Request", f"rr{name}Reply"

        def publishers(topic: str) -> list[EndpointInfo]:
            return endpoints_of(node, EndpointKind.PUBLISHER, topic, no_mangle=True)

        def subscriptions(topic: str) -> list[EndpointInfo]:
            return endpoints_of(node, EndpointKind.SUBSCRIPTION, topic, no_mangle=True)

        return cls(
            clients=(publishers(requests), subscriptions(replies)),
            servers=(subscriptions(requests), publishers(replies)),
        )

    def hash_of(self, endpoint: ObservedEndpoint) -> str | None:
        """Return the joined hashes of a node's end, empty while only half of it is seen; else None.

        None means that the RMW has no such topics, or that nothing of them is seen.
        """
        sides = self.servers if endpoint.kind is EndpointKind.SERVICE_SERVER else self.clients
        hashes, seen = [], False
        for side in sides:
            own = {info.type_hash for info in side if info.node == endpoint.node}
            seen = seen or bool(own)
            # A node with several servers or clients of one name is one end: all of them count.
            hashes.append("" if "" in own else "|".join(sorted(own)))
        return join(hashes) if seen else None
