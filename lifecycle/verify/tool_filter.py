"""Filters tools and client library endpoints, which no manifest declares, out of a ROS graph. Pure.

Sources: rcl (parameter, type description and logger services, rosout), rcl_lifecycle, the actions
article (https://design.ros2.org/articles/actions.html), names of nodes as the tools choose them.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Collection, Iterable, Mapping

import msgspec

from lifecycle.manifest.installed_types import join
from lifecycle.manifest.model import TOLERATED_NODES, EndpointKind, RosInterfaceAccess
from lifecycle.manifest.names import (
    DIAGNOSTICS_TOPIC,
    MODE_SERVICE,
    NODE_SERVICES,
    OUR_SERVICES,
    SUPERVISORS,
    supervisor_prefix,
    supervisor_services,
    supervisor_status_topic,
)
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.model import Plan, uses_sim_time
from lifecycle.verify.observation import ObservedEndpoint

OUR_NODES = "_lifecycle_*"
"""Observers: every supervisor and every `lifecycle verify` has one. They are tolerated as tools,
whatever the policy: a name proves nothing, so they may do no more than those."""

_OUR_TOPICS = "/_lifecycle/"
"""Where the supervisors of several machines notice each other."""

_DIAGNOSTICS = DIAGNOSTICS_TOPIC, "diagnostic_msgs/msg/DiagnosticArray"

PLACEHOLDER_NAMES = frozenset({"_NODE_NAME_UNKNOWN_", "_CREATED_BY_BARE_DDS_APP_"})
"""What rmw_dds_common calls the node of an endpoint whose node it does not know (yet)."""

GRAPH_TOPIC = "/lifecycle/graph"
"""Where nodes publish changes of themselves and receive those of others (lifecycle.graph)."""

CLOCK = "/clock", "rosgraph_msgs/msg/Clock"
"""The topic of simulated time, and its type: who publishes it drives every `use_sim_time` node."""

NOISE_TOPICS: Mapping[tuple[EndpointKind, str], str] = {
    (EndpointKind.PUBLISHER, "/rosout"): "rcl_interfaces/msg/Log",
    (EndpointKind.PUBLISHER, "/parameter_events"): "rcl_interfaces/msg/ParameterEvent",
    (EndpointKind.SUBSCRIPTION, "/parameter_events"): "rcl_interfaces/msg/ParameterEvent",
    # every client library subscribes to it when use_sim_time is set
    (EndpointKind.SUBSCRIPTION, CLOCK[0]): CLOCK[1],
    (EndpointKind.PUBLISHER, GRAPH_TOPIC): "std_msgs/msg/String",
    (EndpointKind.SUBSCRIPTION, GRAPH_TOPIC): "std_msgs/msg/String",
}
"""Topics of the client libraries themselves, and ours, with their types."""

_SERVICE_EVENT = "/_service_event"
"""What a service or client says of its calls once its introspection is configured (REP-2012)."""

_CONTAINER = "/_container"
_CONTAINER_SERVICES: Mapping[str, str] = {
    "load_node": "composition_interfaces/srv/LoadNode",
    "unload_node": "composition_interfaces/srv/UnloadNode",
    "list_nodes": "composition_interfaces/srv/ListNodes",
}
"""Services of component containers, `~/_container/load_node` (rclcpp_components)."""

OURS_BY = frozenset({"get_configuration", "map_to"})
"""Who offers both under its own name is a node of ours."""

NODE_TOPICS: Mapping[str, str] = {
    "transition_event": "lifecycle_msgs/msg/TransitionEvent",
}
"""Topics that a node publishes under its own name, and their types."""

PREFIX_DIGITS = 24
"""A GUID begins with its participant's prefix of 12 bytes (DDSI-RTPS §9.3.1)."""

_ACTION_PART = "/_action/"
_ACTION_PARTS: Mapping[str, tuple[EndpointKind, str]] = {
    "send_goal": (EndpointKind.SERVICE_SERVER, "_SendGoal"),
    "cancel_goal": (EndpointKind.SERVICE_SERVER, "action_msgs/srv/CancelGoal"),
    "get_result": (EndpointKind.SERVICE_SERVER, "_GetResult"),
    "feedback": (EndpointKind.PUBLISHER, "_FeedbackMessage"),
    "status": (EndpointKind.PUBLISHER, "action_msgs/msg/GoalStatusArray"),
}
"""Parts of an action: their kind in its server, whose other end is in its client, and their type;
of a type that begins with the action's own, the end."""


def tolerating_pattern(full_name: str, patterns: Collection[str] = TOLERATED_NODES) -> str:
    """Return the pattern by which a node may be there undeclared; empty if there is none.

    Args:
        full_name: fully qualified, `/launch_ros_4711`. A manifest may declare a node of such a
            name; a caller that filters must keep declared names.
        patterns: as in `policy.tolerated_nodes`; our own observers are always tolerated.
    """
    base = full_name.rpartition("/")[2]
    for pattern in (OUR_NODES, *patterns):
        if matches(full_name if "/" in pattern else base, pattern):
            return pattern
    return ""


def matches(name: str, pattern: str) -> bool:
    """Return whether a name is as a pattern of a manifest has it: `*`, `?`, all else as it is."""
    return _compiled(pattern).fullmatch(name) is not None


@functools.lru_cache(maxsize=256)
def _compiled(pattern: str) -> re.Pattern[str]:
    return re.compile(re.escape(pattern).replace(r"\*", ".*").replace(r"\?", "."))


def _offering(kind: EndpointKind) -> EndpointKind:
    """Return the kind that offers under the name by which an endpoint of this one meets it."""
    return kind if kind.offers else kind.other_end


class DeclaredNames(msgspec.Struct, frozen=True):
    """The topics, services and actions that a plan declares.

    Attributes:
        nodes: full names of the declared nodes. Each has its lifecycle and parameter services,
            `~/transition_event` and the like under its own name.
        ends: node, kind and name of every declared endpoint.
        names: by the kind that offers, fully qualified, those that endpoints declare.
        simulated: nodes of the plan have `use_sim_time`, so that it matters who publishes /clock.
    """

    nodes: frozenset[str] = frozenset()
    ends: frozenset[tuple[str, EndpointKind, str]] = frozenset()
    names: frozenset[tuple[EndpointKind, str]] = frozenset()
    simulated: bool = False

    @classmethod
    def of(cls, plan: Plan) -> DeclaredNames:
        """Collect those of a plan."""
        ends = frozenset(
            (node.full_name, each.kind, each.resolved)
            for node in plan.nodes
            for each in node.endpoints
        )
        names = frozenset((_offering(kind), name) for _, kind, name in ends)
        return cls(
            nodes=frozenset(node.full_name for node in plan.nodes),
            ends=ends,
            names=names,
            simulated=any(map(uses_sim_time, plan.nodes)),
        )

    def of_kind(self, kind: EndpointKind) -> tuple[str, ...]:
        """Return the declared names under which endpoints of a kind meet, sorted."""
        return tuple(sorted(name for each, name in self.names if each is _offering(kind)))

    def has(self, kind: EndpointKind, name: str) -> bool:
        """Return whether an endpoint meets declared ones; a part of an action, that action's."""
        part = action_part(kind, name)
        return (_offering(kind), name) in self.names or (part is not None and self.has(*part))

    def fed_by(self, kind: EndpointKind, name: str) -> bool:
        """Return whether an endpoint of an undeclared node would feed or serve the system."""
        if not kind.offers or (kind, name) in NOISE_TOPICS:
            return False
        node, _, base = name.rpartition("/")
        is_own = node in self.nodes and base in _OWN.get(kind, ())
        return self.has(kind, name) or is_own or name.startswith(SUPERVISORS)

    def keeps(self, endpoint: ObservedEndpoint, node: str, *, ours: bool) -> bool:
        """Return whether an endpoint is declared, feeds what is, or was made on purpose.

        `node` is whose it is, by full name; `ours`: see `is_noise_endpoint`.
        """
        kind, name = endpoint.kind, endpoint.name
        declared = self.has(kind, name)
        ours_own = is_of_observer(kind, endpoint.node, name, endpoint.type)
        return (
            (node, kind, name) in self.ends
            or (node not in self.nodes and self.fed_by(kind, name) and (declared or not ours_own))
            or not is_noise_endpoint(kind, endpoint.node, name, endpoint.type, ours=ours)
        )


_OWN: Mapping[EndpointKind, Collection[str]] = {
    EndpointKind.SERVICE_SERVER: NODE_SERVICES.keys() | OUR_SERVICES.keys(),
    EndpointKind.PUBLISHER: NODE_TOPICS.keys(),
}
"""What every node offers under its own name."""


def known_node(full_name: str) -> str:
    """Return a node's name, or an empty one where it only means "not known"."""
    return "" if full_name.rpartition("/")[2] in PLACEHOLDER_NAMES else full_name


NO_NAMES = DeclaredNames()
"""Nothing is looked for."""


def _is_service_event(kind: EndpointKind, name: str, type_: str) -> bool:
    publishes = kind is EndpointKind.PUBLISHER and name.endswith(_SERVICE_EVENT)
    return publishes and "/srv/" in type_ and type_.endswith("_Event")


def is_of_supervisor(hardware_id: str) -> bool:
    """Return whether an entry on /diagnostics with a hardware id is a supervisor's."""
    return hardware_id.startswith(SUPERVISORS)


def supervisor_label(system: str, machine: str = "") -> str:
    """Return what the names of a supervisor's entries on /diagnostics begin with."""
    return f"{system}/{machine}" if machine else system


def supervisor_endpoints(plan: Plan, machine: str = "") -> frozenset[tuple[EndpointKind, str]]:
    """Return what a supervisor makes by `policy.ros_interface`; see `supervisor_prefix`."""
    access = plan.policy.access
    if access is RosInterfaceAccess.OFF:
        return frozenset()
    prefix = supervisor_prefix(plan.system, machine)
    found = {(EndpointKind.PUBLISHER, supervisor_status_topic(prefix))}
    for name in supervisor_services(access, (each.name for each in plan.modes)):
        # Which mode a system is in that has several supervisors is not for one of them to say.
        if not machine or not name.startswith(MODE_SERVICE):
            found.add((EndpointKind.SERVICE_SERVER, f"{prefix}/{name}"))
    if takes_diagnostics(plan):
        found.add((EndpointKind.PUBLISHER, DIAGNOSTICS_TOPIC))
    return frozenset(found)


def takes_diagnostics(plan: Plan) -> bool:
    """Return whether a supervisor may publish on /diagnostics and disturb nothing of the plan.

    It may not where the manifest has the name for something else, and where it says what flow the
    topic must have: what the supervisor sent to the same port would be part of what was verified
    and programmed.
    """
    ends = [
        each for node in plan.nodes for each in node.endpoints if each.resolved == DIAGNOSTICS_TOPIC
    ]
    free = (UniqueRequirement.NOT_REQUIRED, UniqueRequirement.SYSTEM_DEFAULT)
    return not any(flow.topic == DIAGNOSTICS_TOPIC and flow.linked for flow in plan.flows) and all(
        each.type == _DIAGNOSTICS[1]
        and each.unique in free
        and each.dscp is None
        and each.five_qi is None
        for each in ends
    )


def is_of_observer(kind: EndpointKind, node: str, name: str, type_: str) -> bool:
    """Return whether an endpoint is one by which supervisors notice each other, or are asked.

    A name proves nothing: all that it lets a node do is to speak for a supervisor.
    """
    diagnoses = (kind, name, type_) == (EndpointKind.PUBLISHER, *_DIAGNOSTICS)
    below = name.startswith((_OUR_TOPICS, SUPERVISORS)) or diagnoses
    return below and bool(tolerating_pattern(node, ()))


def is_noise_endpoint(kind: EndpointKind, node: str, name: str, type_: str, *, ours: bool) -> bool:
    """Return whether an endpoint is one that client libraries make without being asked.

    Offering such a service counts as noise only under the node's own name; using it, under any:
    who drives another node's lifecycle or parameters declares nothing. A topic or service of
    another type only has the name, and belongs to a user. An endpoint whose node is not known is
    never noise: it may be the first sign of a node that must not be there. The services of the node
    interface are noise of nodes that are `ours` (`our_nodes`); using those of others, of all.
    """
    if not node:
        return False
    of_library = _is_service_event(kind, name, type_) or NOISE_TOPICS.get((kind, name)) == type_
    if of_library or is_of_observer(kind, node, name, type_):
        return True
    owner, _, base = name.rpartition("/")
    of_container = owner.endswith(_CONTAINER) and _CONTAINER_SERVICES.get(base) == type_
    if of_container:
        owner = owner.removesuffix(_CONTAINER)
    offers = kind in (EndpointKind.SERVICE_SERVER, EndpointKind.PUBLISHER)
    if offers and owner != node:
        return False
    if kind in (EndpointKind.SERVICE_SERVER, EndpointKind.SERVICE_CLIENT):
        if of_container or NODE_SERVICES.get(base) == type_:
            return True
        return OUR_SERVICES.get(base) == type_ and (ours or not offers)
    return NODE_TOPICS.get(base) == type_


def our_nodes(endpoints: Iterable[ObservedEndpoint]) -> frozenset[str]:
    """Return the nodes that offer the node interface and the node configuration interface.

    Of the nodes in question no endpoint may have been left out as noise before.
    """
    offered: dict[str, set[str]] = {}
    for each in endpoints:
        owner, _, base = each.name.rpartition("/")
        if (
            each.kind is EndpointKind.SERVICE_SERVER
            and each.node
            and owner == each.node
            and OUR_SERVICES.get(base) == each.type
        ):
            offered.setdefault(each.node, set()).add(base)
    return frozenset(node for node, bases in offered.items() if bases >= OURS_BY)


def action_part(kind: EndpointKind, name: str) -> tuple[EndpointKind, str] | None:
    """Return the action endpoint that a hidden topic or service is a part of.

    `/dock/_action/send_goal` gives ACTION_SERVER or ACTION_CLIENT, and `/dock`; None if it is no
    part of an action.
    """
    action, separator, part = name.rpartition(_ACTION_PART)
    if not separator or not action:
        return None
    served, _ = _ACTION_PARTS.get(part, (None, ""))
    if served is None:
        return None
    if kind is served:
        return EndpointKind.ACTION_SERVER, action
    return (EndpointKind.ACTION_CLIENT, action) if kind is served.other_end else None


def fold_actions(endpoints: Iterable[ObservedEndpoint]) -> tuple[ObservedEndpoint, ...]:
    """Replace complete sets of an action's hidden endpoints by one action endpoint.

    A server is complete with three services and two publishers, a client with three service
    clients and two subscriptions, all of the action's types. Other parts stay as they are: an
    action that discovery shows only half of is not there yet. A client that a node has several
    times is one end. Action endpoints in the input stay.
    """
    kept: list[ObservedEndpoint] = []
    groups: dict[tuple[str, EndpointKind, str], list[ObservedEndpoint]] = {}
    for endpoint in endpoints:
        action = action_part(endpoint.kind, endpoint.name)
        if action is None:
            kept.append(endpoint)
        else:
            groups.setdefault((endpoint.node, *action), []).append(endpoint)
    known = {(each.node, each.kind, each.name) for each in kept}
    for (node, side, name), parts in groups.items():
        calls = side is EndpointKind.ACTION_CLIENT
        if calls and (node, side, name) in known:
            continue
        type_ = _action_type(parts)
        named = [
            [
                each
                for each in parts
                if (each.name, each.type) == (f"{name}{_ACTION_PART}{part}", part_type(part, type_))
            ]
            for part in _ACTION_PARTS
        ]
        whole = list(zip(*named, strict=False))
        for goal, _, result, feedback, _ in whole[:1] if calls else whole:
            kept.append(
                ObservedEndpoint(
                    kind=side,
                    node=node,
                    name=name,
                    type=type_,
                    gid=goal.gid,
                    address=goal.address,
                    type_hash=_action_hash(goal, result, feedback),
                )
            )
        for found in named if calls and whole else whole:
            for each in found:
                parts.remove(each)
        kept.extend(parts)
    return tuple(kept)


def part_type(part: str, type_: str) -> str:
    """Return the type that a part of an action has; the end of its name is enough."""
    _, end = _ACTION_PARTS[part.rpartition("/")[2]]
    return f"{type_}{end}" if end.startswith("_") else end


def _action_type(parts: Iterable[ObservedEndpoint]) -> str:
    """Return the type of an action: that of most of its parts where they differ."""
    found = []
    for each in parts:
        _, end = _ACTION_PARTS[each.name.rpartition("/")[2]]
        if end.startswith("_") and each.type.endswith(end):
            found.append(each.type.removesuffix(end))
    return max(found, key=found.count) if found else ""


def _action_hash(*parts: ObservedEndpoint) -> str | None:
    """Return the type hash of an action from those of its parts; None while one is not seen."""
    known = [each.type_hash for each in parts if each.type_hash is not None]
    return join(known) if len(known) == len(parts) else None


def is_hidden_node(full_name: str) -> bool:
    """Whether a node is hidden by the convention of ROS 2: its name begins with an underscore."""
    return full_name.rpartition("/")[2].startswith("_")
