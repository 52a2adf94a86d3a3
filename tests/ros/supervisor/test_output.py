"""`lifecycle up` whose output, followers, logs or disks fail: it goes on, and takes all down."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import pty
import re
import signal
import socket
import struct
import subprocess
import sys
import termios
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import pytest

from lifecycle.errors import ExitCode
from lifecycle.run_directory import short_path
from lifecycle.supervisor.control.protocol import ControlRequest, Question, ask
from tests.ros.supervisor.running import (
    BOUND_S,
    ROOT,
    Up,
    command,
    environment,
    left_of,
    marked,
    pair,
    up,
    verb,
)

pytestmark = pytest.mark.thorough

_CHATTY = {"nodes/talker/run/python": "tests.ros.supervisor.systems:Chatty"}
_ENDS_S = 15.0
"""A take-down takes a second or two, the last of the output more; a busy machine doubles it."""


class _Run:
    """A `lifecycle up` whose standard streams a test chooses."""

    def __init__(self, manifest: Path, *options: str, runtime: Path, **streams: Any) -> None:
        self.mark = uuid.uuid4().hex
        self.runtime = runtime
        self.process = subprocess.Popen(
            [*command("up"), str(manifest), *options],
            cwd=ROOT,
            env=environment(runtime, self.mark),
            start_new_session=True,
            **streams,
        )

    @property
    def stdout(self) -> IO[bytes]:
        assert self.process.stdout is not None
        return self.process.stdout

    def phase(self) -> str:
        """Ask over the control socket; a process for each question would take far longer."""
        for path in (self.runtime / "lifecycle").glob("pair@*/control"):
            with contextlib.suppress(OSError):
                answer = ask(path, Question(ask=ControlRequest.STATUS), BOUND_S)
                if answer is not None and answer.status is not None:
                    return answer.status.phase
        return ""

    def until_active(self) -> None:
        _wait(lambda: self.phase() == "active", self.process)

    def log(self, process: str) -> str:
        (path,) = (self.runtime / "log").glob(f"20*/{process}.log")
        return path.read_text()


def _wait(holds: Callable[[], object], process: subprocess.Popen[Any] | None = None) -> None:
    deadline = time.monotonic() + BOUND_S
    while not holds():
        assert process is None or process.poll() is None, "it ended"
        assert time.monotonic() < deadline, f"not within {BOUND_S:g} s"
        time.sleep(0.05)


@contextlib.contextmanager
def _started(manifest: Path, *options: str, runtime: Path, **streams: Any) -> Iterator[_Run]:
    run = _Run(manifest, *options, runtime=runtime, **streams)
    try:
        yield run
    finally:
        for each in marked(run.mark):
            with contextlib.suppress(ProcessLookupError):
                os.kill(each.pid, signal.SIGKILL)
        run.process.wait(BOUND_S)
        if run.process.stdout is not None:
            run.process.stdout.close()


def _unread(stream: IO[bytes]) -> int:
    """Return how many bytes wait in a pipe."""
    return int(struct.unpack("i", fcntl.ioctl(stream, termios.FIONREAD, b"\0" * 4))[0])


@pytest.mark.parametrize(("format_", "end"), [("text", "SIGTERM"), ("json", "down")])
def test_output_that_nobody_reads_stops_nothing_and_says_what_is_missing_once_it_is_read(
    tmp_path: Path, fresh_domain: int, format_: str, end: str
) -> None:
    manifest = pair(tmp_path, fresh_domain, edit=_CHATTY)
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with _started(manifest, "--format", format_, runtime=tmp_path, **streams) as run:
        run.until_active()
        _wait(lambda: _unread(run.stdout) > 40_000, run.process)
        # Far more than is kept for a reader comes meanwhile.
        written = len(run.log("talker"))
        _wait(lambda: len(run.log("talker")) > written + 1_500_000, run.process)
        assert verb("pause", "pair", runtime=tmp_path).returncode == ExitCode.OK
        told = verb("status", "pair", "--format", "json", runtime=tmp_path)
        assert json.loads(told.stdout)["phase"] == "paused"
        said: list[str] = []
        while "lines are missing here" not in (said or [""])[-1]:
            line = run.stdout.readline().decode()
            assert line, said[-5:]
            said.append(line)
        assert verb("resume", "pair", runtime=tmp_path).returncode == ExitCode.OK
        if format_ == "json":
            events = [json.loads(each) for each in said]
            assert events[-1]["event"] == "notice"
            assert [e["reached"] for e in events if e["event"] == "system"][-1] == "paused"
            requests = [e["operation"] for e in events if e["event"] == "request"]
            assert "deactivate" in requests  # the log lines of then are missing, this is not
        _wait(lambda: _unread(run.stdout) > 40_000, run.process)
        began = time.monotonic()
        if end == "down":
            assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
        else:
            run.process.terminate()
        assert run.process.wait(BOUND_S) == ExitCode.OK
        assert time.monotonic() - began < _ENDS_S
        assert left_of(run.mark) == []


def test_followers_that_stop_reading_do_not_keep_a_run_from_ending(
    tmp_path: Path, fresh_domain: int
) -> None:
    with up(pair(tmp_path, fresh_domain), runtime=tmp_path) as run:
        run.until("system", reached="active")
        path = tmp_path / "lifecycle" / f"pair@{fresh_domain}" / "control"
        with contextlib.ExitStack() as followers:
            for question in (b'{"ask":"look"}\n' * 500, b'{"ask":'):
                client = followers.enter_context(socket.socket(socket.AF_UNIX))
                with short_path(path) as name:
                    client.connect(name)
                client.sendall(question)
            watches = [
                followers.enter_context(
                    subprocess.Popen(
                        [*command(each), "pair", "--watch"],
                        cwd=ROOT,
                        env=environment(tmp_path, run.mark),
                        stdout=subprocess.PIPE,
                    )
                )
                for each in ("graph", "status")
            ]
            for watch in watches:
                followers.callback(watch.kill)  # before it is waited for, whatever happens
            for watch in watches:
                assert watch.stdout is not None
                assert b"pair" in watch.stdout.readline()
                watch.send_signal(signal.SIGSTOP)
            began = time.monotonic()
            run.signal(signal.SIGTERM)
            assert run.finish() == ExitCode.OK
            assert time.monotonic() - began < _ENDS_S
        run.assert_nothing_left()


@pytest.mark.parametrize("both", [False, True])
def test_a_reader_that_goes_away_ends_its_output_and_not_the_run(
    tmp_path: Path, fresh_domain: int, *, both: bool
) -> None:
    report = tmp_path / "report.json"
    words = (str(pair(tmp_path, fresh_domain, edit=_CHATTY)), "--report", str(report))
    errors = tmp_path / "errors"
    with errors.open("wb") as file:
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT if both else file}
        with _started(Path(words[0]), *words[1:], runtime=tmp_path, **streams) as run:
            assert run.stdout.readline().startswith(b"pair: 2 nodes")
            run.stdout.close()
            run.until_active()
            assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
            assert run.process.wait(BOUND_S) == ExitCode.OK
            assert left_of(run.mark) == []
            ends = [each for each in run.log("talker").splitlines() if not each.startswith("x")]
    assert ends == ["deactivated", "cleaned up", "shut down"]
    assert json.loads(report.read_text())["verdict"] == "ok"
    if not both:
        assert errors.read_text() == (
            "standard output was closed by its reader; the run goes on without it\n"
        )


def test_a_terminal_that_is_stopped_or_closed_stops_nothing(
    tmp_path: Path, fresh_domain: int
) -> None:
    ours, terminal = pty.openpty()
    manifest = pair(tmp_path, fresh_domain, edit=_CHATTY)
    streams = dict.fromkeys(("stdout", "stderr"), terminal)
    with _started(manifest, runtime=tmp_path, **streams) as run:
        os.close(terminal)
        run.until_active()
        # Nobody has read a byte: as after Ctrl-S.
        written = len(run.log("talker"))
        _wait(lambda: len(run.log("talker")) > written + 1_500_000, run.process)
        shown = b""
        while b"lines are missing here: nobody read standard output in time" not in shown:
            shown = shown[-10_000:] + os.read(ours, 65536)
        os.close(ours)
        written = len(run.log("talker"))
        _wait(lambda: len(run.log("talker")) > written, run.process)
        assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
        assert run.process.wait(BOUND_S) == ExitCode.OK
        assert left_of(run.mark) == []


def test_standard_streams_that_are_full_or_closed_change_nothing(
    tmp_path: Path, fresh_domain: int
) -> None:
    manifest = pair(tmp_path, fresh_domain)
    mark = uuid.uuid4().hex
    words = [*command("up"), str(manifest), "--stop-after", "0.2"]
    for streams, options, expected in (
        (">/dev/full", (), 2),
        ("<&- >&- 2>&-", ("--format", "json"), 0),
    ):
        done = subprocess.run(
            ["sh", "-c", f'exec "$@" {streams}', "sh", *words, *options],
            cwd=ROOT,
            env=environment(tmp_path, mark),
            capture_output=True,
            text=True,
            timeout=BOUND_S,
            check=False,
        )
        assert (done.returncode, done.stdout) == (ExitCode.OK, "")
        assert left_of(mark) == []
        said = done.stderr.splitlines()
        assert len(said) == expected, said
        if said:
            assert said[0] == (
                "cannot write standard output: No space left on device; the run goes on, and what "
                "is lost is counted"
            )
            missing = r"\d+ lines are missing at the end of standard output: .*"
            assert re.fullmatch(missing, said[1])


def _can_mount() -> bool:
    trial = ["unshare", "-m", "mount", "-t", "tmpfs", "tmpfs", "/mnt"]
    try:
        return subprocess.run(trial, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not _can_mount(), reason="needs root, to mount a small file system")
def test_a_full_disk_under_logs_and_run_directory_is_said_once_and_supervision_goes_on(
    tmp_path: Path, fresh_domain: int
) -> None:
    manifest = pair(tmp_path, fresh_domain, edit=_CHATTY)
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = ("unshare", "-m", "sh", "-c", 'mount -t tmpfs -o size=2m tmpfs "$0"; exec "$@"')
    run = Up(manifest, runtime=disk, through=(*mounted, str(disk)))
    inside = Path(f"/proc/{run.process.pid}/root{disk}")

    def asked(name: str, *words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["nsenter", "-m", "-t", str(run.process.pid), *command(name), *words],
            cwd=ROOT,
            env=environment(disk, ""),
            capture_output=True,
            text=True,
            timeout=BOUND_S,
            check=False,
        )

    try:
        full = run.until("notice")
        assert full["message"].startswith("cannot write the log of process 'talker'")
        assert full["message"].endswith(
            "No space left on device; the run goes on, and what is lost is counted"
        )
        run.met("system", reached="active")
        filler = inside / "filler"
        with contextlib.suppress(OSError), filler.open("ab", buffering=0) as file:
            while file.write(b"x" * 512):
                pass
        assert asked("restart", "pair", "talker").returncode == ExitCode.OK
        assert json.loads(asked("status", "pair", "--format", "json").stdout)["phase"] == "active"
        # Room again: what is missing is said where it is missing, and to whoever follows.
        filler.unlink()
        (log,) = (inside / "log").glob("20*/talker.log")
        os.truncate(log, 0)
        while "log lines are missing in" not in run.until("notice")["message"]:
            pass
        _wait(lambda: " log lines are missing here: No space left on device\n" in log.read_text())
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK
        said = [each["message"] for each in run.of_kind("notice")]
        unwritten = [each for each in said if each.startswith("cannot write")]
        assert len(unwritten) == len(set(unwritten)) == 3, said  # two logs and the journal
        assert run.said() == ""
        run.assert_nothing_left()
    finally:
        run.close()


def test_a_report_on_a_full_disk_is_one_clear_error_and_no_success(
    tmp_path: Path, fresh_domain: int
) -> None:
    report = tmp_path / "report.json"
    report.symlink_to("/dev/full")
    words = (str(pair(tmp_path, fresh_domain)), "--until", "connected", "--report", str(report))
    said = f"cannot write report {str(report)!r}: No space left on device\n"
    done = verb("up", *words, runtime=tmp_path)
    assert (done.returncode, done.stderr) == (ExitCode.USAGE, said)
    done = verb("check", words[0], "--report", str(report), runtime=tmp_path)
    assert (done.returncode, done.stderr) == (ExitCode.USAGE, said)
    # What the command found out is not lost over it.
    options = ("--timeout", "0.1", "--report", str(report))
    done = verb("verify", words[0], *options, runtime=tmp_path)
    assert done.returncode == ExitCode.VIOLATED
    assert done.stderr.startswith(said)
    assert done.stdout.startswith("verdict: violated")


def test_the_exit_code_of_a_verb_does_not_depend_on_who_reads_it(tmp_path: Path) -> None:
    valid = str(pair(tmp_path, 1))
    wrong = tmp_path / "wrong.lifecycle.yaml"
    wrong.write_text("manifest_version: 1\nsystem: 7\n")

    def code(words: str, *arguments: str) -> tuple[int, str]:
        script = f"exec {sys.executable} -m lifecycle {words}"
        done = subprocess.run(
            ["sh", "-c", script, "sh", *arguments],
            cwd=ROOT,
            env=environment(tmp_path, ""),
            capture_output=True,
            text=True,
            timeout=BOUND_S,
            check=False,
        )
        return done.returncode, done.stderr

    lost = "cannot write standard output: No space left on device\n"
    assert code('plan "$1" >/dev/full', valid) == (ExitCode.USAGE, lost)
    assert code('plan "$1" >&-', valid) == (ExitCode.OK, "")
    assert code('check "$1" 2>/dev/full', str(wrong))[0] == ExitCode.MANIFEST_INVALID
    for words, expected in (
        ('check "$1"', ExitCode.MANIFEST_INVALID),
        ("status nothing", ExitCode.USAGE),
    ):
        read, write = os.pipe()
        os.close(read)
        with os.fdopen(write, "wb") as broken:
            done = subprocess.run(
                ["sh", "-c", f"exec {sys.executable} -m lifecycle {words}", "sh", str(wrong)],
                cwd=ROOT,
                env=environment(tmp_path, ""),
                stdout=broken,
                stderr=broken,
                timeout=BOUND_S,
                check=False,
            )
        assert done.returncode == expected
