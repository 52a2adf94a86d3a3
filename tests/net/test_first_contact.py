"""A node that is not reached by TCP is started again on a fresh port, before the gate."""

from __future__ import annotations

import shutil
import signal
from pathlib import Path

import pytest

from lifecycle.errors import ExitCode
from tests.net.hosts import Hosts
from tests.net.running import DOMAIN, up_on
from tests.ros.supervisor.running import ROOT

LAST_PORT = 8807
"""Of the listener, which everybody dials: it has the highest of the manifest's ports."""

RULES = f"""
table inet lost {{
    chain out {{
        type filter hook output priority 0;
        tcp dport {LAST_PORT} drop
    }}
}}
"""
"""What Fast DDS loses now and then is lost here for sure, and for good on that port."""


@pytest.mark.skipif(shutil.which("nft") is None, reason="the test drops packets with nft(8)")
def test_a_node_that_is_not_discovered_is_started_again_on_a_fresh_port(
    hosts: Hosts, tmp_path: Path
) -> None:
    host = hosts.host("left")
    host.run("nft", "-f", "-", stdin=RULES)
    manifest = ROOT / "manifests" / "client_server_master.lifecycle.yaml"
    with up_on(host, manifest, f"domain:={DOMAIN}", runtime=tmp_path) as run:
        notices = iter(lambda: run.until("notice")["message"], None)
        told = next(each for each in notices if "fresh port" in each)
        assert told.startswith(
            "'/listener' is started again on a fresh port: not discovered over TCP for 5 s "
            "(/listener (graph.missing-node)"
        )
        assert run.of_kind("gate") == []
        run.until("system", reached="active")
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK
        run.assert_gate_held()
        run.assert_nothing_left()
