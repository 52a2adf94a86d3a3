"""SROS 2 access control from a plan: policy.xml, of which `ros2 security` makes all the rest.

Owns: which topics, services and actions each process of a plan and each supervisor needs. Nothing
is signed here: that takes the keys of a keystore. Pure.

Source: the policy format of SROS 2 (design.ros2.org/articles/ros2_access_control_policies.html),
version 0.2.0.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable

import msgspec

from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.names import (
    DIAGNOSTICS_TOPIC,
    MANAGED_SERVICES,
    NODE_SERVICES,
    OUR_SERVICES,
    free_name,
    supervisor_alive_topic,
)
from lifecycle.plan.model import Plan, PlannedNode
from lifecycle.verify.tool_filter import GRAPH_TOPIC, supervisor_endpoints

OVERRIDE = "ROS_SECURITY_ENCLAVE_OVERRIDE"
"""The variable by which rcl takes an enclave for every context of a process."""

PLANS_TOPIC = "/_lifecycle/plans"
"""Where supervisors announce their plans (lifecycle.middleware.services.supervisor_topics)."""

_GRANTS = {
    EndpointKind.PUBLISHER: ("topic", "publish"),
    EndpointKind.SUBSCRIPTION: ("topic", "subscribe"),
    EndpointKind.SERVICE_SERVER: ("service", "reply"),
    EndpointKind.SERVICE_CLIENT: ("service", "request"),
    EndpointKind.ACTION_SERVER: ("action", "execute"),
    EndpointKind.ACTION_CLIENT: ("action", "call"),
}
"""What a policy calls an endpoint, and what the endpoint does with it."""


class Profile(msgspec.Struct, frozen=True, kw_only=True):
    """What one node may do.

    Attributes:
        namespace: absolute.
        name: base name.
        allowed: (kind, fully qualified name); nothing else is.
    """

    namespace: str
    name: str
    allowed: frozenset[tuple[EndpointKind, str]]


class Enclave(msgspec.Struct, frozen=True, kw_only=True):
    """What the holder of one key may do: rcl has one for each context, we for each process.

    Attributes:
        path: `/teleop/camera`.
        profiles: of its nodes.
        processes: names of the plan's processes; empty for a supervisor's.
    """

    path: str
    profiles: tuple[Profile, ...]
    processes: tuple[str, ...] = ()


def enclaves_of(plan: Plan) -> tuple[Enclave, ...]:
    """Return the enclaves that a system needs: of its processes, then of its supervisors.

    A process whose environment names an enclave keeps it; those that name the same share its
    permissions.
    """
    found: dict[str, Enclave] = {}
    chosen = {each.name: dict(each.environment).get(OVERRIDE, "") for each in plan.processes}
    for process in plan.processes:
        path = chosen[process.name] or free_name(
            _path(plan.system, process.name), {*found, *chosen.values()}
        )
        profiles = tuple(_node_profile(plan.node(key)) for key in process.nodes)
        known = found.get(path)
        found[path] = Enclave(
            path=path,
            profiles=(*(known.profiles if known else ()), *profiles),
            processes=(*(known.processes if known else ()), process.name),
        )
    for machine in plan.machines:
        # A process may be named as a supervisor's enclave is.
        path = free_name(_path(plan.system, f"supervisor_{machine.name}"), found)
        found[path] = Enclave(path=path, profiles=(_supervisor_profile(plan, machine.name),))
    return tuple(found.values())


def render_policy(enclaves: Iterable[Enclave]) -> str:
    """Return policy.xml, of which `ros2 security create_permission` makes signed permissions."""
    root = ET.Element("policy", version="0.2.0")
    every = ET.SubElement(root, "enclaves")
    for enclave in enclaves:
        profiles = ET.SubElement(ET.SubElement(every, "enclave", path=enclave.path), "profiles")
        for each in enclave.profiles:
            element = ET.SubElement(profiles, "profile", ns=each.namespace, node=each.name)
            for kind, (what, verb) in _GRANTS.items():
                names = sorted(name for found, name in each.allowed if found is kind)
                if names:
                    group = ET.SubElement(element, f"{what}s", {verb: "ALLOW"})
                    for name in names:
                        ET.SubElement(group, what).text = name
    ET.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(root, encoding="unicode")}\n'


def _node_profile(node: PlannedNode) -> Profile:
    """Return what a node declares, and what its client library and our node class bring along."""
    services = {
        name
        for name in (*NODE_SERVICES, *OUR_SERVICES)
        if node.managed or name not in {*MANAGED_SERVICES, *OUR_SERVICES}
    }
    services |= {name for name in OUR_SERVICES if node.holds}
    allowed = {(each.kind, each.resolved) for each in node.endpoints}
    allowed |= {(EndpointKind.SERVICE_SERVER, f"{node.full_name}/{name}") for name in services}
    allowed |= {
        (EndpointKind.PUBLISHER, "/rosout"),
        (EndpointKind.PUBLISHER, "/parameter_events"),
        (EndpointKind.SUBSCRIPTION, "/parameter_events"),
        (EndpointKind.SUBSCRIPTION, "/clock"),
    }
    if node.managed:
        allowed |= {
            (EndpointKind.PUBLISHER, f"{node.full_name}/transition_event"),
            (EndpointKind.PUBLISHER, GRAPH_TOPIC),
            (EndpointKind.SUBSCRIPTION, GRAPH_TOPIC),
        }
    return Profile(namespace=node.namespace, name=node.name, allowed=frozenset(allowed))


def _supervisor_profile(plan: Plan, machine: str) -> Profile:
    """Return what a supervisor needs, and `verify`, `flows` and `graph` beside it."""
    allowed = {
        (EndpointKind.PUBLISHER, "/rosout"),
        (EndpointKind.PUBLISHER, "/parameter_events"),
        (EndpointKind.SUBSCRIPTION, "/parameter_events"),
        (EndpointKind.PUBLISHER, PLANS_TOPIC),
        (EndpointKind.SUBSCRIPTION, PLANS_TOPIC),
        (EndpointKind.SUBSCRIPTION, GRAPH_TOPIC),
    }
    for node in plan.nodes:
        names = {*NODE_SERVICES, *(OUR_SERVICES if node.holds else ())}
        if not node.managed:
            names -= MANAGED_SERVICES
        allowed |= {(EndpointKind.SERVICE_CLIENT, f"{node.full_name}/{name}") for name in names}
        if node.managed:
            allowed.add((EndpointKind.SUBSCRIPTION, f"{node.full_name}/transition_event"))
    for other in plan.machines:
        kind = EndpointKind.PUBLISHER if other.name == machine else EndpointKind.SUBSCRIPTION
        allowed.add((kind, supervisor_alive_topic(plan.system, other.name)))
    if any(node.health is not None and node.health.diagnostics for node in plan.nodes):
        allowed.add((EndpointKind.SUBSCRIPTION, DIAGNOSTICS_TOPIC))
    several = len({each.machine for each in plan.nodes}) > 1
    allowed |= supervisor_endpoints(plan, machine if several else "")
    return Profile(namespace="/", name="_lifecycle_observer", allowed=frozenset(allowed))


def _path(system: str, name: str) -> str:
    return "/".join(["", *(_token(each) for each in (system, name))])


def _token(name: str) -> str:
    """Return a name as one token of an enclave's path, which has the alphabet of namespaces."""
    plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return plain if plain[:1].isalpha() or plain.startswith("_") else f"_{plain}"
