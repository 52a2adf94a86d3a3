"""SROS 2 access control from a plan: policy.xml, and DDS-Security permissions and governance.

Owns: which topics, services and actions each process of a plan and each supervisor needs, and how
the three kinds of document say so. Nothing is signed here: that takes the keys of a keystore. Pure.

Sources: the policy format of SROS 2 (design.ros2.org/articles/ros2_access_control_policies.html),
version 0.2.0; DDS Security 1.1 §9.4.1.2 (governance) and §9.4.1.3 (permissions), grant by subject
name; how names become DDS topics, `rt/`, `rq/…Request`, `rr/…Reply`
(design.ros2.org/articles/topic_and_service_names.html).
"""

from __future__ import annotations

import datetime as dt
import itertools
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping

from lifecycle import dataclasses
from lifecycle.manifest import (
    ALIVE_PULSE,
    DIAGNOSTICS_TOPIC,
    EndpointKind,
    RunKind,
    supervisor_alive_topic,
)
from lifecycle.plan import Plan, PlannedNode, PlannedProcess
from lifecycle.verify import (
    GRAPH_TOPIC,
    NODE_SERVICES,
    OUR_SERVICES,
    supervisor_endpoints,
)

OVERRIDE = "ROS_SECURITY_ENCLAVE_OVERRIDE"
"""The variable by which rcl takes an enclave for every context of a process."""

PLANS_TOPIC = "/_lifecycle/plans"
"""Where supervisors announce their plans (lifecycle.middleware.discovery.liveliness)."""

_MANAGED = frozenset(name for name, type_ in NODE_SERVICES.items() if "lifecycle_msgs" in type_)
_ACTION_SERVICES = ("cancel_goal", "get_result", "send_goal")
_ACTION_TOPICS = ("feedback", "status")

_GRANTS = {
    EndpointKind.PUBLISHER: ("topic", "publish"),
    EndpointKind.SUBSCRIPTION: ("topic", "subscribe"),
    EndpointKind.SERVICE_SERVER: ("service", "reply"),
    EndpointKind.SERVICE_CLIENT: ("service", "request"),
    EndpointKind.ACTION_SERVER: ("action", "execute"),
    EndpointKind.ACTION_CLIENT: ("action", "call"),
}
"""What a policy calls an endpoint, and what the endpoint does with it."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Profile:
    """What one node may do.

    Attributes:
        namespace: absolute.
        name: base name.
        allowed: (kind, fully qualified name); nothing else is.
    """

    namespace: str
    name: str
    allowed: frozenset[tuple[EndpointKind, str]]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Enclave:
    """What the holder of one key may do: rcl has one for each context, we for each process.

    Attributes:
        path: `/teleop/camera`.
        profiles: of its nodes.
        processes: names of the plan's processes; empty for a supervisor's.
        chosen: the manifest names it, by the variable or by `--enclave`; else it must be given.
    """

    path: str
    profiles: tuple[Profile, ...]
    processes: tuple[str, ...] = ()
    chosen: bool = False


def enclaves_of(plan: Plan) -> tuple[Enclave, ...]:
    """Return the enclaves that a system needs: of its processes, then of its supervisors.

    A process whose environment or command line names an enclave keeps it; those that name the same
    share its permissions.
    """
    found: dict[str, Enclave] = {}
    chosen = {each.name: _chosen(each) for each in plan.processes}
    for process in plan.processes:
        path = chosen[process.name] or _free(
            _path(plan.system, process.name), {*found, *chosen.values()}
        )
        profiles = tuple(_node_profile(plan.node(key)) for key in process.nodes)
        known = found.get(path)
        found[path] = Enclave(
            path=path,
            profiles=(*(known.profiles if known else ()), *profiles),
            processes=(*(known.processes if known else ()), process.name),
            chosen=bool(chosen[process.name]),
        )
    for machine in plan.machines:
        path = _free(_path(plan.system, f"supervisor_{machine.name}"), found)
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
    return _text(root)


def render_permissions(
    enclave: Enclave, *, domain_id: int, not_before: dt.datetime, not_after: dt.datetime
) -> str:
    """Return the permissions document of one enclave, unsigned.

    Args:
        enclave: its path is the subject's common name, as sros2 makes certificates.
        domain_id: the one domain that it may join.
        not_before: UTC; before it nothing is allowed.
        not_after: UTC; nor after it.
    """
    root = ET.Element("dds")
    grant = ET.SubElement(ET.SubElement(root, "permissions"), "grant", name=enclave.path)
    ET.SubElement(grant, "subject_name").text = f"CN={enclave.path}"
    validity = ET.SubElement(grant, "validity")
    for name, time in (("not_before", not_before), ("not_after", not_after)):
        ET.SubElement(validity, name).text = time.strftime("%Y-%m-%dT%H:%M:%S")
    rule = ET.SubElement(grant, "allow_rule")
    ET.SubElement(ET.SubElement(rule, "domains"), "id").text = str(domain_id)
    allowed = {each for profile in enclave.profiles for each in profile.allowed}
    for verb, topics in _dds_topics(allowed).items():
        criteria = ET.SubElement(ET.SubElement(rule, verb), "topics")
        for topic in sorted(topics):
            ET.SubElement(criteria, "topic").text = topic
    ET.SubElement(grant, "default").text = "DENY"
    return _text(root)


def render_governance(domain_id: int) -> str:
    """Return the governance document of a domain, unsigned.

    Only who has a key joins; announcements, liveliness and data are encrypted, RTPS messages are
    signed, and every topic is subject to permissions.
    """
    root = ET.Element("dds")
    rule = ET.SubElement(ET.SubElement(root, "domain_access_rules"), "domain_rule")
    ET.SubElement(ET.SubElement(rule, "domains"), "id").text = str(domain_id)
    _leaves(
        rule,
        {
            "allow_unauthenticated_participants": "false",
            "enable_join_access_control": "true",
            "discovery_protection_kind": "ENCRYPT",
            "liveliness_protection_kind": "ENCRYPT",
            "rtps_protection_kind": "SIGN",
        },
    )
    _leaves(
        ET.SubElement(ET.SubElement(rule, "topic_access_rules"), "topic_rule"),
        {
            "topic_expression": "*",
            "enable_discovery_protection": "true",
            "enable_liveliness_protection": "true",
            "enable_read_access_control": "true",
            "enable_write_access_control": "true",
            "metadata_protection_kind": "ENCRYPT",
            "data_protection_kind": "ENCRYPT",
        },
    )
    return _text(root)


def documents(
    plan: Plan, *, not_before: dt.datetime, not_after: dt.datetime
) -> tuple[tuple[Enclave, ...], Mapping[str, str]]:
    """Return the enclaves of a plan and every document, by its path below a keystore.

    Args:
        plan: of the whole system.
        not_before: see `render_permissions`.
        not_after: likewise.
    """
    enclaves = enclaves_of(plan)
    files = {
        "policy.xml": render_policy(enclaves),
        "enclaves/governance.xml": render_governance(plan.domain_id),
    }
    for each in enclaves:
        files[f"enclaves{each.path}/permissions.xml"] = render_permissions(
            each, domain_id=plan.domain_id, not_before=not_before, not_after=not_after
        )
    return enclaves, files


def _node_profile(node: PlannedNode) -> Profile:
    """Return what a node declares, and what its client library and our node class bring along."""
    services = {
        name
        for name in (*NODE_SERVICES, *OUR_SERVICES)
        if node.managed or name not in {*_MANAGED, *OUR_SERVICES}
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
        allowed |= {(EndpointKind.PUBLISHER, each) for each in _node_topics(node)}
        allowed |= {
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
            names -= _MANAGED
        allowed |= {(EndpointKind.SERVICE_CLIENT, f"{node.full_name}/{name}") for name in names}
        if node.managed:
            allowed |= {(EndpointKind.SUBSCRIPTION, each) for each in _node_topics(node)}
    for other in plan.machines:
        kind = EndpointKind.PUBLISHER if other.name == machine else EndpointKind.SUBSCRIPTION
        topic = supervisor_alive_topic(plan.system, other.name)
        allowed |= {(kind, topic), (kind, f"{topic}{ALIVE_PULSE}")}
    if any(node.health is not None and node.health.diagnostics for node in plan.nodes):
        allowed.add((EndpointKind.SUBSCRIPTION, DIAGNOSTICS_TOPIC))
    several = len({each.machine for each in plan.nodes}) > 1
    allowed |= supervisor_endpoints(plan, machine if several else "")
    return Profile(namespace="/", name="_lifecycle_observer", allowed=frozenset(allowed))


def _node_topics(node: PlannedNode) -> tuple[str, ...]:
    names = ("transition_event", "_alive", "_alive_pulse")
    return tuple(f"{node.full_name}/{name}" for name in names)


def _dds_topics(allowed: Iterable[tuple[EndpointKind, str]]) -> dict[str, set[str]]:
    """Return the DDS topics that may be written and read; rmw's own is among them."""
    publish = {"ros_discovery_info"}
    subscribe = {"ros_discovery_info"}
    for kind, name in allowed:
        if kind is EndpointKind.PUBLISHER:
            publish.add(f"rt{name}")
        elif kind is EndpointKind.SUBSCRIPTION:
            subscribe.add(f"rt{name}")
        else:
            # Who serves writes replies and feedback, and reads requests; who asks does the reverse.
            serves = kind in {EndpointKind.SERVICE_SERVER, EndpointKind.ACTION_SERVER}
            out, in_ = (publish, subscribe) if serves else (subscribe, publish)
            is_action = kind in {EndpointKind.ACTION_SERVER, EndpointKind.ACTION_CLIENT}
            parts = [f"{name}/_action/{each}" for each in _ACTION_SERVICES] if is_action else [name]
            out |= {f"rr{each}Reply" for each in parts}
            in_ |= {f"rq{each}Request" for each in parts}
            if is_action:
                out |= {f"rt{name}/_action/{each}" for each in _ACTION_TOPICS}
    return {"publish": publish, "subscribe": subscribe}


def _chosen(process: PlannedProcess) -> str:
    """Return the enclave that a process is given by its manifest; empty if by none."""
    if path := dict(process.environment).get(OVERRIDE, ""):
        return path
    words = process.argv if process.run.kind is RunKind.COMMAND else ()
    for word, following in itertools.pairwise(words):
        if word in {"--enclave", "-e"} and following.startswith("/"):
            return following
    return ""


def _path(system: str, name: str) -> str:
    return "/".join(["", *(_token(each) for each in (system, name))])


def _token(name: str) -> str:
    """Return a name as one token of an enclave's path, which has the alphabet of namespaces."""
    plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return plain if plain[:1].isalpha() or plain.startswith("_") else f"_{plain}"


def _free(path: str, taken: Iterable[str]) -> str:
    """Return a path that is not in use yet: a process may be named as a supervisor's enclave is."""
    every = {*taken}
    number = 2
    free = path
    while free in every:
        free, number = f"{path}_{number}", number + 1
    return free


def _leaves(parent: ET.Element, values: Mapping[str, str]) -> None:
    for name, value in values.items():
        ET.SubElement(parent, name).text = value


def _text(root: ET.Element) -> str:
    ET.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(root, encoding="unicode")}\n'
