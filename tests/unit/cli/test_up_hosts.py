"""What `lifecycle up --hosts` prints, and what it refuses before anything is started."""

from __future__ import annotations

import io
import json
import os
from pathlib import Path

import pytest
from rich.console import Console

from lifecycle.cli import main
from lifecycle.cli.hosts import JsonHosts, PlainHosts
from lifecycle.cli.live_view import LiveHosts
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
        (("--hosts", "--until", "verified"), "cannot use --until with --hosts"),
        (("--hosts", "--report", "r.json"), "cannot use --report with --hosts"),
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
