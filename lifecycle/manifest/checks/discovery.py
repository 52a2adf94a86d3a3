"""Checks of participant discovery (range, RMW, transport, discovery server) and of the authority.

Owns: check.discovery-range, check.discovery-address, check.discovery-rmw,
check.discovery-transport, check.discovery-server, check.discovery-foreign, check.authority. Pure.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator, Mapping

from lifecycle.manifest.checks.system import DeclaredSystem, rmw_of
from lifecycle.manifest.diagnostics import Diagnostic, Position
from lifecycle.manifest.model import (
    Authority,
    DataLayerSource,
    Discovery,
    DiscoveryMode,
    DiscoveryRange,
    FlowTransport,
    Machine,
    Node,
    RunKind,
)
from lifecycle.manifest.schema import did_you_mean
from lifecycle.manifest.yaml.document import error
from lifecycle.network import Medium

FAST_DDS = "rmw_fastrtps"
_FIXED = (DiscoveryMode.STATIC, DiscoveryMode.STATIC_ENDPOINTS)


def check_discovery(system: DeclaredSystem, environment: Mapping[str, str]) -> Iterator[Diagnostic]:
    """Yield findings about discovery and the data layer's authority."""
    discovery = system.manifest.discovery
    if discovery.at is not None:
        yield from _range(system, discovery.at)
        yield from _addresses(system, discovery.at)
        yield from _transport(system, discovery.at)
        yield from _server(system, discovery.at)
        yield from _rmws(system, environment, discovery.at)
        for node in system.manifest.nodes:
            yield from _foreign(discovery, node)
            yield from _unfound(system, environment, node)
    yield from _authority(system)


def _mode(discovery: Discovery) -> str:
    return f"discovery mode {discovery.mode.value}"


def _range(system: DeclaredSystem, section: Position) -> Iterator[Diagnostic]:
    discovery = system.manifest.discovery
    at = system.manifest.where("discovery.range", section)
    if (
        discovery.mode is not DiscoveryMode.DYNAMIC
        and discovery.range is not DiscoveryRange.SYSTEM_DEFAULT
    ):
        message = (
            f"cannot use range {discovery.range.value!r} in {_mode(discovery)}: rmw would add "
            "peers or multicast to what is planned"
        )
        yield error("check.discovery-range", at, message, "remove 'range'")


def hosts(system: DeclaredSystem) -> dict[str, list[Machine]]:
    """Return the machines that nodes run on, by address; those without one are this host."""
    used = {node.machine for node in system.manifest.nodes}
    found: dict[str, list[Machine]] = {}
    for machine in system.manifest.machines:
        if machine.name in used:
            found.setdefault(machine.address, []).append(machine)
    return found


def _addresses(system: DeclaredSystem, section: Position) -> Iterator[Diagnostic]:
    """Judge addresses that others must know beforehand."""
    discovery, found = system.manifest.discovery, hosts(system)
    at = system.manifest.where("discovery.mode", section)
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


def _transport(system: DeclaredSystem, section: Position) -> Iterator[Diagnostic]:
    discovery = system.manifest.discovery
    at = system.manifest.where("discovery.transport", section)
    transport, found = discovery.transport, hosts(system)
    rule, what = "check.discovery-transport", f"cannot let discovery use {transport.value} alone"
    if transport is FlowTransport.SHM and len(found) > 1:
        names = ", ".join(repr(machine.name) for each in found.values() for machine in each)
        message = f"{what} between machines {names}: shared memory does not leave a host"
        hint = "use 'transport: udpv4', and connections for the data"
        yield error(rule, at, message, hint)
    if transport is FlowTransport.SHM and discovery.mode is DiscoveryMode.SERVER:
        message = f"{what} with a discovery server: it is reached by TCP or UDP"
        yield error(rule, at, message, "use 'transport: tcpv4', or remove it")
    if transport is FlowTransport.UDPV6 and discovery.mode is DiscoveryMode.SERVER:
        message = f"{what} with a discovery server: it is reached by IPv4"
        yield error(rule, at, message, "use 'transport: tcpv4' or 'udpv4'")
    if transport is FlowTransport.TCPV4 and discovery.mode is DiscoveryMode.DYNAMIC:
        message = f"{what} in mode dynamic: TCP has no multicast to find anybody by"
        yield error(rule, at, message, "use 'mode: static' or 'mode: server'")
    medium = transport.medium
    if discovery.mode is DiscoveryMode.SERVER and transport is FlowTransport.ANY:
        medium = Medium.TCPV4
    version = medium.ip_version if medium else None
    for address, machines in found.items():
        if version and address and ipaddress.ip_address(address).version != version:
            message = (
                f"cannot reach machine {machines[0].name!r} at {address} by {medium}, which "
                "discovery uses"
            )
            hint = f"give it an IPv{version} address, or use another 'transport'"
            yield error(rule, machines[0].at, message, hint)


def _server(system: DeclaredSystem, section: Position) -> Iterator[Diagnostic]:
    discovery = system.manifest.discovery
    name = discovery.server_machine
    at = system.manifest.where("discovery.server_machine", section)
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
    elif system.lost == frozenset() and name not in {
        node.machine for node in system.manifest.nodes
    }:
        message = (
            f"cannot run the discovery server on machine {name!r}: no node runs there, so nobody "
            "starts a supervisor"
        )
        yield error("check.discovery-server", at, message, "choose a machine that runs a node")


def _rmws(
    system: DeclaredSystem, environment: Mapping[str, str], section: Position
) -> Iterator[Diagnostic]:
    """Only Fast DDS can be configured so; a server serves only its own kind."""
    discovery = system.manifest.discovery
    dynamic = discovery.mode is DiscoveryMode.DYNAMIC
    at = system.manifest.where(f"discovery.{'transport' if dynamic else 'mode'}", section)
    if dynamic and discovery.transport is FlowTransport.ANY:
        return
    by_rmw: dict[str, list[str]] = {}
    for node in system.manifest.nodes:
        by_rmw.setdefault(rmw_of(node, environment), []).append(node.key)
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


def _foreign(discovery: Discovery, node: Node) -> Iterator[Diagnostic]:
    """Judge a node whose participant is not ours to make; variables can configure a command's."""
    transport = discovery.transport
    if node.run.kind is RunKind.PYTHON or (
        discovery.mode is DiscoveryMode.DYNAMIC and transport is FlowTransport.ANY
    ):
        return
    by_variable = (
        discovery.mode in (DiscoveryMode.DYNAMIC, DiscoveryMode.SERVER)
        or transport is FlowTransport.SHM
    ) and discovery.mode is not DiscoveryMode.STATIC_ENDPOINTS
    if node.run.kind is RunKind.COMMAND and by_variable:
        return
    what = f"{_mode(discovery)}{'' if transport is FlowTransport.ANY else f' by {transport.value}'}"
    if node.run.kind is RunKind.ATTACH:
        why = "somebody else starts it, with a participant that nobody here can configure"
    elif discovery.mode is DiscoveryMode.STATIC_ENDPOINTS:
        why = "its endpoints are its own code's, and no table of ours has them"
    else:
        why = "no variable gives a process fixed ports and peers"
    message = f"cannot take {node.key!r} into {what}: {why}"
    hint = "write it as 'run: {python: module:Class}', or use 'mode: dynamic'"
    yield error("check.discovery-foreign", node.where("run"), message, hint)


def _unfound(
    system: DeclaredSystem, environment: Mapping[str, str], node: Node
) -> Iterator[Diagnostic]:
    """Judge a command that is configured to use IPv6 and to look on this host alone.

    rmw_fastrtps_cpp 8.4 does the latter by the peer 127.0.0.1, and no variable names another.
    """
    discovery = system.manifest.discovery
    reach = discovery.range.name
    if discovery.range is DiscoveryRange.SYSTEM_DEFAULT:
        reach = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", reach)
    if (
        node.run.kind is not RunKind.COMMAND
        or discovery.mode is not DiscoveryMode.DYNAMIC
        or discovery.transport is not FlowTransport.UDPV6
        or reach != DiscoveryRange.LOCALHOST.name
    ):
        return
    message = (
        f"cannot find {node.key!r} by udpv6 in range localhost: its RMW looks for others at "
        "127.0.0.1 only"
    )
    hint = "use 'range: subnet', or 'transport: udpv4'"
    yield error("check.discovery-foreign", node.where("run"), message, hint)


def _authority(system: DeclaredSystem) -> Iterator[Diagnostic]:
    layer = system.manifest.data_layer
    if layer.at is None:
        return
    if layer.authority is Authority.NODES and layer.source is DataLayerSource.DYNAMIC:
        message = (
            "cannot make the data layer graph from node configurations under authority 'nodes': "
            "each node only follows what it was started with, and nobody would negotiate"
        )
        hint = "use 'authority: supervisor', or 'source: static'"
        at = system.manifest.where("data_layer.source", layer.at)
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
