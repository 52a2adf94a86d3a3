"""Checks of flows against transport (UDP, TCP, shared memory), datagram size and RMW capabilities.

Owns: check.flow-transport, check.flow-fragments, check.ipv6-transports, check.rmw. The capability
table is in `lifecycle.network`; what happens at run time decides, check.rmw only fails earlier.
Pure.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from lifecycle.manifest.checks.discovery import FAST_DDS
from lifecycle.manifest.checks.system import DeclaredSystem, rmw_of
from lifecycle.manifest.diagnostics import Diagnostic, Position
from lifecycle.manifest.flows import FlowNeeds, ResolvedNeed
from lifecycle.manifest.model import (
    Authority,
    DiscoveryMode,
    EndpointKind,
    FlowTransport,
    Link,
    Node,
    RunKind,
)
from lifecycle.manifest.yaml.document import error, warning
from lifecycle.network import (
    RTPS_OVERHEAD_BYTES,
    TRANSPORTS_VARIABLE,
    Capability,
    Feasibility,
    FlowSide,
    UniqueRequirement,
    capabilities,
    datagram_bytes,
    dscp_feasibility,
    feasibility,
    max_unfragmented,
)


def check_middleware(
    system: DeclaredSystem, needs: FlowNeeds, environment: Mapping[str, str]
) -> Iterator[Diagnostic]:
    """Yield findings about what the RMW of a node cannot do.

    An error where a need that must be met certainly is not; else a warning that names the source
    of the answer. Without RMW_IMPLEMENTATION it is ROS 2's default.
    """
    for node in system.manifest.nodes:
        rmw = rmw_of(node, environment)
        for each in needs.of_node(node):
            yield from _unique(rmw, node, each)
            if each.dscp is not None:
                cell = capabilities(rmw).dscp
                must = each.need.enforce
                what = f"{each.need.kind.noun} {each.need.name!r} of {node.key!r}"
                yield from _judge(each, what, dscp_feasibility(rmw), cell, must=must)


def _unique(rmw: str, node: Node, each: ResolvedNeed) -> Iterator[Diagnostic]:
    publishes = each.need.kind is EndpointKind.PUBLISHER
    side = FlowSide.PUBLISHER if publishes else FlowSide.SUBSCRIPTION
    answer = feasibility(rmw, side, each.need.unique)
    must = each.need.unique is UniqueRequirement.STRICTLY_REQUIRED
    what = f"{each.need.kind.noun} {each.need.name!r} of {node.key!r}"
    yield from _judge(each, what, answer, capabilities(rmw).unique(side), must=must)


def _judge(
    each: ResolvedNeed, what: str, answer: Feasibility, cell: Capability, *, must: bool
) -> Iterator[Diagnostic]:
    if answer.feasible:
        return
    why, _, hint = answer.why.rpartition("; ")
    message = f"cannot meet the need of {what}: {why} [{cell.source}]"
    make = error if must and answer.feasible is False else warning
    yield make("check.rmw", each.need.at, message, hint)


_RULE = "check.flow-transport"


def check_transport(
    system: DeclaredSystem, needs: FlowNeeds, environment: Mapping[str, str]
) -> Iterator[Diagnostic]:
    """Yield findings about transports and datagrams."""
    for node in system.manifest.nodes:
        for each in needs.of_node(node):
            if each.need.transport is not FlowTransport.ANY:
                yield from _wish(system, node, each, environment)
            if each.need.kind is EndpointKind.PUBLISHER:
                yield from _fragments(system, node, each)
    for link in system.manifest.links:
        if link.transport is not FlowTransport.ANY:
            yield from _link(system, link, environment)
    yield from _ipv6(system, environment)


def _wish(
    system: DeclaredSystem, node: Node, each: ResolvedNeed, environment: Mapping[str, str]
) -> Iterator[Diagnostic]:
    need = each.need
    yield from _foreign(system, node, each)
    yield from _rmw(node, need.transport, need.at, environment)
    if need.lossy is False and need.transport is FlowTransport.MULTICAST:
        message = (
            f"cannot send {need.name!r} of {node.key!r} by multicast: its data are declared not "
            "lossy"
        )
        hint = "use 'transport: tcpv4', or remove 'lossy: false'"
        yield error(_RULE, need.at, message, hint)
    other = (
        EndpointKind.SUBSCRIPTION if need.kind is EndpointKind.PUBLISHER else EndpointKind.PUBLISHER
    )
    for end in system.named(other, each.topic):
        ends = (node, end.node) if need.kind is EndpointKind.PUBLISHER else (end.node, node)
        yield from _pair(system, ends, each.topic, need.transport, need.at)


def _link(
    system: DeclaredSystem, link: Link, environment: Mapping[str, str]
) -> Iterator[Diagnostic]:
    ends = [system.nodes.get(key) for key in (link.from_node, link.to_node)]
    if ends[0] is None or ends[1] is None:
        return  # reported by check.link-unknown-node
    for node in ends:
        if node is not None:
            yield from _rmw(node, link.transport, link.at, environment)
    yield from _pair(system, (ends[0], ends[1]), link.topic, link.transport, link.at)


def _foreign(system: DeclaredSystem, node: Node, each: ResolvedNeed) -> Iterator[Diagnostic]:
    """Warn where a participant is not ours: its transports can only be set from outside."""
    need = each.need
    supervised = system.manifest.data_layer.authority is Authority.SUPERVISOR and node.managed
    if node.run.kind is RunKind.PYTHON or supervised:
        return
    what = f"{need.kind.noun} {need.name!r} of {node.key!r}"
    value = need.transport.builtin
    if value is None:
        message = (
            f"cannot carry {what} by {need.transport.value}: its participant is not ours to connect"
        )
        hint = "write it as 'run: {python: module:Class}'"
        yield error(_RULE, need.at, message, hint)
        return
    hint = (
        f"set '{TRANSPORTS_VARIABLE}: {value}' in its 'run.environment'"
        if node.run.kind is RunKind.COMMAND
        else f"start it with {TRANSPORTS_VARIABLE}={value}"
    )
    message = (
        f"cannot keep {what} off shared memory: its participant is not ours"
        if need.transport is FlowTransport.NETWORK
        else f"cannot choose {need.transport.value} for {what}: its participant is not ours"
    )
    yield warning(_RULE, need.at, message, hint)


def _rmw(
    node: Node, transport: FlowTransport, at: Position, environment: Mapping[str, str]
) -> Iterator[Diagnostic]:
    rmw = rmw_of(node, environment)
    if transport is not FlowTransport.NETWORK and not rmw.startswith(FAST_DDS):
        message = f"cannot choose {transport.value} for {node.key!r} with {rmw}: only for Fast DDS"
        hint = "set RMW_IMPLEMENTATION=rmw_fastrtps_cpp"
        yield error(_RULE, at, message, hint)


def _pair(
    system: DeclaredSystem,
    ends: tuple[Node, Node],
    topic: str,
    transport: FlowTransport,
    at: Position,
) -> Iterator[Diagnostic]:
    """Judge what is asked for between two nodes by where they run."""
    node, end = ends
    one, two = _address(system, node), _address(system, end)
    if one == two and _process(end) == _process(node):
        if transport in (FlowTransport.SHM, FlowTransport.MULTICAST):
            return
        by = "the network" if transport is FlowTransport.NETWORK else transport.value
        both = "it" if node is end else f"{node.key!r} and {end.key!r}"
        message = (
            f"cannot send {topic!r} from process {_process(node)!r} to itself by {by}: {both} "
            f"{'is' if node is end else 'are'} in it, and inside a process no transport is used"
        )
        hint = f"give one of the two another 'process:', or drop 'transport: {transport.value}'"
        yield error(_RULE, at, message, hint)
        return
    if one == two:
        return
    here = "this host"
    between = f"between {node.key!r} at {one or here} and {end.key!r} at {two or here}"
    if transport is FlowTransport.SHM:
        message = f"cannot send {topic!r} by shm {between}: shared memory does not leave a host"
        yield error(_RULE, at, message, "use 'transport: udpv4' or 'tcpv4'")
    elif one and two and (":" in one) != (":" in two):
        message = (
            f"cannot send {topic!r} by the network {between}: one address is IPv6, the other is not"
        )
        yield error(_RULE, at, message, "give both one kind of address")
    else:
        version = transport.medium.ip_version if transport.medium else None
        wrong = [each for each in (one, two) if each and (6 if ":" in each else 4) != version]
        if version and wrong:
            message = (
                f"cannot send {topic!r} by {transport.value} {between}: {wrong[0]} is no "
                f"IPv{version} address"
            )
            hint = "use 'transport: udpv6'" if version == 4 else "use 'transport: udpv4' or 'tcpv4'"
            yield error(_RULE, at, message, hint)


def _process(node: Node) -> str:
    return node.process or node.key


def _address(system: DeclaredSystem, node: Node) -> str:
    return next(
        (each.address for each in system.manifest.machines if each.name == node.machine), ""
    )


def _fragments(system: DeclaredSystem, node: Node, each: ResolvedNeed) -> Iterator[Diagnostic]:
    size = each.max_message_size
    if each.max_datagram_bytes is None or size is None:
        return
    limit = system.manifest.network.max_datagram_bytes or max_unfragmented(
        ipv6=":" in _address(system, node)
    )
    declared = "declared" if each.need.max_message_size is not None else "the bound of its type"
    message = (
        f"cannot send a message of {each.need.name!r}, up to {size} bytes ({declared}), in one "
        f"datagram: with {RTPS_OVERHEAD_BYTES} bytes of RTPS it is {datagram_bytes(size)} of UDP "
        f"payload and {limit} fit; of IP's fragments only the first has ports, so a network would "
        f"not know the others as this flow"
    )
    if node.run.kind is RunKind.PYTHON:
        hint = (
            f"its participant sends datagrams of at most {each.max_datagram_bytes} bytes; a lost "
            f"one costs a BEST_EFFORT message"
        )
    else:
        hint = (
            f"start it with {TRANSPORTS_VARIABLE}='UDPv4?max_msg_size={each.max_datagram_bytes}B'"
        )
    yield warning("check.flow-fragments", each.need.at, message, hint)


def _ipv6(system: DeclaredSystem, environment: Mapping[str, str]) -> Iterator[Diagnostic]:
    """Warn of IPv6 machines under Fast DDS's default transports, which are IPv4 and shared memory.

    Without IPv6 in them, participants neither find nor reach each other over such addresses.
    """
    discovery = system.manifest.discovery
    if discovery.mode is not DiscoveryMode.DYNAMIC or discovery.transport is not FlowTransport.ANY:
        return  # the planner gives participants what the addresses need
    if "v6" in environment.get(TRANSPORTS_VARIABLE, "").lower() or _profiles(environment):
        return
    for machine in system.manifest.machines:
        nodes = [node for node in system.manifest.nodes if node.machine == machine.name]
        if ":" not in machine.address or all(
            "v6" in dict(node.run.environment).get(TRANSPORTS_VARIABLE, "").lower()
            or _profiles(dict(node.run.environment))
            for node in nodes
        ):
            continue
        message = (
            f"cannot reach machine {machine.name!r} at {machine.address} by default: Fast DDS uses "
            f"UDPv4 and shared memory"
        )
        hint = f"set {TRANSPORTS_VARIABLE}=UDPv6 for every process of the system, this one included"
        yield warning("check.ipv6-transports", machine.at, message, hint)


def _profiles(environment: Mapping[str, str]) -> bool:
    """Whether a profile file is loaded that may say anything."""
    return any(
        environment.get(name)
        for name in ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
    )
