"""Specs of nodes without the detour of a manifest file."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import rclpy
from msgspec.structs import replace

from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.model import EndpointKind
from lifecycle.middleware.fastdds.profiles import ParticipantSettings
from lifecycle.node.host.adoption import Adoption, Participants
from lifecycle.node.host.loop import NodeLoop
from lifecycle.node.node import LifecycleNode
from lifecycle.node.planned import plan_without_manifest
from lifecycle.plan.model import PlannedEndpoint, PlannedNode
from tests.builders import STRING, planned_endpoint

AT = Position(file="test.lifecycle.yaml", line=7, column=5, path="nodes.it")


def publisher(name: str, type_: str = STRING, **changes: Any) -> PlannedEndpoint:
    return planned_endpoint(EndpointKind.PUBLISHER, name, type_, **changes)


def subscription(name: str, type_: str = STRING, **changes: Any) -> PlannedEndpoint:
    return planned_endpoint(EndpointKind.SUBSCRIPTION, name, type_, **changes)


def server(name: str, type_: str = "std_srvs/srv/Trigger") -> PlannedEndpoint:
    return planned_endpoint(EndpointKind.SERVICE_SERVER, name, type_)


def client(name: str, type_: str = "std_srvs/srv/Trigger") -> PlannedEndpoint:
    return planned_endpoint(EndpointKind.SERVICE_CLIENT, name, type_)


def planned(name: str, *endpoints: PlannedEndpoint, **changes: Any) -> PlannedNode:
    """Return the plan of one node."""
    blank = plan_without_manifest(LifecycleNode, name=name, namespace="/")
    # Few tests are about what the graph is told; the others need no heartbeats.
    return replace(blank, endpoints=endpoints, **{"events": False, **changes})


class Present(Participants):
    """The participant of a context that has one."""

    @contextlib.contextmanager
    def carrying(self, _: ParticipantSettings) -> Iterator[rclpy.Context]:
        yield self._default


@contextlib.contextmanager
def built_with(spec: PlannedNode, context: rclpy.Context) -> Iterator[None]:
    """Construct the next node as a host would."""
    loop = NodeLoop(context)
    adoption = Adoption(context, loop)
    adoption.participants = Present(context)
    try:
        with adoption.expecting(spec, [spec]):
            yield
    finally:
        adoption.unfollow()
        loop.close()
