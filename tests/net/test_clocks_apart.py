"""Delays between two hosts whose clocks are half a second apart, or are set while they run."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from lifecycle.errors import ExitCode
from lifecycle.supervisor.control.protocol import look
from lifecycle.verify.verdict import FlowMeasurement
from tests.net.hosts import Host
from tests.net.other_clock import OtherClock
from tests.net.running import article, run_directory, up_on, verb_on
from tests.ros.supervisor.running import Up

_BOUND_MS = 40
"""Kept on a machine that is busy, too, and far less than the clocks are apart."""

_EDIT: dict[str, Any] = {
    "nodes/n1/run": {"python": "tests.net.systems:Stamped"},
    "nodes/n2/run": {"python": "tests.net.systems:Timed"},
    "links": [
        {"topic": "/video", "from": "n1", "to": "n2", "max_delay_ms": _BOUND_MS},
        {"topic": "/battery", "from": "n1", "to": "n2"},
    ],
}
_SAID = r"delay p99 [\d.]+ ms ± [\d.]+ ms ≤ 40 ms.*, clocks (499|50[01]) ms ± [\d.]+ ms apart"
_SIM_TIME = {
    "nodes/n2/parameters": {"use_sim_time": True},
    "nodes/clock": {
        "machine": "a",
        "run": {"python": "tests.net.systems:SimulatedTime"},
        "interface": {
            "publishers": [{"name": "/clock", "type": "rosgraph_msgs/msg/Clock", "qos": "clock"}]
        },
    },
}


@contextlib.contextmanager
def _apart(
    pair: tuple[Host, Host], directory: Path, ahead_s: float, edit: Mapping[str, Any]
) -> Iterator[tuple[Up, Up]]:
    """Bring the article up with the clock of its publisher's host ahead."""
    manifest = article(directory, pair[0].ipv4, pair[1].ipv4, edit={**_EDIT, **edit})
    clock = OtherClock(directory / "clock", ahead_s)
    with (
        _up(pair[0], manifest, "a", clock.variables) as up_a,
        _up(pair[1], manifest, "b") as up_b,
    ):
        yield up_a, up_b


def _up(
    host: Host, manifest: Path, machine: str, variables: Mapping[str, str] | None = None
) -> contextlib.AbstractContextManager[Up]:
    runtime = manifest.parent / machine
    return up_on(host, manifest, "--machine", machine, runtime=runtime, variables=variables)


def _measured(directory: Path, machine: str) -> FlowMeasurement | None:
    """Return what a supervisor knows of the video now."""
    verdict = look(run_directory(directory / machine, machine)).verdict
    assert verdict is not None
    return next((each for each in verdict.measured if each.topic == "/video"), None)


@pytest.mark.parametrize("ahead_s", [0.5, -0.5])
@pytest.mark.parametrize("edit", [{}, _SIM_TIME], ids=["", "use_sim_time"])
def test_a_delay_that_is_kept_is_ok_with_numbers_whatever_the_clocks_say(
    pair: tuple[Host, Host], tmp_path: Path, ahead_s: float, edit: dict[str, Any]
) -> None:
    with _apart(pair, tmp_path, ahead_s, edit=edit) as (up_a, up_b):
        for up in (up_a, up_b):
            up.until("system", reached="active")
        said = up_b.until("notice")
        while not str(said["message"]).startswith("measured: /video"):
            said = up_b.until("notice")
        assert re.search(_SAID, str(said["message"])), said
        up_b.catch_up()
        true_ms = float(str(up_b.until("log")["line"]).removeprefix("median "))
        flow = _measured(tmp_path, "b")
        # Who publishes counts nothing, and judges nothing.
        assert _measured(tmp_path, "a") is None
        for up in (up_a, up_b):
            up.signal(signal.SIGTERM)
        assert [up.finish() for up in (up_a, up_b)] == [ExitCode.OK, ExitCode.OK]
    assert flow is not None
    assert flow.clock is not None
    assert abs(flow.clock.offset_ms - ahead_s * 1000) <= flow.clock.uncertainty_ms < 10
    assert flow.p50_ms is not None
    assert abs(flow.p50_ms - true_ms) <= flow.clock.uncertainty_ms + 1
    assert [each.outcome for each in flow.bounds] == ["ok"]
    print(f"true {true_ms} ms, {flow.describe()}")


@pytest.mark.parametrize("ahead_s", [0.5, -0.5])
def test_data_that_are_used_late_are_found_whatever_the_clocks_say(
    pair: tuple[Host, Host], tmp_path: Path, ahead_s: float
) -> None:
    edit = {"nodes/n2/run/environment": {"BUSY_S": "0.15"}}
    with _apart(pair, tmp_path, ahead_s, edit=edit) as (up_a, up_b):
        verdict = up_b.until_found("flow.delay")
        (found,) = (each for each in verdict["findings"] if each["rule"] == "flow.delay")
        said = re.search(r"delay p99 ([\d.]+) ms ± [\d.]+ ms > 40 ms", found["message"])
        assert said is not None, found
        assert 80 < float(said[1]) < 200
        shown = verb_on(pair[1], "flows", "article", runtime=tmp_path / "b")
        assert shown.returncode == ExitCode.VIOLATED, shown.stderr
        row = next(each for each in shown.stdout.splitlines() if " /video " in each)
        assert ("!" in row, row.split()[0]) == (True, "violated"), row
        judged = verb_on(
            pair[1], "verify", str(up_b.manifest), "--format", "json", runtime=tmp_path / "b"
        )
        assert judged.returncode == ExitCode.VIOLATED, judged.stderr
        rules = {each["rule"] for each in json.loads(judged.stdout)["findings"]}
        assert ("flow.delay" in rules, "flow.not-measured" in rules) == (True, False)
        for up in (up_a, up_b):
            up.signal(signal.SIGTERM)
        up_a.finish()
        assert up_b.finish() == ExitCode.VIOLATED


@pytest.mark.parametrize("whose", ["a", "b"])
def test_a_clock_that_is_set_meanwhile_makes_no_delay_that_is_kept_seem_too_long(
    pair: tuple[Host, Host], tmp_path: Path, whose: str
) -> None:
    deep = {"preset": "sensor_data", "depth": 100}
    type_ = "std_msgs/msg/String"
    edit = {
        **_EDIT,
        "nodes/n2/run/environment": {"BUSY_S": "0.5", "BUSY_FILE": str(tmp_path / "busy")},
        "nodes/n2/interface/subscriptions": [
            {"name": "video", "type": type_, "qos": deep},
            {"name": "battery", "type": type_},
        ],
        "links": [{**_EDIT["links"][0], "max_delay_ms": 300}, _EDIT["links"][1]],
    }
    manifest = article(tmp_path, pair[0].ipv4, pair[1].ipv4, edit=edit)
    clock = OtherClock(tmp_path / "clock")
    of = {whose: clock.variables}
    with (
        _up(pair[0], manifest, "a", of.get("a")) as up_a,
        _up(pair[1], manifest, "b", of.get("b")) as up_b,
    ):
        for up in (up_a, up_b):
            up.until("system", reached="active")
        for ahead_s in (1.0, 0.0):
            _until(tmp_path, "ok")
            clock.set(ahead_s)
            _until(tmp_path, "unverifiable")
        _until(tmp_path, "ok")
        up_b.catch_up()
        verdicts = up_b.of_kind("verdict")
        found = [each for verdict in verdicts for each in verdict["verdict"]["findings"]]
        assert "flow.not-measured" in {each["rule"] for each in found}
        wrong = ("flow.delay", "flow.rate", "flow.silent")
        assert [each["message"] for each in found if each["rule"] in wrong] == []
        (tmp_path / "busy").touch()
        _until(tmp_path, "violated", within_s=_FOUND_S)
        up_b.until_found("flow.delay")


_FOUND_S = 4.0
"""2 s, and as much on a machine that is busy."""


def _until(directory: Path, outcome: str, within_s: float = 30.0) -> None:
    """Wait until the delay of the video is judged so."""
    until_s = time.monotonic() + within_s
    while True:
        flow = _measured(directory, "b")
        found = [] if flow is None else [each.outcome for each in flow.bounds]
        if found == [outcome]:
            return
        assert time.monotonic() < until_s, f"{found}, not {outcome} within {within_s} s"
        time.sleep(0.1)


def test_what_a_publisher_elsewhere_missed_while_it_was_paused_is_no_fault(
    pair: tuple[Host, Host], tmp_path: Path
) -> None:
    kept = {"topic": "/video", "from": "n1", "to": "n2", "rate_hz": 20, "max_silence_s": 1.5}
    manifest = article(tmp_path, pair[0].ipv4, pair[1].ipv4, edit={**_EDIT, "links": [kept]})
    with _up(pair[0], manifest, "a") as up_a, _up(pair[1], manifest, "b") as up_b:
        for up in (up_a, up_b):
            up.until("system", reached="active")
        verb_on(pair[0], "pause", "article", runtime=tmp_path / "a")
        time.sleep(3.0)
        assert verb_on(pair[0], "resume", "article", runtime=tmp_path / "a").returncode == 0
        time.sleep(5.0)
        flow = _measured(tmp_path, "b")
        assert flow is not None
        assert [each.outcome for each in flow.bounds] == ["ok", "ok"]
        found = [
            each["rule"]
            for verdict in up_b.of_kind("verdict")
            for each in verdict["verdict"]["findings"]
        ]
        assert {"flow.rate", "flow.silent"}.isdisjoint(found)
        # Whoever has the subscription, the rate shows on both hosts.
        for host, machine in zip(pair, "ab", strict=True):
            shown = verb_on(
                host, "flows", "article", "--format", "json", runtime=tmp_path / machine
            )
            assert shown.returncode == ExitCode.OK, shown.stderr
            rates = {
                each["topic"]: each["measured"]["rate_hz"] for each in json.loads(shown.stdout)
            }
            assert rates["/video"] > 0, (machine, rates)
