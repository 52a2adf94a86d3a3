"""Checks of discovery, RMW, domain and participants; of transports and datagrams of flows.

What happens at run time decides; these only fail earlier. Whether two nodes have a transport in
common is the planner's to say (plan.unconnectable). Pure.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator, Mapping

from lifecycle.errors import did_you_mean
from lifecycle.manifest.checks.system import DeclaredSystem
from lifecycle.manifest.diagnostics import Diagnostic, Position, error, note, warning
from lifecycle.manifest.flows import ResolvedNeed
from lifecycle.manifest.model import (
    Authority,
    DataLayerSource,
    DiscoveryMode,
    DiscoveryRange,
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
    describe_domains,
    domain_of,
    max_participants,
    safe_domains,
)

_OTHERS = ("rmw_cyclonedds", "rmw_zenoh", "rmw_connextdds")
"""RMWs that are known to give no endpoint a network flow or a DSCP of its own."""

_USE_FAST_DDS = f"set RMW_IMPLEMENTATION={DEFAULT_RMW}"


def _is_default(system: DeclaredSystem) -> bool:
    """Whether participants find each other by what the middleware does by itself."""
    discovery = system.manifest.discovery
    return (discovery.mode, discovery.transport) == (DiscoveryMode.DYNAMIC, FlowTransport.ANY)


def check_range(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield a finding about a range that would add to what is planned."""
    discovery = system.manifest.discovery
    is_dynamic = discovery.mode is DiscoveryMode.DYNAMIC
    if not is_dynamic and discovery.range is not DiscoveryRange.SYSTEM_DEFAULT:
        message = (
            f"cannot use range {discovery.range.value!r} in discovery mode {discovery.mode.value}: "
            "rmw would add peers or multicast to what is planned"
        )
        at = system.manifest.where("discovery.range")
        yield error("check.discovery-range", at, message, "remove 'range'")


def check_addresses(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about addresses that others must know beforehand."""
    rule, discovery, hosts = "check.discovery-address", system.manifest.discovery, system.hosts
    if discovery.mode is DiscoveryMode.DYNAMIC or len(hosts) < 2:
        return
    mode = f"discovery mode {discovery.mode.value}"
    for machine in hosts.get("", ()):
        message = (
            f"cannot plan {mode} without an address of machine {machine.name!r}: the "
            "others must know where it is reached"
        )
        yield error(rule, machine.at, message, "add 'address:' to it")
    known = sorted(filter(None, hosts))
    for address in known:
        machine = hosts[address][0]
        if ipaddress.ip_address(address).is_loopback:
            message = (
                f"cannot reach machine {machine.name!r} at {address} from another machine: it "
                "is a loopback address"
            )
            yield error(rule, machine.at, message, "give it the address of an interface")
    if len({":" in address for address in known}) > 1:
        message = (
            f"cannot plan {mode} with addresses {', '.join(known)}: own participants use one IP "
            "version"
        )
        at = system.manifest.where("discovery.mode")
        yield error(rule, at, message, "give all machines one kind of address")


def check_discovery_transport(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about a transport by which nodes would not find each other."""
    discovery, hosts = system.manifest.discovery, system.hosts
    at = system.manifest.where("discovery.transport")
    transport, medium = discovery.transport, discovery.transport.medium
    rule, what = "check.discovery-transport", f"cannot let discovery use {transport.value} alone"
    if transport.in_memory and len(hosts) > 1:
        names = ", ".join(repr(machine.name) for each in hosts.values() for machine in each)
        message = f"{what} between machines {names}: shared memory does not leave a host"
        hint = "use 'transport: udpv4', and connections for the data"
        yield error(rule, at, message, hint)
    if discovery.mode is DiscoveryMode.SERVER:
        if transport.in_memory:
            message = f"{what} with a discovery server: it is reached by TCP or UDP"
            yield error(rule, at, message, "use 'transport: tcpv4', or remove it")
        if medium and medium.ip_version == 6:
            message = f"{what} with a discovery server: it is reached by IPv4"
            yield error(rule, at, message, "use 'transport: tcpv4' or 'udpv4'")
        if transport is FlowTransport.ANY:
            medium = DEFAULT_TCP
    elif medium and medium.is_tcp and discovery.mode is DiscoveryMode.DYNAMIC:
        message = f"{what} in mode dynamic: TCP has no multicast to find anybody by"
        yield error(rule, at, message, "use 'mode: static' or 'mode: server'")
    version = medium.ip_version if medium else None
    for address, (machine, *_) in hosts.items():
        if version and address and ipaddress.ip_address(address).version != version:
            message = (
                f"cannot reach machine {machine.name!r} at {address} by {medium}, which "
                "discovery uses"
            )
            hint = f"give it an IPv{version} address, or use another 'transport'"
            yield error(rule, machine.at, message, hint)


def check_server(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about the machine of the discovery server."""
    rule, discovery = "check.discovery-server", system.manifest.discovery
    name = discovery.server_machine
    at = system.manifest.where("discovery.server_machine")
    if name and discovery.mode is not DiscoveryMode.SERVER:
        message = (
            f"cannot run a discovery server on {name!r} in discovery mode {discovery.mode.value}"
        )
        yield error(rule, at, message, "use 'mode: server', or remove 'server_machine'")
    machines = [each.name for each in system.manifest.machines]
    if name and name not in machines:
        message = f"cannot run the discovery server on machine {name!r}: there is no such machine"
        hint = did_you_mean(name, machines) or "declare it under 'machines:'"
        yield error(rule, at, message, hint)
    elif name and name not in {node.machine for node in system.manifest.nodes}:
        message = (
            f"cannot run the discovery server on machine {name!r}: no node runs there, so nobody "
            "starts a supervisor"
        )
        yield error(rule, at, message, "choose a machine that runs a node")


def check_rmws(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Only Fast DDS can be configured so; a server serves only its own kind."""
    if _is_default(system):
        return
    rule, discovery = "check.discovery-rmw", system.manifest.discovery
    by_rmw: dict[str, list[str]] = {}
    for node in system.manifest.nodes:
        by_rmw.setdefault(system.rmw_of(node), []).append(node.key)
    at, how = system.manifest.where("discovery.mode"), f"in discovery mode {discovery.mode.value}"
    if discovery.mode is DiscoveryMode.DYNAMIC:
        at = system.manifest.where("discovery.transport")
        how = f"with transport {discovery.transport.value}"
    if discovery.mode is DiscoveryMode.SERVER and len(by_rmw) > 1:
        spelled = "; ".join(f"{rmw}: {', '.join(keys)}" for rmw, keys in by_rmw.items())
        message = f"cannot serve more than one RMW by a discovery server ({spelled})"
        yield error(rule, at, message, "use one RMW_IMPLEMENTATION")
    for rmw, keys in by_rmw.items():
        if not rmw.startswith(FAST_DDS):
            names = ", ".join(map(repr, keys))
            message = f"cannot connect {names} {how} with {rmw}: only Fast DDS can be told to"
            yield error(rule, at, message, _USE_FAST_DDS)


def check_participant(system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Judge a node whose participant is not ours to make; variables can configure a command's."""
    discovery = system.manifest.discovery
    static_endpoints = discovery.mode is DiscoveryMode.STATIC_ENDPOINTS
    by_variable = not static_endpoints and (
        discovery.mode is not DiscoveryMode.STATIC or discovery.transport.in_memory
    )
    if node.run.kind is RunKind.PYTHON or _is_default(system):
        return
    if node.run.kind is RunKind.ATTACH:
        why = "it is attached, and its participant configured where it is started"
    elif by_variable:
        return
    elif static_endpoints:
        why = "its endpoints are its own code's, and no table of ours has them"
    else:
        why = "no variable gives a process fixed ports and peers"
    by = discovery.transport
    how = "" if by is FlowTransport.ANY else f" by {by.value}"
    message = f"cannot take {node.key!r} into discovery mode {discovery.mode.value}{how}: {why}"
    hint = "write it as 'run: {python: module:Class}', or use 'mode: dynamic'"
    yield error("check.discovery-foreign", node.where("run"), message, hint)


def check_authority(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about who negotiates connections."""
    layer = system.manifest.data_layer
    if layer.authority is Authority.NODES and layer.source is DataLayerSource.DYNAMIC:
        message = (
            "cannot make the data layer graph from node configurations under authority 'nodes': "
            "each node only follows what it was started with, and nobody would negotiate"
        )
        hint = "use 'authority: supervisor', or 'source: static'"
        at = system.manifest.where("data_layer.source")
        yield error("check.authority", at, message, hint)
    for node in system.manifest.nodes:
        if layer.authority is Authority.SUPERVISOR and not node.managed:
            message = (
                f"cannot leave the connections of {node.key!r} to the supervisor: it is not "
                "managed, and has its endpoints as soon as it runs"
            )
            hint = "remove 'managed: false', or use 'authority: nodes'"
            yield error("check.authority", node.at, message, hint)


def check_middleware(system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Yield findings about what the RMW of a node cannot do; Fast DDS does all of it."""
    rmw = system.rmw_of(node)
    if rmw.startswith(FAST_DDS):
        return
    why = f"{rmw} cannot" if rmw.startswith(_OTHERS) else f"it is not known whether {rmw} can"
    for each in system.needs.of_node(node):
        strictly = each.need.unique is UniqueRequirement.STRICTLY_REQUIRED
        wishes = []
        if each.unique:
            wishes.append(("give it a network flow of its own", strictly))
        if each.dscp is not None:
            wishes.append(("mark its packets with a DSCP", each.need.enforce))
        for wish, must in wishes:
            make = error if must and rmw.startswith(_OTHERS) else warning
            what = f"{each.need.kind.noun} {each.need.name!r} of {node.key!r}"
            message = f"cannot meet the need of {what}: {why} {wish}"
            hint = f"use RMW_IMPLEMENTATION={DEFAULT_RMW}"
            yield make("check.rmw", each.need.at, message, hint)


_TRANSPORT = "check.flow-transport"


def check_transport(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about transports that flows and links ask for."""
    chosen = [
        (system.nodes[end], link.transport, link.at)
        for link in system.manifest.links
        for end in (link.from_node, link.to_node)
        if end in system.nodes
    ]
    for node in system.manifest.nodes:
        for each in system.needs.of_node(node):
            need = each.need
            chosen.append((node, need.transport, need.at))
            if need.transport is not FlowTransport.ANY:
                yield from _foreign(system, node, each)
            if need.lossy is False and need.transport is FlowTransport.MULTICAST:
                message = (
                    f"cannot send {need.name!r} of {node.key!r} by multicast: its data are "
                    "declared not lossy"
                )
                hint = "use 'transport: tcpv4', or remove 'lossy: false'"
                yield error(_TRANSPORT, need.at, message, hint)
    for node, transport, at in chosen:
        rmw = system.rmw_of(node)
        is_any = transport in (FlowTransport.ANY, FlowTransport.NETWORK)
        if not is_any and not rmw.startswith(FAST_DDS):
            what = f"{transport.value} for {node.key!r} with {rmw}"
            yield error(_TRANSPORT, at, f"cannot choose {what}: only for Fast DDS", _USE_FAST_DDS)


def _foreign(system: DeclaredSystem, node: Node, each: ResolvedNeed) -> Iterator[Diagnostic]:
    """Warn where a participant is not ours: its transports can only be set from outside."""
    need = each.need
    supervised = system.manifest.data_layer.authority is Authority.SUPERVISOR and node.managed
    if node.run.kind is RunKind.PYTHON or supervised:
        return
    what = f"{need.kind.noun} {need.name!r} of {node.key!r}"
    how, value = need.transport.value, need.transport.builtin
    if value is None:
        message = f"cannot carry {what} by {how}: its participant is not ours to connect"
        hint = "write it as 'run: {python: module:Class}'"
        yield error(_TRANSPORT, need.at, message, hint)
        return
    hint = f"start it with {TRANSPORTS_VARIABLE}={value}"
    if node.run.kind is RunKind.COMMAND:
        hint = f"set '{TRANSPORTS_VARIABLE}: {value}' in its 'run.environment'"
    message = f"cannot choose {how} for {what}: its participant is not ours"
    if need.transport is FlowTransport.NETWORK:
        message = f"cannot keep {what} off shared memory: its participant is not ours"
    yield warning(_TRANSPORT, need.at, message, hint)


def check_fragments(system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Say of which messages a network would not know all packets."""
    for each in system.needs.of_node(node):
        size = each.need.max_message_size
        if each.max_datagram_bytes is None or size is None:
            continue
        limit = system.manifest.network.max_datagram_bytes or max_unfragmented(
            ipv6=":" in system.manifest.address_of(node.machine)
        )
        message = (
            f"cannot send a message of {each.need.name!r}, up to {size} bytes (declared), in one "
            f"datagram: with {RTPS_OVERHEAD_BYTES} bytes of RTPS it is {datagram_bytes(size)} of "
            f"UDP payload and {limit} fit; of IP's fragments only the first has ports, so a "
            "network would not know the others as this flow"
        )
        most = each.max_datagram_bytes
        hint = f"start it with {TRANSPORTS_VARIABLE}='UDPv4?max_msg_size={most}B'"
        if node.run.kind is RunKind.PYTHON:
            hint = (
                f"its participant sends datagrams of at most {most} bytes; a lost one costs a "
                "BEST_EFFORT message"
            )
        yield note("check.flow-fragments", each.need.at, message, hint)


def check_ipv6(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Warn of IPv6 machines under Fast DDS's default transports: IPv4 and shared memory."""
    if not _is_default(system):
        return  # the planner gives participants what the addresses need
    for machine in system.manifest.machines:
        nodes = [node for node in system.manifest.nodes if node.machine == machine.name]
        if ":" not in machine.address or all(
            _has_ipv6({**system.environment, **dict(node.run.environment)}) for node in nodes
        ):
            continue
        message = (
            f"cannot reach machine {machine.name!r} at {machine.address} by default: Fast DDS uses "
            f"UDPv4 and shared memory"
        )
        hint = f"set {TRANSPORTS_VARIABLE}=UDPv6 for every process of the system, this one included"
        yield warning("check.ipv6-transports", machine.at, message, hint)


_PROFILES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")


def _has_ipv6(environment: Mapping[str, str]) -> bool:
    """Whether variables give a process IPv6, or a profile file that may say anything."""
    return "v6" in environment.get(TRANSPORTS_VARIABLE, "").lower() or any(
        environment.get(name) for name in _PROFILES
    )


def check_ports(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about the domain, and about room for all participants.

    ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE hold where the manifest leaves them open.
    """
    domain = system.manifest.discovery.domain_id
    if domain is None:
        # One that is no domain is the environment's fault, and refused where it is used.
        domain = domain_of(system.environment.get("ROS_DOMAIN_ID", "")) or 0
    start = Position(file=system.manifest.path, line=1, column=1, path="discovery.domain_id")
    section = system.manifest.positions.get("discovery")
    try:
        room = max_participants(domain, LINUX).participants
    except ValueError as problem:  # of a manifest that was made by code
        message, _, hint = str(problem).partition("; ")
        yield error("check.domain", section or start, message, hint)
        return
    if room == 0:
        message = (
            f"cannot be sure of the ports of domain {domain}: Linux gives them to other sockets, "
            f"by default"
        )
        hint = f"use domain {describe_domains(safe_domains(LINUX))}"
        yield note("check.domain", section or start, message, hint)
    for host in system.hosts.values():
        at = section or host[0].at
        nodes = _nodes_on(system, host)
        needed = _participants(nodes, system)
        # What holds whatever an operating system does with its ports, then Linux's default.
        for ephemeral, make in ((range(0), error), (LINUX if room else range(0), note)):
            capacity = max_participants(domain, ephemeral)
            if needed > capacity.participants:
                message = (
                    f"cannot run {needed} participants in domain {domain} on "
                    f"{_spell_host(nodes)}: {capacity.participants} fit before {capacity.limit}"
                )
                hint = "use another domain, run fewer processes, or have fewer unique publishers"
                yield make("check.ports", at, message, hint)
                break
        yield from _beyond_localhost(system, host)


def _nodes_on(system: DeclaredSystem, host: list[Machine]) -> list[Node]:
    names = {machine.name for machine in host}
    return [node for node in system.manifest.nodes if node.machine in names]


def _spell_host(nodes: list[Node]) -> str:
    used = dict.fromkeys(node.machine for node in nodes)
    return f"machine{'s' * (len(used) > 1)} {', '.join(map(repr, used))}"


_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"

_BY_OTHER_MEANS = (*_PROFILES, "ROS_DISCOVERY_SERVER")
"""Variables by which a process may find others in another way than by the range."""


def _beyond_localhost(system: DeclaredSystem, host: list[Machine]) -> Iterator[Diagnostic]:
    """Yield a finding where participants of a host could not all find each other on localhost.

    Counted is what certainly looks for others in the way of rmw_fastrtps: the supervisor's
    participant, and those of processes that it starts.
    """
    discovery = system.manifest.discovery
    said, is_local = "'range: localhost'", discovery.range is DiscoveryRange.LOCALHOST
    if discovery.range is DiscoveryRange.SYSTEM_DEFAULT:
        said = f"{_RANGE}={system.environment.get(_RANGE, '')}"
        is_local = said.endswith(f"={DiscoveryRange.LOCALHOST.name}")
    if (
        not is_local
        or discovery.mode is not DiscoveryMode.DYNAMIC
        or not discovery.transport.by_udp
        or any(system.environment.get(name) for name in _BY_OTHER_MEANS)
    ):
        return
    otherwise = {_RANGE, "ROS_DOMAIN_ID", *_BY_OTHER_MEANS}
    nodes = [
        node
        for node in _nodes_on(system, host)
        if node.run.kind is not RunKind.ATTACH
        and system.rmw_of(node).startswith("rmw_fastrtps")
        and otherwise.isdisjoint(dict(node.run.environment))
    ]
    participants = _participants(nodes, system)
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

    The supervisor's, one for each process and each choice of transports in it, and one more for
    each group of publishers that need their own.
    """
    needs = system.needs
    shared = {(node.process or f"\0{node.key}", needs.node_transports(node)) for node in nodes}
    count = 1 + len(shared)
    for node in nodes:
        if node.run.kind is RunKind.PYTHON:
            on_connections = {entry for each in node.connections for entry in each.map}
            count += sum(
                any((group.kind, name) not in on_connections for name in group.names)
                for group in needs.groups(node)
            )
    return count


CHECKS = (
    check_range,
    check_addresses,
    check_discovery_transport,
    check_server,
    check_rmws,
    check_authority,
    check_transport,
    check_ipv6,
    check_ports,
)
OF_A_NODE = (check_participant, check_middleware, check_fragments)
