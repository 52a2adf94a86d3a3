"""Specs of nodes without the detour of a manifest file."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any

import rclpy

from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import QosProfile
from lifecycle.node.author.node import LifecycleNode
from lifecycle.node.author.spec import Construction, Mode, constructing, plan_without_manifest
from lifecycle.plan.model import PlannedEndpoint, PlannedNode

AT = Position(file="test.lifecycle.yaml", line=7, column=5, path="nodes.it")
_TOPICS = {EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION}


def endpoint(kind: EndpointKind, name: str, type_: str, **changes: Any) -> PlannedEndpoint:
    """Return a planned endpoint in the root namespace."""
    qos = QosProfile() if kind in _TOPICS else None
    values = {"qos": qos, "resolved": f"/{name.lstrip('/')}", "at": AT, **changes}
    return PlannedEndpoint(kind=kind, name=name, type=type_, **values)


def publisher(name: str, type_: str = "std_msgs/msg/String", **changes: Any) -> PlannedEndpoint:
    return endpoint(EndpointKind.PUBLISHER, name, type_, **changes)


def subscription(name: str, type_: str = "std_msgs/msg/String", **changes: Any) -> PlannedEndpoint:
    return endpoint(EndpointKind.SUBSCRIPTION, name, type_, **changes)


def server(name: str, type_: str = "std_srvs/srv/Trigger") -> PlannedEndpoint:
    return endpoint(EndpointKind.SERVICE_SERVER, name, type_)


def client(name: str, type_: str = "std_srvs/srv/Trigger") -> PlannedEndpoint:
    return endpoint(EndpointKind.SERVICE_CLIENT, name, type_)


def planned(name: str, *endpoints: PlannedEndpoint, **changes: Any) -> PlannedNode:
    """Return the plan of one node."""
    blank = plan_without_manifest(LifecycleNode, name=name, namespace="/")
    # Few tests are about what the graph is told; the others need no heartbeats.
    return dataclasses.replace(blank, endpoints=endpoints, **{"events": False, **changes})


@contextlib.contextmanager
def built_with(spec: PlannedNode, context: rclpy.Context) -> Iterator[None]:
    """Construct the next node as a host would."""
    with constructing(Construction(spec=spec, mode=Mode.MANUAL, context=context)):
        yield
