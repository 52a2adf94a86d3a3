"""A router that clears the DSCP of what passes: found beside the flows of two supervisors."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path

import pytest

from benchmarks.congested_link import Case, brought_up, write_manifest
from tests.net.hosts import Host, Hosts
from tests.net.running import verb_on

pytestmark = pytest.mark.skipif(shutil.which("nft") is None, reason="nft is not installed")

MARKED = Case(
    title="P1 marked EF",
    publishers={"p1": {"dscp": "EF"}},
    links=[{"topic": "/p1", "from": "n1", "to": "n2"}],
)
BLEACHES = """
table inet bleach {
  chain forward {
    type filter hook forward priority mangle
    ip dscp ef ip dscp set cs0
    ip6 dscp ef ip6 dscp set cs0
  }
}
"""
SEEN_S = 15.0


def until(host: Host, runtime: Path, verdict: str) -> str:
    """Return what is not ok on a host, once its verdict is so."""
    deadline, said = time.monotonic() + SEEN_S, ""
    while time.monotonic() < deadline:
        said = verb_on(host, "status", "congested", "--format", "json", runtime=runtime).stdout
        status = json.loads(said)
        if status["verdict"] == verdict:
            return str(status["not_ok"])
        time.sleep(0.2)
    raise AssertionError(f"not {verdict} within {SEEN_S:g} s: {said}")


def test_a_dscp_that_a_router_clears_is_found_and_heals(hosts: Hosts, tmp_path: Path) -> None:
    left, router, right = hosts.routed("A", "B")
    manifest = write_manifest(MARKED, left.ipv4, right.ipv4, tmp_path)
    with brought_up(manifest, left, right, tmp_path):
        until(right, tmp_path / "b", "ok")
        router.run("nft", "-f", "-", stdin=BLEACHES)
        found = until(right, tmp_path / "b", "violated")
        assert found == "/p1: /n1 → /n2 (flow.dscp-lost)"
        assert "beside the flow /n1 → /n2 on /p1 arrives as DF = DSCP 0" in (
            tmp_path / "b.log"
        ).read_text(encoding="utf-8")
        assert until(left, tmp_path / "a", "ok") == ""  # what it sends is marked
        router.run("nft", "delete", "table", "inet", "bleach")
        until(right, tmp_path / "b", "ok")
        # Longer than it takes until marks that do not arrive are overdue.
        time.sleep(7)
        assert until(right, tmp_path / "b", "ok") == ""
