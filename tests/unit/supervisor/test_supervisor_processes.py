"""Real processes without ROS: the fork server, process states, output, and orphans."""

from __future__ import annotations

import asyncio
import os
import pwd
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.model import Resources, Run, RunKind
from lifecycle.plan.model import PlannedProcess
from lifecycle.run_directory import RUN_VARIABLE, ChildRecord, RunRecord, boot_id, start_ticks
from lifecycle.supervisor.processes import logs
from lifecycle.supervisor.processes.control_channel import ControlChannel
from lifecycle.supervisor.processes.fork_server import ForkServer, end_run
from lifecycle.supervisor.processes.fork_server_main import ForkServerProcess
from lifecycle.supervisor.processes.logs import (
    LONGEST_LINE,
    LineReader,
    LogDirectory,
    ProcessLog,
    Traceback,
    ros_log_root,
)
from lifecycle.supervisor.processes.process import ManagedProcess, ProcessExit, scope, unlimited
from lifecycle.supervisor.run.events import Emitter, LogLine
from lifecycle.verify.outcome import Outcome
from tests.builders import planned_node
from tests.unit.supervisor.fakes import host_spec

PYTHON = sys.executable
BOUND_S = 20.0
REAL_TIME = True
WHY_UNLIMITED = "lifecycle.supervisor.processes.process.why_unlimited"


class _Bench:
    """A fork server and processes of it."""

    def __init__(self, tmp_path: Path) -> None:
        self.server = ForkServerProcess(preload=False)
        self.fork_server = ForkServer(self.server)
        self.lines: list[str] = []
        self.spoke = asyncio.Event()
        self.emit = Emitter()
        self.emit.listen(self._take)
        self._logs = LogDirectory(tmp_path, lambda _: None)
        self._processes: list[ManagedProcess] = []

    def _take(self, event: object) -> None:
        if isinstance(event, LogLine):
            self.lines.append(event.line)
            self.spoke.set()

    async def __aenter__(self) -> _Bench:  # noqa: PYI034 - typing.Self is not in Python 3.10
        return self

    async def __aexit__(self, *_: object) -> None:
        for process in self._processes:
            process.signal(signal.SIGKILL)
            await process.release()
        self.fork_server.close()

    async def start(self, *argv: str, resources: Resources | None = None, **how: Any) -> Any:
        run = Run(kind=RunKind.COMMAND, command=argv, resources=resources)
        planned = PlannedProcess(name="it", machine="", run=run, nodes=("it",), argv=argv, **how)
        process = ManagedProcess(planned, logs=self._logs, emit=self.emit)
        self._processes.append(process)
        await process.spawn(self.fork_server, None)
        return process


async def _ended(process: ManagedProcess) -> None:
    """End a process as the supervisor does, by ever stronger means."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        if not process.ended.done():
            process.signal(number)
            await asyncio.wait({process.ended}, timeout=1.0)
    await process.release()


async def test_a_command_gets_its_arguments_environment_and_session_and_its_end_is_noticed(
    tmp_path: Path,
) -> None:
    code = "import os; print(os.environ['COLOUR'], os.getsid(0) == os.getpid()); exit(3)"
    async with _Bench(tmp_path) as bench:
        process = await bench.start(PYTHON, "-c", code, environment=(("COLOUR", "red"),))
        assert await process.ended == ProcessExit(status=3)
        await _ended(process)
        assert bench.lines == ["red True"]
        assert process.log.path.read_text() == "red True\n"


async def test_a_killed_process_is_noticed_within_a_tenth_of_a_second(tmp_path: Path) -> None:
    took_s = []
    async with _Bench(tmp_path) as bench:
        for _ in range(5):
            process = await bench.start("sleep", "60")
            began = time.monotonic()
            os.kill(process.pid, signal.SIGKILL)
            assert await process.ended == ProcessExit(signal=signal.SIGKILL)
            took_s.append(time.monotonic() - began)
    assert min(took_s) < 0.1  # the others may have had to wait for a processor


async def test_a_program_that_does_not_exist_says_so_in_its_output(tmp_path: Path) -> None:
    async with _Bench(tmp_path) as bench:
        process = await bench.start("/no/such/program")
        assert await process.ended == ProcessExit(status=127)
        await _ended(process)
        said = "cannot run '/no/such/program': No such file or directory\n"
        assert process.log.path.read_text() == said


async def test_a_process_that_ignores_sigint_and_sigterm_is_killed_with_its_group(
    tmp_path: Path,
) -> None:
    code = (
        "import signal, subprocess, time\n"
        "for number in (signal.SIGINT, signal.SIGTERM): signal.signal(number, signal.SIG_IGN)\n"
        "print(subprocess.Popen(['sleep', '60']).pid, flush=True)\n"
        "time.sleep(60)"
    )
    async with _Bench(tmp_path) as bench:
        process = await bench.start(PYTHON, "-c", code)
        await bench.spoke.wait()
        grandchild = psutil.Process(int(bench.lines[0]))
        await _ended(process)
        assert process.ended.result() == ProcessExit(signal=signal.SIGKILL)
        grandchild.wait(BOUND_S)


async def test_lines_are_split_and_a_line_without_end_cannot_fill_the_memory() -> None:
    read, write = os.pipe()
    lines: list[str] = []
    ended = asyncio.Event()

    def take(line: str) -> None:
        lines.append(line)
        if line == "last":
            ended.set()

    LineReader(read, take)
    loop = asyncio.get_running_loop()
    data = b"one\r\ntwo\nth\xffree\n" + b"x" * (3 * LONGEST_LINE) + b"\nlast"

    def fill() -> None:
        with os.fdopen(write, "wb") as pipe:
            pipe.write(data)

    await loop.run_in_executor(None, fill)
    await ended.wait()
    assert lines[:3] == ["one", "two", "th\ufffdree"]
    assert max(len(line) for line in lines) == LONGEST_LINE
    assert sum(len(line) for line in lines[3:-1]) == 3 * LONGEST_LINE
    assert lines[-1] == "last"


async def test_whoever_writes_faster_than_we_read_does_not_keep_a_pipe_from_being_closed() -> None:
    read, write = os.pipe()
    spoke = asyncio.Event()
    reader = LineReader(read, lambda _: spoke.set())
    with subprocess.Popen(  # noqa: ASYNC220 - an end that is waited for blocks nobody here
        ["yes"], stdout=write, stderr=subprocess.DEVNULL
    ) as left_behind:
        os.close(write)
        try:
            await spoke.wait()
            reader.close()
            assert left_behind.wait(BOUND_S) != 0  # it has no reader any more
        finally:
            left_behind.kill()


async def test_a_host_that_reads_nothing_any_more_does_not_keep_its_channel_from_closing() -> None:
    channel = ControlChannel(host_spec(planned_node("p"), system="s" * 2**22), lambda _: None)
    with await channel.open():
        await channel.close()


def test_a_log_that_is_full_is_rotated_and_keeps_one_older(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logs, "LARGEST_LOG", 20)
    said: list[str] = []
    log = ProcessLog(LogDirectory(tmp_path / "run", said.append), "ns/it")
    log.open()
    for number in range(9):
        log.add(f"line {number}")
    log.close()
    written = {each.name: each.read_text() for each in (tmp_path / "run").iterdir()}
    assert written == {
        "ns.it.log": "line 8\n",
        "ns.it.log.1": "line 6\nline 7\n",
    }
    assert said == []


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({"ROS_LOG_DIR": "/logs", "ROS_HOME": "/home"}, Path("/logs")),
        ({"ROS_HOME": "/home"}, Path("/home/log")),
        ({"HOME": "/home/robot"}, Path("/home/robot/.ros/log")),
        ({}, Path(pwd.getpwuid(os.getuid()).pw_dir) / ".ros/log"),
    ],
)
def test_logs_go_where_ros_puts_them(environment: dict[str, str], expected: Path) -> None:
    assert ros_log_root(environment) == expected


@pytest.fixture
def stray() -> Iterator[psutil.Popen]:
    """A process with the mark of run `abc` in its environment."""
    process = psutil.Popen(
        ["cat"],
        env={**os.environ, RUN_VARIABLE: "abc"},
        start_new_session=True,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    # Its environment can be read only once its exec is over: an echo proves that.
    process.stdin.write(b"here\n")
    process.stdin.flush()
    assert process.stdout.readline() == b"here\n"
    yield process
    process.stdin.close()
    process.stdout.close()
    if process.poll() is None:
        process.kill()
        process.wait()


def _record(run_id: str, *children: ChildRecord, boot: str = "") -> RunRecord:
    return RunRecord(
        run_id=run_id,
        boot_id=boot or boot_id(),
        supervisor=ChildRecord(name="supervisor", pid=1, start_ticks=1),
        children=children,
    )


def test_an_orphan_is_found_by_the_mark_of_its_run_even_if_nobody_recorded_it(
    stray: psutil.Popen,
) -> None:
    assert end_run(_record("abc")) == (stray.pid,)
    assert stray.wait(BOUND_S) == -signal.SIGTERM


def test_a_process_of_another_run_boot_or_start_time_is_left_alone(stray: psutil.Popen) -> None:
    ticks = start_ticks(stray.pid)
    assert ticks is not None
    reused = ChildRecord(name="it", pid=stray.pid, start_ticks=ticks - 1)
    same = ChildRecord(name="it", pid=stray.pid, start_ticks=ticks)
    assert end_run(_record("other", reused)) == ()
    assert end_run(_record("abc", same, boot="another boot")) == ()
    assert stray.poll() is None
    assert end_run(_record("other", same)) == (stray.pid,)


_CONFINED = """
import os, subprocess, sys
from lifecycle.supervisor.processes.fork_server_main import ForkRequest, _confine

def confine(*limits):
    request = dict(id=1, argv=(), environment=(), working_directory="", control=False)
    _confine(ForkRequest(**request, limits=limits, no_new_privileges=True))

confine(("RLIMIT_NOFILE", 77), ("RLIMIT_CPU", 60), ("RLIMIT_AS", 4096 * 2**20))
assert "rclpy" not in sys.modules
status = "grep NoNewPrivs /proc/self/status; ulimit -n; ulimit -St; ulimit -Ht; ulimit -v"
print(subprocess.run(["bash", "-c", status], check=True, capture_output=True, text=True).stdout)
sys.stdout.flush()
os.setuid(65534) if os.getuid() == 0 else None
confine(("RLIMIT_NOFILE", 78))
"""


def test_a_process_is_confined_with_all_that_it_starts_and_a_limit_too_high_fails() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _CONFINED], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.stdout.split() == ["NoNewPrivs:", "1", "77", "60", "61", str(4096 * 1024)]
    assert done.returncode == 1
    assert done.stderr.startswith("cannot set RLIMIT_NOFILE to 78: ")
    assert done.stderr.endswith("; allowed: 77\n")


CONFINED = """{command: [bash, -c, 'grep NoNewPrivs /proc/self/status; ulimit -n', bash],
    no_new_privileges: true, limits: {nofile: 77}}"""


@pytest.mark.parametrize(
    ("run", "printed", "said"),
    [
        (CONFINED, ["NoNewPrivs:", "1", "77"], ""),
        (
            "{command: ['true'], resources: {memory_max_mib: 64, cpu_quota_percent: 50}}",
            [],
            "systemd-run --user --scope -p MemoryMax=64M -p CPUQuota=50% lifecycle run ...",
        ),
        ("{command: ['true'], resources: {}}", [], ""),
    ],
)
def test_what_runs_without_a_supervisor_is_confined_and_its_resources_are_said_not_to_be(
    tmp_path: Path, run: str, printed: list[str], said: str
) -> None:
    manifest = tmp_path / "one.lifecycle.yaml"
    manifest.write_text(
        f"manifest_version: 1\nsystem: one\nnodes:\n  it: {{managed: false, run: {run}}}\n"
    )
    words = [sys.executable, "-m", "lifecycle", "run", str(manifest), "it"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=60)
    if said:
        said = f"warning: the resources of /it are not limited here, as by lifecycle up: {said}\n"
    assert (done.returncode, done.stdout.split(), done.stderr) == (0, printed, said)


_SYSTEMD_RUN = """\
#!/bin/sh
echo "$@" > {log}
while [ "$1" != -- ]; do shift; done
shift
exec "$@"
"""


async def test_systemd_limits_a_process_in_a_scope_that_has_its_pid_and_descriptors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As systemd-run(1): it makes the scope of itself, and becomes the command."""
    log = tmp_path / "asked"
    program = tmp_path / "systemd-run"
    program.write_text(_SYSTEMD_RUN.format(log=log))
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setattr(WHY_UNLIMITED, lambda: "")
    resources = Resources(at=Position(file="m", line=1, column=1), memory_max_mib=64, tasks_max=9)

    async with _Bench(tmp_path) as bench:
        process = await bench.start("sh", "-c", "echo $$", resources=resources)
        assert await process.ended == ProcessExit(status=0)
        process.signal(signal.SIGKILL)
        await process.release()
        assert bench.lines == [str(process.pid)]
    user = "--user " if os.geteuid() else ""
    assert log.read_text() == (
        f"--scope --quiet --collect {user}--property=MemoryMax=64M --property=TasksMax=9 -- "
        "sh -c echo $$\n"
    )


def test_limits_that_nothing_sets_are_unverifiable(monkeypatch: pytest.MonkeyPatch) -> None:
    at = Position(file="m", line=1, column=1)
    processes = [
        PlannedProcess(name=name, machine="", run=run, nodes=(name,))
        for name, run in (
            ("it", Run(kind=RunKind.COMMAND, resources=Resources(at=at, tasks_max=9))),
            ("bare", Run(kind=RunKind.COMMAND, resources=Resources(at=at))),
            ("others", Run(kind=RunKind.ATTACH)),
        )
    ]
    monkeypatch.setattr(WHY_UNLIMITED, lambda: "systemd does not run here")
    (found,) = unlimited(processes)
    assert (found.rule, found.outcome) == ("declaration.unproven", Outcome.UNVERIFIABLE)
    assert (found.subject, found.at, found.expected) == ("it", "m:1:1", "limited: TasksMax=9")
    assert found.message == "cannot limit the resources of process 'it': systemd does not run here"
    assert scope(processes[0].run.resources) == ()
    monkeypatch.setattr(WHY_UNLIMITED, lambda: "")
    assert unlimited(processes) == ()


FRAMES = """\
Traceback (most recent call last):
  File "/opt/robot/node.py", line 7, in <module>
    rclpy.spin(node)
  File "/usr/lib/python3/dist-packages/rclpy/executors.py", line 839, in spin_once
    raise ValueError(text)"""


@pytest.mark.parametrize(
    ("lines", "last"),
    [
        ("[INFO] all is well", ""),
        (f"{FRAMES}\nValueError: x", "ValueError: x (/opt/robot/node.py:7)"),
        (f"{FRAMES}\nValueError: x\nmore of x", "ValueError: x (/opt/robot/node.py:7)"),
        (
            "\n\n".join(
                (
                    f"{FRAMES}\nKeyError: 1",
                    "During handling of it, another exception occurred:",
                    f"{FRAMES.replace('7', '9')}\nValueError: x",
                )
            ),
            "ValueError: x (/opt/robot/node.py:9)",
        ),
        ("Traceback (most recent call last):\nKeyboardInterrupt", "KeyboardInterrupt"),
    ],
)
def test_the_last_exception_of_a_process_is_found_with_the_users_line(
    lines: str, last: str
) -> None:
    found = Traceback()
    for line in lines.split("\n"):
        found.add(line)
    assert found.last == last


@pytest.mark.parametrize(
    ("end", "is_clean", "is_crash"),
    [
        (ProcessExit(status=0), True, False),
        (ProcessExit(status=1), False, False),
        (ProcessExit(status=139), False, True),
        (ProcessExit(status=130), False, False),
        (ProcessExit(signal=signal.SIGTERM), True, False),
        (ProcessExit(signal=signal.SIGKILL), False, False),
        (ProcessExit(signal=signal.SIGABRT), False, True),
        (ProcessExit(), False, False),
    ],
)
def test_an_end_is_clean_or_a_crash_as_systemd_has_it(
    end: ProcessExit, is_clean: bool, is_crash: bool
) -> None:
    assert (end.is_clean, end.is_crash) == (is_clean, is_crash)
