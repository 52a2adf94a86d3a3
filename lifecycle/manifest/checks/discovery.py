"""Checks of discovery, RMW, domain and participants; of transports and datagrams of flows.

What happens at run time decides; these only fail earlier. Whether two nodes have a transport in
common is the planner's to say (plan.unconnectable). Pure.
"""

from __future__ import annotations

import functools
import ipaddress
from collections.abc import Iterator, Mapping

from lifecycle.errors import did_you_mean
from lifecycle.manifest.checks.system import DeclaredSystem
from lifecycle.manifest.diagnostics import Diagnostic, Position, error, note, warning
from lifecycle.manifest.flows import ResolvedNeed
from lifecycle.manifest.model import (
    Authority,
    DataLayerSource,
    Discovery,
    DiscoveryMode,
    DiscoveryRange,
    EndpointKind,
    FlowTransport,
    Machine,
    Node,
    RunKind,
)
from lifecycle.network.medium import (
    DEFAULT_RMW,
    DEFAULT_TCP,
    FAST_DDS,
    RTPS_OVERHEAD_BYTES,
    TRANSPORTS_VARIABLE,
    datagram_bytes,
    max_unfragmented,
)
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.network.ports import (
    LINUX,
    LOCALHOST_PARTICIPANTS,
    LOCALHOST_PEERS_RANGE,
    EphemeralRange,
    describe_domains,
    domain_of,
    max_participants,
    overflows,
    safe_domains,
)

_OTHERS = ("rmw_cyclonedds", "rmw_zenoh", "rmw_connextdds")
"""RMWs that are known to give no endpoint a network flow or a DSCP of its own."""


def check_discovery(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about discovery and the data layer's authority."""
    yield from _range(system)
    yield from _addresses(system)
    yield from _transport(system)
    yield from _server(system)
    yield from _rmws(system)
    for node in system.manifest.nodes:
        yield from _foreign_rmws(system.manifest.discovery, node)
    yield from _authority(system)


def _mode(discovery: Discovery) -> str:
    return f"discovery mode {discovery.mode.value}"


def _range(system: DeclaredSystem) -> Iterator[Diagnostic]:
    discovery = system.manifest.discovery
    at = system.manifest.where("discovery.range")
    if (
        discovery.mode is not DiscoveryMode.DYNAMIC
        and discovery.range is not DiscoveryRange.SYSTEM_DEFAULT
    ):
        message = (
            f"cannot use range {discovery.range.value!r} in {_mode(discovery)}: rmw would add "
            "peers or multicast to what is planned"
        )
        yield error("check.discovery-range", at, message, "remove 'range'")


def _addresses(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Judge addresses that others must know beforehand."""
    discovery, found = system.manifest.discovery, system.hosts
    at = system.manifest.where("discovery.mode")
    if discovery.mode is DiscoveryMode.DYNAMIC or len(found) < 2:
        return
    for machine in found.get("", ()):
        message = (
            f"cannot plan {_mode(discovery)} without an address of machine {machine.name!r}: the "
            "others must know where it is reached"
        )
        yield error("check.discovery-address", machine.at, message, "add 'address:' to it")
    for address, machines in found.items():
        if address and ipaddress.ip_address(address).is_loopback:
            message = (
                f"cannot reach machine {machines[0].name!r} at {address} from another machine: it "
                "is a loopback address"
            )
            hint = "give it the address of an interface"
            yield error("check.discovery-address", machines[0].at, message, hint)
    families = {":" in address for address in found if address}
    if len(families) > 1:
        spelled = ", ".join(sorted(address for address in found if address))
        message = (
            f"cannot plan {_mode(discovery)} with addresses {spelled}: own participants use one IP "
            "version"
        )
        hint = "give all machines one kind of address"
        yield error("check.discovery-address", at, message, hint)


def _transport(system: DeclaredSystem) -> Iterator[Diagnostic]:
    discovery = system.manifest.discovery
    at = system.manifest.where("discovery.transport")
    transport, found = discovery.transport, system.hosts
    medium = transport.medium
    rule, what = "check.discovery-transport", f"cannot let discovery use {transport.value} alone"
    if transport.in_memory and len(found) > 1:
        names = ", ".join(repr(machine.name) for each in found.values() for machine in each)
        message = f"{what} between machines {names}: shared memory does not leave a host"
        hint = "use 'transport: udpv4', and connections for the data"
        yield error(rule, at, message, hint)
    if transport.in_memory and discovery.mode is DiscoveryMode.SERVER:
        message = f"{what} with a discovery server: it is reached by TCP or UDP"
        yield error(rule, at, message, "use 'transport: tcpv4', or remove it")
    if medium and medium.ip_version == 6 and discovery.mode is DiscoveryMode.SERVER:
        message = f"{what} with a discovery server: it is reached by IPv4"
        yield error(rule, at, message, "use 'transport: tcpv4' or 'udpv4'")
    if medium and medium.is_tcp and discovery.mode is DiscoveryMode.DYNAMIC:
        message = f"{what} in mode dynamic: TCP has no multicast to find anybody by"
        yield error(rule, at, message, "use 'mode: static' or 'mode: server'")
    if discovery.mode is DiscoveryMode.SERVER and transport is FlowTransport.ANY:
        medium = DEFAULT_TCP
    version = medium.ip_version if medium else None
    for address, machines in found.items():
        if version and address and ipaddress.ip_address(address).version != version:
            message = (
                f"cannot reach machine {machines[0].name!r} at {address} by {medium}, which "
                "discovery uses"
            )
            hint = f"give it an IPv{version} address, or use another 'transport'"
            yield error(rule, machines[0].at, message, hint)


def _server(system: DeclaredSystem) -> Iterator[Diagnostic]:
    discovery = system.manifest.discovery
    name = discovery.server_machine
    at = system.manifest.where("discovery.server_machine")
    if not name:
        return
    if discovery.mode is not DiscoveryMode.SERVER:
        message = f"cannot run a discovery server on {name!r} in {_mode(discovery)}"
        hint = "use 'mode: server', or remove 'server_machine'"
        yield error("check.discovery-server", at, message, hint)
    machines = [each.name for each in system.manifest.machines]
    if name not in machines:
        message = f"cannot run the discovery server on machine {name!r}: there is no such machine"
        hint = did_you_mean(name, machines) or "declare it under 'machines:'"
        yield error("check.discovery-server", at, message, hint)
    elif name not in {node.machine for node in system.manifest.nodes}:
        message = (
            f"cannot run the discovery server on machine {name!r}: no node runs there, so nobody "
            "starts a supervisor"
        )
        yield error("check.discovery-server", at, message, "choose a machine that runs a node")


def _rmws(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Only Fast DDS can be configured so; a server serves only its own kind."""
    discovery = system.manifest.discovery
    dynamic = discovery.mode is DiscoveryMode.DYNAMIC
    at = system.manifest.where(f"discovery.{'transport' if dynamic else 'mode'}")
    if dynamic and discovery.transport is FlowTransport.ANY:
        return
    by_rmw: dict[str, list[str]] = {}
    for node in system.manifest.nodes:
        by_rmw.setdefault(system.rmw_of(node), []).append(node.key)
    if discovery.mode is DiscoveryMode.SERVER and len(by_rmw) > 1:
        spelled = "; ".join(f"{rmw}: {', '.join(keys)}" for rmw, keys in by_rmw.items())
        message = f"cannot serve more than one RMW by a discovery server ({spelled})"
        yield error("check.discovery-rmw", at, message, "use one RMW_IMPLEMENTATION")
    for rmw, keys in by_rmw.items():
        if not rmw.startswith(FAST_DDS):
            why = (
                f"with transport {discovery.transport.value}"
                if dynamic
                else f"in {_mode(discovery)}"
            )
            names = ", ".join(map(repr, keys))
            message = f"cannot connect {names} {why} with {rmw}: only Fast DDS can be told to"
            yield error(
                "check.discovery-rmw", at, message, "set RMW_IMPLEMENTATION=rmw_fastrtps_cpp"
            )


def _foreign_rmws(discovery: Discovery, node: Node) -> Iterator[Diagnostic]:
    """Judge a node whose participant is not ours to make; variables can configure a command's."""
    transport = discovery.transport
    if node.run.kind is RunKind.PYTHON or (
        discovery.mode is DiscoveryMode.DYNAMIC and transport is FlowTransport.ANY
    ):
        return
    by_variable = (
        discovery.mode in (DiscoveryMode.DYNAMIC, DiscoveryMode.SERVER) or transport.in_memory
    ) and discovery.mode is not DiscoveryMode.STATIC_ENDPOINTS
    if node.run.kind is RunKind.COMMAND and by_variable:
        return
    what = f"{_mode(discovery)}{'' if transport is FlowTransport.ANY else f' by {transport.value}'}"
    if node.run.kind is RunKind.ATTACH:
        why = "it is attached, and its participant configured where it is started"
    elif discovery.mode is DiscoveryMode.STATIC_ENDPOINTS:
        why = "its endpoints are its own code's, and no table of ours has them"
    else:
        why = "no variable gives a process fixed ports and peers"
    message = f"cannot take {node.key!r} into {what}: {why}"
    hint = "write it as 'run: {python: module:Class}', or use 'mode: dynamic'"
    yield error("check.discovery-foreign", node.where("run"), message, hint)


def _authority(system: DeclaredSystem) -> Iterator[Diagnostic]:
    layer = system.manifest.data_layer
    if layer.authority is Authority.NODES and layer.source is DataLayerSource.DYNAMIC:
        message = (
            "cannot make the data layer graph from node configurations under authority 'nodes': "
            "each node only follows what it was started with, and nobody would negotiate"
        )
        hint = "use 'authority: supervisor', or 'source: static'"
        at = system.manifest.where("data_layer.source")
        yield error("check.authority", at, message, hint)
    if layer.authority is not Authority.SUPERVISOR:
        return
    for node in system.manifest.nodes:
        if not node.managed:
            message = (
                f"cannot leave the connections of {node.key!r} to the supervisor: it is not "
                "managed, and has its endpoints as soon as it runs"
            )
            hint = "remove 'managed: false', or use 'authority: nodes'"
            yield error("check.authority", node.at, message, hint)


def check_middleware(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about what the RMW of a node cannot do; Fast DDS does all of it."""
    for node in system.manifest.nodes:
        rmw = system.rmw_of(node)
        if rmw.startswith(FAST_DDS):
            continue
        why = f"{rmw} cannot" if rmw.startswith(_OTHERS) else f"it is not known whether {rmw} can"
        for each in system.needs.of_node(node):
            what = f"{each.need.kind.noun} {each.need.name!r} of {node.key!r}"
            strictly = each.need.unique is UniqueRequirement.STRICTLY_REQUIRED
            wishes = []
            if strictly or each.need.unique is UniqueRequirement.OPTIONALLY_REQUIRED:
                wishes.append(("give it a network flow of its own", strictly))
            if each.dscp is not None:
                wishes.append(("mark its packets with a DSCP", each.need.enforce))
            for wish, must in wishes:
                make = error if must and rmw.startswith(_OTHERS) else warning
                message = f"cannot meet the need of {what}: {why} {wish}"
                hint = f"use RMW_IMPLEMENTATION={DEFAULT_RMW}"
                yield make("check.rmw", each.need.at, message, hint)


_RULE = "check.flow-transport"


def check_transport(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about transports and datagrams."""
    for node in system.manifest.nodes:
        for each in system.needs.of_node(node):
            if each.need.transport is not FlowTransport.ANY:
                yield from _wish(system, node, each)
            if each.need.kind is EndpointKind.PUBLISHER:
                yield from _fragments(system, node, each)
    for link in system.manifest.links:
        for end in (link.from_node, link.to_node):
            if link.transport is not FlowTransport.ANY and end in system.nodes:
                yield from _rmw(system, system.nodes[end], link.transport, link.at)
    yield from _ipv6(system)


def _wish(system: DeclaredSystem, node: Node, each: ResolvedNeed) -> Iterator[Diagnostic]:
    need = each.need
    yield from _foreign(system, node, each)
    yield from _rmw(system, node, need.transport, need.at)
    if need.lossy is False and need.transport is FlowTransport.MULTICAST:
        message = (
            f"cannot send {need.name!r} of {node.key!r} by multicast: its data are declared not "
            "lossy"
        )
        hint = "use 'transport: tcpv4', or remove 'lossy: false'"
        yield error(_RULE, need.at, message, hint)


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
    system: DeclaredSystem, node: Node, transport: FlowTransport, at: Position
) -> Iterator[Diagnostic]:
    rmw = system.rmw_of(node)
    if transport is not FlowTransport.NETWORK and not rmw.startswith(FAST_DDS):
        message = f"cannot choose {transport.value} for {node.key!r} with {rmw}: only for Fast DDS"
        hint = "set RMW_IMPLEMENTATION=rmw_fastrtps_cpp"
        yield error(_RULE, at, message, hint)


def _fragments(system: DeclaredSystem, node: Node, each: ResolvedNeed) -> Iterator[Diagnostic]:
    size = each.need.max_message_size
    if each.max_datagram_bytes is None or size is None:
        return
    limit = system.manifest.network.max_datagram_bytes or max_unfragmented(
        ipv6=":" in system.manifest.address_of(node.machine)
    )
    message = (
        f"cannot send a message of {each.need.name!r}, up to {size} bytes (declared), in one "
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
    yield note("check.flow-fragments", each.need.at, message, hint)


def _ipv6(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Warn of IPv6 machines under Fast DDS's default transports: IPv4 and shared memory."""
    discovery = system.manifest.discovery
    if discovery.mode is not DiscoveryMode.DYNAMIC or discovery.transport is not FlowTransport.ANY:
        return  # the planner gives participants what the addresses need
    if _has_ipv6(system.environment):
        return
    for machine in system.manifest.machines:
        nodes = [node for node in system.manifest.nodes if node.machine == machine.name]
        if ":" not in machine.address or all(
            _has_ipv6(dict(node.run.environment)) for node in nodes
        ):
            continue
        message = (
            f"cannot reach machine {machine.name!r} at {machine.address} by default: Fast DDS uses "
            f"UDPv4 and shared memory"
        )
        hint = f"set {TRANSPORTS_VARIABLE}=UDPv6 for every process of the system, this one included"
        yield warning("check.ipv6-transports", machine.at, message, hint)


def _has_ipv6(environment: Mapping[str, str]) -> bool:
    """Whether variables give a process IPv6, or a profile file that may say anything."""
    return "v6" in environment.get(TRANSPORTS_VARIABLE, "").lower() or any(
        environment.get(name)
        for name in ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
    )


_NO_EPHEMERAL = EphemeralRange(first=1, last=1)
"""Asks for the limits that hold whatever an operating system does with its ports."""


_SUPERVISOR = 1
"""The observer of the supervisor that each host has."""


def check_ports(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about the domain, and about room for all participants.

    ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE hold where the manifest leaves them open.
    """
    discovery = system.manifest.discovery
    domain = discovery.domain_id
    if domain is None:
        # One that is no domain is the environment's fault, and refused where it is used.
        domain = domain_of(system.environment.get("ROS_DOMAIN_ID", "")) or 0
    start = Position(file=system.manifest.path, line=1, column=1, path="discovery.domain_id")
    section = system.manifest.positions.get("discovery")
    at = section or start
    try:
        room = max_participants(domain, LINUX).participants
    except ValueError as problem:  # of a manifest that was made by code
        message, _, hint = str(problem).partition("; ")
        yield error("check.domain", at, message, hint)
        return
    if room == 0:
        domains = describe_domains(safe_domains(LINUX))
        message = (
            f"cannot be sure of the ports of domain {domain}: Linux gives them to other sockets, "
            f"by default"
        )
        yield note("check.domain", at, message, f"use domain {domains}")
    for host in system.hosts.values():
        yield from _crowded(system, host, domain, section or host[0].at)
        yield from _beyond_localhost(system, host)


def _crowded(
    system: DeclaredSystem, host: list[Machine], domain: int, at: Position
) -> Iterator[Diagnostic]:
    nodes = _nodes_on(system, host)
    over = functools.partial(
        overflows,
        domain,
        participants=_SUPERVISOR + _participants(nodes, system),
        unique_subscriptions=sum(
            each.unique and each.need.kind is EndpointKind.SUBSCRIPTION
            for node in nodes
            for each in system.needs.of_node(node)
        ),
        host=_spell_host(nodes),
    )
    refused = over(ephemeral=_NO_EPHEMERAL)
    for each in refused:
        message, _, hint = each.partition("; ")
        yield error("check.ports", at, message, hint)
    # Where no participant at all is safe, check.domain has reported it.
    if not refused and max_participants(domain, LINUX).participants:
        for each in over(ephemeral=LINUX):
            message, _, hint = each.partition("; ")
            yield note("check.ports", at, message, hint)


def _nodes_on(system: DeclaredSystem, host: list[Machine]) -> list[Node]:
    names = {machine.name for machine in host}
    return [node for node in system.manifest.nodes if node.machine in names]


def _spell_host(nodes: list[Node]) -> str:
    used = dict.fromkeys(node.machine for node in nodes)
    return f"machine{'s' * (len(used) > 1)} {', '.join(map(repr, used))}"


_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"


_OTHERWISE_FOUND = frozenset(
    {
        _RANGE,
        "FASTDDS_DEFAULT_PROFILES_FILE",
        "FASTRTPS_DEFAULT_PROFILES_FILE",
        "ROS_DISCOVERY_SERVER",
        "ROS_DOMAIN_ID",
    }
)
"""Variables of a process by which it may find others in another way than its system."""


def _beyond_localhost(system: DeclaredSystem, host: list[Machine]) -> Iterator[Diagnostic]:
    """Yield a finding where participants of a host could not all find each other on localhost.

    Counted is what certainly looks for others in the way of rmw_fastrtps: the supervisor's
    participant, and those of processes that it starts.
    """
    discovery = system.manifest.discovery
    if discovery.mode is not DiscoveryMode.DYNAMIC or not discovery.transport.by_udp:
        return
    said = "'range: localhost'"
    if discovery.range is DiscoveryRange.SYSTEM_DEFAULT:
        said = f"{_RANGE}={system.environment.get(_RANGE, '')}"
        if system.environment.get(_RANGE, "") != DiscoveryRange.LOCALHOST.name:
            return
    elif discovery.range is not DiscoveryRange.LOCALHOST:
        return
    profiles = _OTHERWISE_FOUND - {_RANGE, "ROS_DOMAIN_ID"}
    nodes = [
        node
        for node in _nodes_on(system, host)
        if node.run.kind is not RunKind.ATTACH
        and system.rmw_of(node).startswith("rmw_fastrtps")
        and not _OTHERWISE_FOUND & {name for name, _ in node.run.environment}
        and not any(system.environment.get(name) for name in profiles)
    ]
    participants = _SUPERVISOR + _participants(nodes, system)
    if participants <= LOCALHOST_PARTICIPANTS:
        return
    message = (
        f"cannot run {participants} participants with {said} on {_spell_host(nodes)}: at most "
        f"{LOCALHOST_PARTICIPANTS} all find each other, because each looks for participants 0 to "
        f"{LOCALHOST_PEERS_RANGE - 1} of its host only"
    )
    hint = "use 'range: subnet', or give several nodes one 'process:'"
    at = system.manifest.positions.get("discovery", nodes[0].at)
    yield error("check.localhost", at, message, hint)


def _participants(nodes: list[Node], system: DeclaredSystem) -> int:
    """Count DDS participants as the planner makes them.

    One for each process and each choice of transports in it, and one more for each group of
    publishers that need their own.
    """
    needs = system.needs
    shared = {(node.process or f"\0{node.key}", needs.node_transports(node)) for node in nodes}
    extra = 0
    for node in nodes:
        if node.run.kind is RunKind.PYTHON:
            on_connections = {entry for each in node.connections for entry in each.map}
            extra += sum(
                any((group.kind, name) not in on_connections for name in group.names)
                for group in needs.groups(node)
            )
    return len(shared) + extra


CHECKS = (
    check_discovery,
    check_transport,
    check_middleware,
    check_ports,
)
