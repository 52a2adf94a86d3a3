"""Intelligent multicast as the article has it: from configurations that nodes tell the graph of.

The shipped manifest is negotiated beforehand. *Topological Discovery and Communication Negotiation*
has it decided while it runs, from the graph's state; that takes one line more.
"""

from __future__ import annotations

from pathlib import Path

from tests.net.hosts import Hosts
from tests.net.nine_systems import edited, on_two_hosts_by_tcp

_FROM_THE_GRAPH = "data_layer: {authority: supervisor, source: dynamic, events: true}\n"


def test_multicast_here_and_tcp_to_others_is_negotiated_from_what_nodes_report(
    hosts: Hosts, tmp_path: Path
) -> None:
    in_the_graph = f"\n{_FROM_THE_GRAPH}nodes:\n"
    name = edited(tmp_path, "intelligent_multicast", "\nnodes:\n", in_the_graph)
    with on_two_hosts_by_tcp(hosts, name, tmp_path) as system:
        for machine, process in (("left", "near"), ("left", "nearer"), ("right", "far")):
            system.until_says(machine, process, "heard hello")
        cable = system.outside["left"]
        cable.wait(lambda: any(b"hello " in each.payload for each in cable.packets()))
        # Nobody was told by a plan: the supervisors called connect_to and map_to.
        wired = {each["node"] for up in system.ups.values() for each in up.of_kind("wiring")}
        assert {"/talker", "/near", "/nearer"} <= wired
        system.finish()
    sent = [
        each
        for each in system.inside["left"].packets()
        if each.outgoing and b"hello " in each.payload
    ]
    assert {(each.protocol, each.multicast, each.ttl) for each in sent} == {("udp", True, 0)}
    assert {each.protocol for each in cable.packets()} == {"tcp"}
    assert cable.writers("/lifecycle/graph") != set()
