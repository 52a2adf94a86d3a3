"""A delay that a congested link does not keep is violated, and ok once the flow is programmed.

All by the product's own commands; only the bottleneck without a rule is made by hand.
"""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path

import pytest

from benchmarks.congested_link import (
    BUFFER_S,
    FRAME_BYTES,
    GUARANTEE,
    LINK_KBIT,
    Case,
    brought_up,
    missing_features,
    rule,
    write_manifest,
)
from lifecycle.errors import ExitCode
from tests.net.hosts import Host, Hosts, lacking
from tests.net.running import verb_on

pytestmark = [pytest.mark.ros, pytest.mark.thorough, pytest.mark.alone]

MARKED = Case(
    title="P1 marked EF, of which a delay is declared",
    publishers={"p1": {"dscp": "EF"}},
    apply=("--match", "mark", "--guarantee", f"ef={GUARANTEE}"),
    links=[{"topic": "/p1", "from": "n1", "to": "n2", "max_delay_ms": 50, "quantile": 0.9}],
)
SEEN_S = 40.0


def until(host: Host, runtime: Path, verdict: str, outcome: str) -> str:
    """Return what `status` says of P1 on a host, once the verdict and its one bound are so."""
    deadline, said = time.monotonic() + SEEN_S, ""
    while time.monotonic() < deadline:
        said = verb_on(host, "status", "congested", "--format", "json", runtime=runtime).stdout
        status = json.loads(said)
        measured = [each for each in status["measured"] if each["topic"] == "/p1"]
        bounds = [bound for each in measured for bound in each["bounds"]]
        if status["verdict"] == verdict and [each["outcome"] for each in bounds] == [outcome]:
            return str(bounds[0]["text"])
        time.sleep(0.2)
    raise AssertionError(f"not {verdict} within {SEEN_S:g} s: {said}")


def test_a_delay_on_a_congested_link_is_violated_and_ok_once_it_is_programmed(
    tmp_path: Path,
) -> None:
    if why := lacking():
        pytest.skip(why)
    with Hosts() as hosts:
        left, router, right = hosts.routed("A", "B")
        if missing := missing_features(router):
            pytest.skip(f"this kernel: {missing}")
        frames = int(LINK_KBIT * 1000 / 8 * BUFFER_S / FRAME_BYTES)
        router.ip("link", "set", "right", "txqueuelen", str(frames))
        manifest = write_manifest(MARKED, left.ipv4, right.ipv4, tmp_path)
        with brought_up(manifest, left, right, tmp_path):
            without = dataclasses.replace(MARKED, apply=None)
            with rule(without, router, manifest, tmp_path):
                (tmp_path / "go").touch()
                assert "> 50 ms" in until(right, tmp_path / "b", "violated", "violated")
            with rule(MARKED, router, manifest, tmp_path):
                assert "≤ 50 ms" in until(right, tmp_path / "b", "ok", "ok")
                assert "measured on b: see" in (tmp_path / "flows.log").read_text()
                said = apply_where_it_arrives(right, manifest, tmp_path / "b")
    assert [each.partition(":")[0] for each in said] == ["before", "after"]
    assert all(" /p1 /n1 → /n2: " in each and "≤ 50 ms" in each for each in said), said


def apply_where_it_arrives(host: Host, manifest: Path, runtime: Path) -> list[str]:
    """Mark the flow on the host that receives it, too; return what was measured of it."""
    words = ("flows", "apply", str(manifest), "--target", "nft")
    done = verb_on(host, *words, runtime=runtime)
    assert done.returncode == ExitCode.OK, done.stdout + done.stderr
    return [each for each in done.stdout.splitlines() if each.startswith(("before", "after"))]
