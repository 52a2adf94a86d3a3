"""The nine systems of *Topological Discovery and Communication Negotiation*, each as it says it is.

One test per row of the article's feature table, by the row's name, and one for each of the two
systems that it negotiates. All of them look at packets and at the kernel's list of sockets.
"""

from __future__ import annotations

import json
import signal
from pathlib import Path

import psutil

from tests.net.hosts import Hosts
from tests.net.nine_systems import (
    DOMAIN,
    System,
    edited,
    on_one_host,
    on_two_hosts,
    on_two_hosts_by_tcp,
)
from tests.ros.supervisor.running import BOUND_S

_ROS_DISCOVERY_INFO = range(7000, 7010)
"""rmw_fastrtps takes the first free one for it per participant, and lets nobody say otherwise."""
_DEFAULT_PORTS = range(7400 + 250 * DOMAIN, 7400 + 250 * (DOMAIN + 1))
"""DDSI-RTPS 9.6.2.3."""
_GRAPH = "/lifecycle/graph"
_SPDP = bytes.fromhex("000100c2")  # DDSI-RTPS Table 9.1
_SEDP = frozenset(bytes.fromhex(each) for each in ("000003c2", "000004c2"))


def _no_multicast(system: System) -> None:
    """Nothing went to a group, nor to where participants listen that nobody gave a port."""
    assert [each for each in system.left_the_hosts() if each.multicast] == []
    for wire in system.inside.values():
        assert [each for each in wire.packets() if each.multicast] == []
    everywhere = [
        *system.left_the_hosts(),
        *(w for i in system.inside.values() for w in i.packets()),
    ]
    assert [each for each in everywhere if each.destination_port in _DEFAULT_PORTS] == []


def test_statically_configured_nodes(hosts: Hosts, tmp_path: Path) -> None:
    with on_two_hosts(hosts, "statically_configured_nodes", tmp_path) as system:
        system.until_active()
        system.until_says("right", "listener", "heard hello")
        system.until_said()
        talker, listener = (
            {(each.protocol, each.address, each.port) for each in system.sockets(*where)}
            for where in (("left", "talker"), ("right", "listener"))
        )
        left, right = (system.hosts[each].ipv4 for each in ("left", "right"))
        system.cut()
        system.finish()
    # Known before anything ran: these are the manifest's numbers.
    assert {each.flow for each in system.hellos()} == {(left, 8002, right, 8011)}
    assert {each.protocol for each in system.hellos()} == {"udp"}
    _no_multicast(system)
    # Of a datagram in pieces only the first has ports.
    for packet in (each for each in system.left_the_hosts() if each.source_port):
        assert {packet.source, packet.destination} == {left, right}
        assert packet.protocol == "udp"
        assert _planned(packet.source_port), packet
        assert _planned(packet.destination_port), packet
    for sockets, own in ((talker, {8000, 8001, 8002}), (listener, {8010, 8011, 8012})):
        ports = {port for _, _, port in sockets}
        assert own <= ports
        assert all(_planned(port) for port in ports), sockets


def _planned(port: int) -> bool:
    """The manifest's and the planner's; and rmw_fastrtps's own for ros_discovery_info."""
    return 8000 <= port < 8020 or 8100 <= port < 8140 or port in _ROS_DISCOVERY_INFO


def test_statically_configured_nodes_with_static_endpoint_discovery(
    hosts: Hosts, tmp_path: Path
) -> None:
    name = "statically_configured_nodes_static_endpoints"
    with on_two_hosts(hosts, name, tmp_path) as system:
        system.until_active()
        system.until_says("right", "listener", "heard hello")
        system.until_said()
        system.cut()
        system.finish()
    flows = {each.flow for each in system.hellos()}
    assert len(flows) == 1
    _no_multicast(system)
    # The participants that carry data give signs of life (SPDP), and announce no endpoint (SEDP).
    data = [each for each in system.left_the_hosts() if each.source_port in range(8207, 8210)]
    assert {each.source for each in data} == {host.ipv4 for host in system.hosts.values()}
    kinds = {writer[12:] for each in data for writer in each.writers}
    assert _SPDP in kinds
    assert kinds & _SEDP == set()
    for packet in (each for each in system.left_the_hosts() if each.source_port):
        for port in (packet.source_port, packet.destination_port):
            assert 8200 <= port < 8212 or port in _ROS_DISCOVERY_INFO, packet
    # Nodes and supervisors see each other, and announce what is for that; no topic of the manifest.
    assert system.outside["left"].writers("/rosout") != set()
    assert system.outside["left"].writers("/chatter") == set()


def test_statically_configured_graph(hosts: Hosts, tmp_path: Path) -> None:
    with on_one_host(hosts, _held(tmp_path, "statically_configured_graph"), tmp_path) as system:
        _nothing_open_until_told(system, tmp_path)
        system.finish()
    assert {each.flow[2:] for each in system.hellos()} == {("127.0.0.1", 8031)}
    assert {each.protocol for each in system.hellos()} == {"udp"}
    _no_multicast(system)


def _held(directory: Path, name: str) -> str:
    """Have the listener wait until it may be configured: the talker comes after it."""
    listener = 'run: {python: "examples.nine_systems.nodes:Listener"}'
    go = json.dumps(str(directory / "go"))
    late = f"""run:
      python: "tests.net.systems:LateListener"
      environment: {{HOLD_CONFIGURE_FILE: {go}}}"""
    return edited(directory, name, listener, late)


def _nothing_open_until_told(system: System, directory: Path) -> None:
    """Both nodes run; neither is told anything while the listener is not configured."""
    system.until_event("left", "request", node="/listener", operation="configure")
    system.until_event("left", "node", node="/talker", reach="configured")
    assert system.sockets("left", "talker") == []
    assert system.sockets("left", "listener") == []
    assert [each for each in system.inside["left"].packets() if each.protocol == "udp"] == []
    assert system.ups["left"].of_kind("wiring") == []
    (directory / "go").touch()
    system.until_active()
    system.until_says("left", "listener", "heard hello")
    system.until_said()
    assert system.sockets("left", "talker") != []


def test_dynamically_configured_graph_with_static_discovery(hosts: Hosts, tmp_path: Path) -> None:
    with on_two_hosts(hosts, "dynamically_configured_graph", tmp_path) as system:
        _endpoints_made_while_running_are_connected(system)
        system.cut()
        system.finish()
    assert system.outside["left"].writers(_GRAPH) == set()
    _no_multicast(system)


def _endpoints_made_while_running_are_connected(system: System) -> None:
    """The manifest has no news: both nodes make that endpoint once they are active."""
    system.until_active()
    system.until_says("right", "listener", "heard hello")
    system.until_said()
    before = {each.flow for each in system.hellos()}
    assert len(before) == 1
    system.until_says("right", "listener", "heard news")
    system.outside["left"].wait(system.news)
    left, right = (system.hosts[each].ipv4 for each in ("left", "right"))
    assert {each.flow[::2] for each in system.news()} == {(left, right)}
    assert {each.flow for each in system.hellos()} == before


def test_statically_configured_graph_with_events(hosts: Hosts, tmp_path: Path) -> None:
    name = _held(tmp_path, "statically_configured_graph_with_events")
    with on_one_host(hosts, name, tmp_path) as system:
        _nothing_open_until_told(system, tmp_path)
        telling = sorted(system.ask("left", "publishers", _GRAPH))
        assert telling == ["/listener", "/talker"]
        _what_is_lost_is_made_again(system)
        system.finish()
    assert {each.flow[2:] for each in system.hellos()} == {("127.0.0.1", 8051)}
    _no_multicast(system)


def _what_is_lost_is_made_again(system: System) -> None:
    """Somebody else takes a connection away: the graph tells, and the authority acts on it."""
    system.ask("left", "disconnect", "/listener", "data")
    system.until_event("left", "lost", node="/listener", connection="data")
    sent = len(system.hellos())
    system.ups["left"].until("wiring", node="/listener", operation="map_to")
    system.inside["left"].wait(lambda: len(system.hellos()) >= sent + 5)
    assert {8050, 8051} <= {each.port for each in system.sockets("left", "listener")}


def test_dynamically_configured_graph_with_events_and_static_discovery(
    hosts: Hosts, tmp_path: Path
) -> None:
    with on_two_hosts(hosts, "dynamically_configured_graph_with_events", tmp_path) as system:
        _endpoints_made_while_running_are_connected(system)
        system.cut()
        system.finish()
    assert len(system.outside["left"].writers(_GRAPH)) == 2
    _no_multicast(system)


def test_dynamically_configured_graph_with_dynamic_discovery(hosts: Hosts, tmp_path: Path) -> None:
    with on_one_host(hosts, "dynamic_discovery", tmp_path) as system:
        _whoever_comes_is_connected_and_taken_out_again(system)
        _two_told_the_graph(system)
        system.finish()


def test_dynamically_configured_graph_with_events_and_dynamic_discovery(
    hosts: Hosts, tmp_path: Path
) -> None:
    with on_one_host(hosts, "dynamic_discovery_with_events", tmp_path) as system:
        _whoever_comes_is_connected_and_taken_out_again(system)
        _two_told_the_graph(system)
        system.finish()


def _two_told_the_graph(system: System) -> None:
    """The guest and the talker said that they came."""
    wire = system.inside["left"]
    wire.wait(lambda: len(wire.writers(_GRAPH)) >= 2)
    assert len(wire.writers(_GRAPH)) == 2


def _whoever_comes_is_connected_and_taken_out_again(system: System) -> None:
    """A node that no manifest knows comes, hears, and leaves."""
    system.until_active()
    assert system.hellos() == []
    guest = system.start("left", "examples.nine_systems.guest")
    assert guest.stdout is not None
    assert "heard hello\n" in iter(guest.stdout.readline, "")
    system.until_event("left", "joined", node="/guest")
    system.inside["left"].wait(system.hellos)
    guest.send_signal(signal.SIGINT)
    assert guest.wait(BOUND_S) == 0
    guest.stdout.close()
    system.until_event("left", "left", node="/guest")


def test_client_server_master_with_point_to_point_tcp_data_only(
    hosts: Hosts, tmp_path: Path
) -> None:
    with on_two_hosts_by_tcp(hosts, "client_server_master", tmp_path) as system:
        system.until_says("right", "listener", "heard hello")
        system.until_says("left", "neighbour", "heard hello")
        processes = (("left", "talker"), ("left", "neighbour"), ("right", "listener"))
        for machine, process in processes:
            assert {each.protocol for each in system.sockets(machine, process)} == {"tcp"}
        servers = [
            each
            for each in psutil.process_iter(["cmdline"])
            if "fast-discovery-server" in " ".join(each.info["cmdline"] or ())
            and each.pid in system.hosts["left"].pids()
        ]
        assert servers != []
        system.cut()
        system.finish()
        assert [each for each in servers if each.is_running()] == []
    assert {each.protocol for each in system.hellos()} == {"tcp"}
    left, right = (system.hosts[each].ipv4 for each in ("left", "right"))
    wires = [*system.outside.values(), *system.inside.values()]
    assert [each for wire in wires for each in wire.packets() if each.protocol == "udp"] == []
    # Point to point: the master hands out addresses, and no data.
    over_the_cable = [
        each for each in system.outside["left"].packets() if b"hello " in each.payload
    ]
    assert {(each.source, each.destination) for each in over_the_cable} == {(left, right)}


def test_distributed_system_with_intelligent_multicast(hosts: Hosts, tmp_path: Path) -> None:
    with on_two_hosts_by_tcp(hosts, "intelligent_multicast", tmp_path) as system:
        for machine, process in (("left", "near"), ("left", "nearer"), ("right", "far")):
            system.until_says(machine, process, "heard hello")
        count = len(system.hellos())
        system.outside["left"].wait(lambda: len(system.hellos()) >= count + 40)
        system.cut()
        system.finish()
    local = [each for each in system.inside["left"].packets() if b"hello " in each.payload]
    sent = [each for each in local if each.outgoing]
    assert {(each.protocol, each.multicast, each.ttl) for each in sent} == {("udp", True, 0)}
    assert len({(each.destination, each.destination_port) for each in sent}) == 1
    # One datagram for both: no message is sent twice.
    said = [_said(each.payload) for each in sent]
    assert len(said) == len(set(said))
    over_the_cable = system.outside["left"].packets()
    for wire in system.outside.values():
        assert [each for each in wire.packets() if each.protocol == "udp"] == []
    assert any(b"hello " in each.payload for each in over_the_cable)


def _said(payload: bytes) -> bytes:
    return payload[payload.index(b"hello ") :].split(b"\0")[0]
