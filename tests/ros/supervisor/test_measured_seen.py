"""What is measured of a running system, as people and programs see it: fresh, and in no journal."""

from __future__ import annotations

import csv
import itertools
import json
import re
import signal
import subprocess
import time
from pathlib import Path

import pytest

from lifecycle.errors import ExitCode
from tests.ros.supervisor.running import ENOUGH, ROOT, Up, command, environment, pair, up, verb
from tests.ros.supervisor.test_orders import Panel

pytestmark = pytest.mark.thorough

FLOW = "/chatter /talker → /listener"
LATE = {"topic": "/chatter", "from": "talker", "to": "listener", "max_delay_ms": 0.001}
"""The talker publishes at 50 Hz; no message is received within a microsecond."""
DECLARED = {
    "links": [LATE],
    "nodes/talker/flows/publishers/chatter": {"rate_hz": 20},
}


def decided(run: Up) -> None:
    """Wait until it is known that the delay is too long."""
    run.until("system", reached="active")
    run.until_found("flow.delay")


def test_numbers_are_seen_fresh_by_every_way_and_fill_no_journal(
    tmp_path: Path, fresh_domain: int
) -> None:
    manifest = pair(tmp_path, fresh_domain, edit=DECLARED)
    with Panel(fresh_domain) as panel, up(manifest, runtime=tmp_path) as run:
        decided(run)
        told = verb("status", "pair", runtime=tmp_path).stdout.splitlines()[1]
        assert re.fullmatch(
            rf"measured: 1 flow violated: {FLOW}: delay p99 [\d.]+ ms > 0\.001 ms", told
        )
        (flow,) = json.loads(verb("status", "pair", "--format", "json", runtime=tmp_path).stdout)[
            "measured"
        ]
        assert {each["name"]: each["outcome"] for each in flow["bounds"]} == {
            "max_delay_ms": "violated",
            "rate_hz": "ok",
        }
        assert flow["rate_hz"] == pytest.approx(50, rel=0.2)

        text = verb("flows", "pair", *ENOUGH, runtime=tmp_path).stdout.splitlines()
        assert text[0].split()[1:7] == ["Hz", "p50", "ms", "p99", "ms", "lost"]
        assert re.search(r"^violated +\d+\.\d ███ +[\d.]+ +[\d.]+!███ +\d+/\d+ ", text[1])
        (flow,) = json.loads(
            verb("flows", "pair", *ENOUGH, "--format", "json", runtime=tmp_path).stdout
        )
        assert flow["measured"]["p99_ms"] >= flow["measured"]["p50_ms"] > 0
        judged = verb("verify", str(manifest), *ENOUGH, "--format", "json", runtime=tmp_path)
        assert judged.returncode == ExitCode.VIOLATED
        assert json.loads(judged.stdout)["measured"][0]["topic"] == "/chatter"

        before = run.catch_up()
        with subprocess.Popen(
            [*command("flows"), "pair", "--watch", "--format", "json"],
            cwd=ROOT,
            env=environment(tmp_path, ""),
            stdout=subprocess.PIPE,
            text=True,
        ) as watch:
            assert watch.stdout is not None
            seen = [json.loads(watch.stdout.readline())[0]["measured"] for _ in range(5)]
            began_s = time.monotonic()
            seen += [json.loads(watch.stdout.readline())[0]["measured"] for _ in range(4)]
            assert 2 < time.monotonic() - began_s < 12
            watch.send_signal(signal.SIGINT)
        assert len({each["p50_ms"] for each in seen}) > 1

        panel.subscribe_status()

        def entries() -> dict[str, tuple[int, dict[str, str]]]:
            return {
                each.name: (each.level[0], {one.key: one.value for one in each.values})
                for array in panel.diagnostics[-1:]
                for each in array.status
            }

        panel.until(lambda: f"pair: {FLOW}" in entries())
        level, values = entries()[f"pair: {FLOW}"]
        assert level == 2
        assert {"lost", "rate_hz", "p50_ms", "p99_ms", "max_delay_ms"} <= values.keys()
        assert values["max_delay_ms"].endswith("> 0.001 ms")
        panel.until(lambda: len(panel.statuses) > 1)
        numbers = [json.loads(each.data)["measured"] for each in panel.statuses]
        assert numbers[0] != numbers[-1]

        # What was found in between was found by changes alone.
        run.catch_up()
        verdicts = [each for each in run.events[before:] if each.get("event") == "verdict"]
        assert len(verdicts) <= 2
        run.signal(signal.SIGTERM)
        run.finish()


def recording(file: Path, runtime: Path) -> subprocess.Popen[str]:
    """`lifecycle flows pair --record FILE`."""
    return subprocess.Popen(
        [*command("flows"), "pair", "--record", str(file)],
        cwd=ROOT,
        env=environment(runtime, ""),
        stderr=subprocess.PIPE,
        text=True,
    )


def until_rows(file: Path, number: int) -> None:
    """Wait until so many rows are recorded."""
    while not file.is_file() or file.read_text().count("\n") < 1 + number:
        time.sleep(0.05)


def test_a_record_has_a_row_a_second_and_ends_with_its_supervisor(
    tmp_path: Path, fresh_domain: int
) -> None:
    file = tmp_path / "flows.csv"
    with up(pair(tmp_path, fresh_domain, edit=DECLARED), runtime=tmp_path) as run:
        decided(run)
        with recording(file, tmp_path) as records:
            until_rows(file, 3)
            records.send_signal(signal.SIGINT)
            assert records.wait(20) == ExitCode.INTERRUPTED
            assert records.stderr is not None
            assert re.search(rf"\d rows in '{file}'", records.stderr.read())
        rows = list(csv.DictReader(file.read_text().splitlines()))
        assert {each["outcome"] for each in rows} == {"violated"}
        seconds = [float(each["seconds"]) for each in rows]
        assert all(0 < b - a < 2 for a, b in itertools.pairwise(seconds)), seconds
        assert float(rows[-1]["rate_hz"]) == pytest.approx(50, rel=0.2)

        file.unlink()
        with recording(file, tmp_path) as records:
            until_rows(file, 1)
            assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
            assert records.wait(20) == ExitCode.OK
            assert records.stderr is not None
            assert "its supervisor has ended" in records.stderr.read()
        run.finish()


def test_what_nobody_declares_is_counted_and_recorded_from_outside(
    tmp_path: Path, fresh_domain: int
) -> None:
    file = tmp_path / "flows.csv"
    with up(pair(tmp_path, fresh_domain), runtime=tmp_path) as run:
        run.until("system", reached="active")
        assert "measured" not in verb("status", "pair", runtime=tmp_path).stdout
        with recording(file, tmp_path) as records:
            until_rows(file, 2)
            records.send_signal(signal.SIGINT)
            assert records.wait(20) == ExitCode.INTERRUPTED
        rows = list(csv.DictReader(file.read_text().splitlines()))
        assert len(rows) >= 2
        assert {each["outcome"] for each in rows} == {""}
        assert int(rows[-1]["messages"]) > 10
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK
