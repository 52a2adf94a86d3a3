"""A delay that a congested link does not keep is violated, and ok once the flow is programmed.

All by the product's own commands; only the bottleneck without a rule is made by hand.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

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
from tests.net.hosts import Hosts, lacking

pytestmark = [pytest.mark.ros, pytest.mark.thorough, pytest.mark.alone]

MARKED = Case(
    title="P1 marked EF, of which a delay is declared",
    publishers={"p1": {"dscp": "EF"}},
    apply=("--match", "mark", "--guarantee", f"ef={GUARANTEE}"),
    links=[{"topic": "/p1", "from": "n1", "to": "n2", "max_delay_ms": 50, "quantile": 0.9}],
)
SEEN_S = 40.0


def until(directory: Path, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """Return the latest verdict of the subscriber's supervisor, once it is as wanted."""
    deadline, verdict = time.monotonic() + SEEN_S, dict[str, Any]()
    while time.monotonic() < deadline:
        for line in (directory / "b.log").read_text().splitlines():
            event = json.loads(line) if line.startswith("{") else {}
            verdict = event["verdict"] if event.get("event") == "verdict" else verdict
        if holds(verdict):
            return verdict
        time.sleep(0.2)
    raise AssertionError(f"not within {SEEN_S:g} s: {verdict}")


def late(verdict: dict[str, Any]) -> bool:
    return any(each["rule"] == "flow.delay" for each in verdict["findings"])


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
                verdict = until(tmp_path, late)
                assert verdict["verdict"] == "violated"
            with rule(MARKED, router, manifest, tmp_path):
                until(tmp_path, lambda verdict: not late(verdict))
                verdict = until(tmp_path, lambda verdict: verdict["verdict"] == "ok")
                (flow,) = (each for each in verdict["measured"] if each["topic"] == "/p1")
                assert [each["outcome"] for each in flow["bounds"]] == ["ok"]
