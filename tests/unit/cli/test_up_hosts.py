"""What `lifecycle up --hosts` prints, and what it refuses before anything is started."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from lifecycle.cli import main
from lifecycle.cli.hosts import JsonHosts, LastVerdicts, PlainHosts
from lifecycle.cli.live_view import LiveHosts
from lifecycle.cli.report import format_verdict
from lifecycle.cli.standard_streams import Writer
from lifecycle.errors import ExitCode
from lifecycle.fleet import Record
from lifecycle.supervisor import NodeChanged, Reach, RunStarted, to_record
from lifecycle.verify import Finding, Outcome, RunEnd, Verdict, to_json
from tests.unit.fleet.fakes import World
from tests.unit.supervisor.fakes import run

MANIFEST = """
manifest_version: 1
system: patrol
machines: {a: {address: 127.0.0.1}, b: {address: 10.255.255.1}}
nodes:
  camera: {run: {command: [sleep, "1"]}, machine: a, interface: {}}
"""
VERDICT: Record = {
    "host": "b",
    **json.loads(
        to_json(
            Verdict(
                verdict=Outcome.VIOLATED,
                blocking=True,
                findings=(
                    Finding(
                        rule="run.process-died",
                        outcome=Outcome.VIOLATED,
                        subject="/camera",
                        expected="",
                        observed="",
                        message="the process of /camera was killed by SIGKILL",
                    ),
                ),
                flows=(),
                run=RunEnd(reason="failed", reached="active", exit_code=6),
            )
        )
    ),
}


class Lines:
    def __init__(self) -> None:
        self.lines: list[tuple[str, bool]] = []

    def put(self, text: str, *, kept: bool = True) -> None:
        self.lines.append((text, kept))

    def close(self) -> None: ...


def _said() -> list[Record]:
    """Return what a coordinator says of two hosts, one of which is ahead and is cut off."""
    world = World()
    world.host("a")
    world.host("b", ahead_s=-2.5, active_s=2.0)

    async def go() -> None:
        await world.run(stop_after_s=3.0)

    run(go())
    return world.said


def test_lines_have_their_host_in_front_and_say_clocks_that_differ() -> None:
    sink = Lines()
    output = PlainHosts(sink)
    for each in _said():
        output(each["host"], each)
    output("b", VERDICT)
    text = "".join(line for line, _ in sink.lines)
    assert text.startswith("patrol on a (op@a), b (op@b)\na | connected\nb | connected\n")
    assert "b | its clock is 2.500 s behind this host's (± 0.001 s): times in messages" in text
    assert "a | its clock" not in text
    assert "a | system active after 1.00 s\n" in text
    assert "system active on all hosts (a, b) after" in text
    assert "ending all: done\n" in text
    assert "ended: done; exit code 0 (a 0, b 0)\n" in text
    assert "b | violated run.process-died: /camera\n" in text


def test_each_json_line_has_its_host_and_only_log_lines_may_be_dropped() -> None:
    sink = Lines()
    output = JsonHosts(sink)
    records = [*_said(), VERDICT, {"host": "a", "event": "log", "line": "\u202e"}]
    for each in records:
        output(each["host"], each)
    assert [json.loads(line) for line, _ in sink.lines] == json.loads(json.dumps(records))
    assert [kept for _, kept in sink.lines] == [True] * (len(records) - 1) + [False]
    assert all(line.isascii() or line.strip().isprintable() for line, _ in sink.lines)


def test_the_live_view_has_a_row_for_each_host() -> None:
    screen = io.StringIO()
    read, write = os.pipe()
    writer = Writer(write, "a pipe", marker=str)
    try:
        console = Console(file=screen, width=120, height=30, force_terminal=True)
        with LiveHosts("patrol", ("a", "b"), writer=writer, console=console) as live:
            for each in _said():
                live(each["host"], each)
            started = RunStarted(
                system="patrol",
                domain_id=7,
                rmw="rmw_fastrtps_cpp",
                discovery_range="subnet",
                nodes=("/camera", "/lamp"),
                processes=(),
                log_directory="/tmp",
            )
            active = NodeChanged(node="/lamp", reach=Reach.ACTIVE, state="active", connected=True)
            for event in (started, active):
                live("b", {"host": "b", **to_record(event)})
    finally:
        writer.close()
        os.close(read)
        os.close(write)
    text = screen.getvalue()
    assert "-2500.0 ms ± 1.0" in text
    assert "1/2" in text
    assert "system active on all hosts (a, b)" in text


JUNK = (
    b" ",
    b"\xff\x00\x1b[2J",
    b"null",
    b"[" * 100_000,
    b'{"event":["run"]}',
    b'{"event":"run","nodes":7}',
    b'{"event":"node","node":"/x","reach":"flying"}',
    b'{"event":"verdict","verdict":{"verdict":"great"}}',
    b'{"event":"end","host":""}',
    b'{"event":"clock"}',
    b'{"event":"host","state":"\\u001b[2J"}',
    b'{"event":"stopped","exit_code":"none","host":"a"}',
    b'{"verdict":[],"run":7}',
    b'{"event":"system","reached":"\\u001b]0;x\\u0007","elapsed_s":1}',
    b'{"event":"log","process":"n","stream":"stdout","line":"\\u001b[31mred"}',
)


def test_nothing_that_a_host_says_ends_the_run_speaks_for_another_or_reaches_the_terminal() -> None:
    world = World()
    world.host("a")
    world.host("b", junk=JUNK)
    assert run(world.run(stop_after_s=3.0)) is ExitCode.OK
    for kind in ("end", "active"):
        assert len(world.of(kind)) == 1
    assert {each["host"] for each in world.said if each.get("event") == "stopped"} == {"b"}
    sink, screen = Lines(), io.StringIO()
    read, write = os.pipe()
    writer = Writer(write, "a pipe", marker=str)
    try:
        console = Console(file=screen, width=120, height=30, force_terminal=True)
        with LiveHosts("patrol", ("a", "b"), writer=writer, console=console) as live:
            for output in (PlainHosts(sink), JsonHosts(sink), live):
                for each in world.said:
                    output(each["host"], each)
    finally:
        writer.close()
        os.close(read)
        os.close(write)
    assert all(line.rstrip("\n").isprintable() for line, _ in sink.lines)
    assert "\x1b]0;" not in screen.getvalue()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--host", "a=b"), "cannot use --host a=b without --hosts"),
        (("--hosts", "--host", "a"), "cannot read --host 'a'; write MACHINE=[USER@]HOST"),
        (("--hosts", "--host", "a=-oX"), "cannot read --host 'a=-oX'; write MACHINE=[USER@]HOST"),
        (("--hosts", "--host", "moon=x"), "the manifest declares no such machine"),
        (("--hosts", "--machine", "a"), "cannot use --machine with --hosts"),
        (("--hosts", "--program", "nft"), "cannot use --program with --hosts"),
    ],
)
def test_what_cannot_be_meant_is_refused_before_anything_is_started(
    arguments: tuple[str, ...],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    manifest = tmp_path / "m.lifecycle.yaml"
    manifest.write_text(MANIFEST)
    assert main(["up", str(manifest), *arguments]) == ExitCode.USAGE
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("verb", "arguments", "message"),
    [
        ("status", ("--host", "a=b"), "cannot use --host a=b without --hosts"),
        ("status", ("--hosts", "--machine", "a"), "cannot use --machine, with --hosts"),
        ("status", ("--hosts", "--watch"), "cannot use --watch with --hosts"),
        ("down", ("--hosts", "--machine", "a"), "cannot use --machine, with --hosts"),
    ],
)
def test_a_verb_for_all_machines_takes_a_manifest_and_no_machine(
    verb: str,
    arguments: tuple[str, ...],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    manifest = tmp_path / "m.lifecycle.yaml"
    manifest.write_text(MANIFEST)
    assert main([verb, str(manifest), *arguments]) == ExitCode.USAGE
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("verb", ["status", "down"])
def test_a_running_systems_name_does_not_say_where_its_machines_are(
    verb: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([verb, "patrol", "--hosts"]) == ExitCode.USAGE
    said = capsys.readouterr().err
    assert "cannot use 'patrol', which is no manifest, with --hosts" in said
    assert f"lifecycle {verb} MANIFEST --hosts" in said


def test_one_report_has_what_any_supervisor_found_and_each_machines_own_verdict() -> None:
    silent: list[Record] = []
    last = LastVerdicts("abc", lambda _, record: silent.append(record))
    last("", {"host": "", "event": "active", "hosts": ["a", "b", "c"], "elapsed_s": 1.0})
    last("a", {**VERDICT, "host": "a"})
    last("b", VERDICT)
    last("c", {"host": "c", "event": "host", "message": "its supervisor still runs"})
    last("", {"host": "", "event": "end", "reason": "done", "exit_code": 6})
    found = last.combined()
    assert (found.verdict, found.judged) == (Outcome.VIOLATED, False)
    assert [each.message for each in found.findings] == [
        "the process of /camera was killed by SIGKILL (found by the supervisor of a, b)"
    ]
    assert found.run == RunEnd(
        reason="done; no verdict of c (its supervisor still runs)", reached="active", exit_code=6
    )
    written = json.loads(format_verdict(found, None, "json", machines=last.verdicts))
    assert {name: each and each["verdict"] for name, each in written["machines"].items()} == {
        "a": "violated",
        "b": "violated",
        "c": None,
    }
    assert "machine c: no verdict" in format_verdict(found, None, "text", machines=last.verdicts)
    assert len(silent) == 5


def test_that_machines_ended_before_is_no_finding_of_one_that_ended_well() -> None:
    own = {name: each for name, each in VERDICT.items() if name not in {"host", "run"}}
    fine = {**own, "verdict": "ok", "findings": []}
    done = {"reason": "terminated", "reached": "active", "exit_code": 0}
    last = LastVerdicts("ab", lambda *_: None)
    for host in "ab":
        last(host, {"host": host, "event": "verdict", "stage": "active", "verdict": fine})
    last("", {"host": "", "event": "ending", "reason": "terminated"})
    last("a", {"host": "a", **fine, "run": done})
    last("b", {"host": "b", "event": "verdict", "stage": "active", "verdict": own})
    last("b", {"host": "b", **own, "run": done})
    last("", {"host": "", "event": "end", "reason": "terminated", "exit_code": 0})
    assert (last.combined().verdict, last.combined().findings) == (Outcome.OK, ())
    # What ended badly has its own last word.
    last("b", VERDICT)
    assert last.combined().verdict is Outcome.VIOLATED


def test_a_report_of_all_hosts_says_what_kept_them_from_being_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest = tmp_path / "m.lifecycle.yaml"
    manifest.write_text(MANIFEST.replace("machine: a", "machine: b"))
    monkeypatch.setenv("LIFECYCLE_SSH", "sh -c 'echo Connection refused >&2; exit 255'")
    report = tmp_path / "r.json"
    up = (sys.executable, "-m", "lifecycle.cli", "up", str(manifest), "--hosts")
    done = subprocess.run([*up, "--report", str(report)], capture_output=True, check=False)
    assert done.returncode == ExitCode.BRING_UP_FAILED, done.stderr
    found = json.loads(report.read_text())
    assert (found["verdict"], found["judged"]) == ("unverifiable", False)
    assert found["run"]["exit_code"] == ExitCode.BRING_UP_FAILED
    assert "no verdict of b (Connection refused)" in found["run"]["reason"]
    manifest.write_text("nodes: [")
    assert main(["up", str(manifest), "--hosts", "--report", str(report)]) != ExitCode.OK
    assert "the manifest is invalid" in json.loads(report.read_text())["run"]["reason"]
