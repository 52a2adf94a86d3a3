"""Checks of discovery, RMW and who makes participants; of transports and datagrams of flows.

What happens at run time decides; these only fail earlier. Whether two nodes have a transport in
common, and whether all participants find room, is the planner's to say. Pure.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Iterator

from lifecycle.errors import did_you_mean
from lifecycle.manifest.checks.system import DeclaredSystem
from lifecycle.manifest.diagnostics import Diagnostic, Position, error, note, warning
from lifecycle.manifest.model import (
    Authority,
    DataLayerSource,
    Discovery,
    DiscoveryMode,
    DiscoveryRange,
    EndpointKind,
    FlowTransport,
    Node,
    RunKind,
)
from lifecycle.network.medium import (
    DEFAULT_RMW,
    FAST_DDS,
    TRANSPORTS_VARIABLE,
)
from lifecycle.network.nfe import UniqueRequirement

_OTHERS = ("rmw_cyclonedds", "rmw_zenoh", "rmw_connextdds")
"""RMWs that are known to give no endpoint a network flow or a DSCP of its own."""

_FREE = (FlowTransport.ANY, FlowTransport.NETWORK)
"""Transports of flows that every RMW has, one or the other."""


def check_discovery(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about modes, transports and addresses by which nodes find none."""
    manifest, hosts = system.manifest, system.hosts
    discovery, where = manifest.discovery, manifest.where
    mode, by, medium = discovery.mode, discovery.transport, discovery.transport.medium
    is_dynamic, is_server = mode is DiscoveryMode.DYNAMIC, mode is DiscoveryMode.SERVER
    if not is_dynamic and discovery.range is not DiscoveryRange.SYSTEM_DEFAULT:
        message = (
            f"cannot use range {discovery.range.value!r} in discovery mode {mode.value}: "
            "rmw would add peers or multicast to what is planned"
        )
        yield error("check.discovery-range", where("discovery.range"), message, "remove 'range'")
    why, hint = "", "use 'transport: udpv4', and connections for the data"
    if by.in_memory and (is_server or len(hosts) > 1):
        why = "shared memory leaves no host, and reaches no server"
    elif medium and medium.is_tcp and is_dynamic:
        why, hint = "TCP has no multicast", "use 'mode: static' or 'mode: server'"
    if why:
        message = f"cannot find anybody by {by.value} alone in discovery mode {mode.value}: {why}"
        yield error("check.discovery-transport", where("discovery.transport"), message, hint)
    for address, machines in hosts.items() if len(hosts) > 1 and not is_dynamic else ():
        for machine in machines:
            if not address or ipaddress.ip_address(address).is_loopback:
                message = (
                    f"cannot plan discovery mode {mode.value} with machine {machine.name!r} at "
                    f"{address or 'no address'}: the others must know where it is reached"
                )
                hint = "give it the address of an interface"
                yield error("check.discovery-address", machine.at, message, hint)
    addresses = sorted(filter(None, hosts))
    versions: set[int] = {ipaddress.ip_address(each).version for each in addresses}
    versions |= {4} if is_server else set()
    versions |= {medium.ip_version} if medium and medium.ip_version else set()
    if len(versions) > 1 and (medium or not is_dynamic):
        message = (
            f"cannot plan {_spell(discovery)} with addresses {', '.join(addresses)}: "
            "own participants use one IP version, a server IPv4"
        )
        hint = "give all machines addresses that the transport reaches"
        yield error("check.discovery-address", where("discovery.mode"), message, hint)
    server, used = discovery.server_machine, [node.machine for node in manifest.nodes]
    if server and not (is_server and server in used):
        why = "no node runs there, so nobody starts a supervisor"
        why = why if is_server else f"the discovery mode is {mode.value}"
        message = f"cannot run a discovery server on machine {server!r}: {why}"
        hint = did_you_mean(server, used) or "remove 'server_machine'"
        yield error("check.discovery-server", where("discovery.server_machine"), message, hint)


def _spell(discovery: Discovery) -> str:
    by = discovery.transport
    by_what = "" if by is FlowTransport.ANY else f" by {by.value}"
    return f"discovery mode {discovery.mode.value}{by_what}"


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


def _is_default(system: DeclaredSystem) -> bool:
    """Whether participants find each other by what the middleware does by itself."""
    discovery = system.manifest.discovery
    return (discovery.mode, discovery.transport) == (DiscoveryMode.DYNAMIC, FlowTransport.ANY)


_FLOW = "check.flow-foreign"

_Make = Callable[[str, Position, str, str], Diagnostic]


def check_rmw(system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Yield findings about what only Fast DDS can be configured to do, asked of another RMW."""
    rmw, discovery = system.rmw_of(node), system.manifest.discovery
    if rmw.startswith(FAST_DDS):
        return
    asked: list[tuple[_Make, Position, str]] = []
    if not _is_default(system):
        what = f"take part in {_spell(discovery)}"
        asked.append((error, system.manifest.where("discovery.mode"), what))
    refuse = error if rmw.startswith(_OTHERS) else warning
    for each in system.needs.of_node(node):
        need, of = each.need, f"{each.need.kind.noun} {each.need.name!r}"
        if each.unique:
            must = refuse if need.unique is UniqueRequirement.STRICTLY_REQUIRED else warning
            asked.append((must, need.at, f"give {of} a network flow of its own"))
        if each.dscp is not None:
            asked.append((refuse if need.enforce else warning, need.at, f"mark {of} with a DSCP"))
        if need.transport not in _FREE:
            asked.append((error, need.at, f"carry {of} by {need.transport.value}"))
    asked += [
        (error, link.at, f"carry {link.topic!r} by {link.transport.value}")
        for link in system.manifest.links
        if node.key in (link.from_node, link.to_node) and link.transport not in _FREE
    ]
    for make, at, what in asked:
        message = f"cannot have {node.key!r} {what}: only Fast DDS is known to do that, not {rmw}"
        yield make("check.rmw", at, message, f"set RMW_IMPLEMENTATION={DEFAULT_RMW}")


def check_foreign(system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Judge what is asked of participants that a node's own code makes, and not our host."""
    if node.run.kind is RunKind.PYTHON:
        return
    discovery, layer = system.manifest.discovery, system.manifest.data_layer
    # Of a managed one its ~/connect_to service is called, if it has one.
    supervised = layer.authority is Authority.SUPERVISOR and node.managed
    by_variable = node.run.kind is RunKind.COMMAND and (
        discovery.mode in (DiscoveryMode.DYNAMIC, DiscoveryMode.SERVER)
        or (discovery.mode is DiscoveryMode.STATIC and discovery.transport.in_memory)
    )
    asked: list[tuple[_Make, str, Position, str, str]] = []
    if not _is_default(system) and not by_variable:
        what = f"take part in {_spell(discovery)}"
        asked.append((error, "check.discovery-foreign", node.where("run"), what, ""))
    for connection in node.connections[:1] if not supervised else ():
        more = ", or use 'data_layer: {authority: supervisor}' if it has ~/connect_to"
        asked.append((error, "check.connection-foreign", connection.at, "make connections", more))
    for each in system.needs.of_node(node):
        need, of = each.need, f"{each.need.kind.noun} {each.need.name!r}"
        if each.unique:
            strictly = need.unique is UniqueRequirement.STRICTLY_REQUIRED
            is_publisher = need.kind is EndpointKind.PUBLISHER  # which no RMW makes unique
            must = error if strictly and is_publisher else warning
            asked.append((must, _FLOW, need.at, f"make {of} unique", ""))
        if each.dscp is not None:
            asked.append((warning, _FLOW, need.at, f"mark {of} with a DSCP", ""))
        if need.non_blocking_send:
            what = f"send {of} without waiting"
            asked.append((warning, "check.flow-blocks", need.at, what, ""))
        if need.transport is not FlowTransport.ANY and not supervised:
            value = need.transport.builtin
            more = f", or start it with {TRANSPORTS_VARIABLE}={value}" if value else ""
            what, must = f"carry {of} by {need.transport.value}", warning if value else error
            asked.append((must, "check.flow-transport", need.at, what, more))
    for make, rule, at, what, more in asked:
        message = f"cannot have {node.key!r} {what}: its participant is made by its own code"
        yield make(rule, at, message, f"write it as 'run: {{python: module:Class}}'{more}")


def check_lossy(system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Judge data that must arrive and are sent by multicast alone."""
    groups = {
        entry
        for connection in node.connections
        if all(url.transport.is_group for url in connection.urls)
        for entry in connection.map
    }
    for each in system.needs.of_node(node):
        need = each.need
        by_group = need.transport is FlowTransport.MULTICAST or (need.kind, need.name) in groups
        if by_group and need.lossy is False:
            message = (
                f"cannot carry {need.name!r} of {node.key!r} by multicast: it is declared not lossy"
            )
            hint = "use TCP or UDP, or remove 'lossy: false'"
            yield error("check.flow-lossy", need.at, message, hint)


def check_fragments(system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Say of which messages a network would not know all packets."""
    for each in system.needs.of_node(node):
        size, most = each.need.max_message_size, each.max_datagram_bytes
        if most is None or size is None:
            continue
        message = (
            f"cannot send a message of {each.need.name!r}, up to {size} bytes (declared), in one "
            "datagram: of IP's fragments only the first has ports, so a network would not know the "
            "others as this flow"
        )
        hint = f"start it with {TRANSPORTS_VARIABLE}='UDPv4?max_msg_size={most}B'"
        if node.run.kind is RunKind.PYTHON:
            hint = f"its participant sends at most {most} bytes; a lost datagram costs the message"
        yield note("check.flow-fragments", each.need.at, message, hint)


CHECKS = (check_discovery, check_authority)
OF_A_NODE = (check_rmw, check_foreign, check_lossy, check_fragments)
