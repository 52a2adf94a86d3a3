"""Runs one case: its files in a directory of its own, its strangers, the command, and its marks.

Owns: `Run`.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tests.installation import LIFECYCLE, PYTHON
from tests.outside.case import Case

PROGRAMS = Path(__file__).with_name("programs")
WAIT_S = 30.0
"""For an event on a busy machine; it ends with the event."""

GRACE_S = 15.0
"""For a command that is asked to end."""


class Run:
    """A command that runs in a directory and a domain of its own, and all that is beside it.

    Attributes:
        directory: the case's files; the command's working directory.
        domain_id: the ROS domain of all that this run starts.
        environment: of the command and of all programs beside it.
        process: the command itself.
    """

    def __init__(self, case: Case, directory: Path, domain_id: int) -> None:
        self.case = case
        self.directory = directory
        self.domain_id = domain_id
        self.manifest = directory / "system.lifecycle.yaml"
        self.environment = {
            **{k: v for k, v in os.environ.items() if not k.startswith(("FASTRTPS_", "PYTEST_"))},
            "ROS_DOMAIN_ID": str(domain_id),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(directory / "log"),
            "XDG_RUNTIME_DIR": str(directory),
            "PYTHONPATH": os.pathsep.join((str(directory), str(PROGRAMS))),
            "PATH": os.pathsep.join((str(PYTHON.parent), os.environ.get("PATH", ""))),
            "OUTSIDE": str(directory),
        }
        self.report = directory / "report.json"
        self.process: subprocess.Popen[str] | None = None
        self.began_s = 0.0
        self.took_s = 0.0
        self._lines: list[str] = []
        self._changed = threading.Condition()
        self._beside: list[subprocess.Popen[str]] = []
        self._readers: list[threading.Thread] = []
        self._reads = threading.Event()
        self._reads.set()
        self.manifest.write_text(case.manifest)
        for name, text in case.files.items():
            path = directory / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)

    # ---- what is started ---------------------------------------------------------------------

    def start(self) -> None:
        """Start the case's strangers, and then its command."""
        for words in self.case.strangers:
            self.stranger(*words)
        verb, *options = self.case.verb
        wants_report = verb in ("up", "verify") and "--report" not in options
        events = verb == "up" and "--format" not in options
        self.began_s = time.monotonic()
        self.process = subprocess.Popen(
            [
                *(str(LIFECYCLE), verb, str(self.manifest), *options),
                *(("--report", str(self.report)) if wants_report else ()),
                *(("--format", "json") if events else ()),
            ],
            cwd=self.directory,
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
        )
        self._read(self.process)

    def stranger(self, *words: str, wait: bool = True, **environment: str) -> subprocess.Popen[str]:
        """Start `programs/stranger.py`, and wait until its entities exist, or not; see there."""
        return self.program(str(PROGRAMS / "stranger.py"), *words, wait=wait, **environment)

    def program(self, *words: str, wait: bool = True, **environment: str) -> subprocess.Popen[str]:
        """Start a Python program beside the command; it says `ready` once it is."""
        with (self.directory / f"beside{len(self._beside)}.err").open("w") as errors:
            process = subprocess.Popen(
                [str(PYTHON), *words],
                cwd=self.directory,
                env={**self.environment, **environment},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )
        self._beside.append(process)
        if wait:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line == "ready\n", f"{words} did not start: {line!r}"
        return process

    def python(self, *words: str, timeout_s: float = 60.0) -> str:
        """Run a Python program beside the command to its end; return what it printed.

        `run.python("client.py", "state", "/talker")`: the first word is a file of `programs/`.
        """
        done = subprocess.run(
            [str(PYTHON), str(PROGRAMS / words[0]), *words[1:]],
            cwd=self.directory,
            env=self.environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
        )
        assert done.returncode == 0, f"{words}: {done.stderr}\n{self.output}"
        return done.stdout

    def lifecycle(self, *words: str, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
        """Run another command of lifecycle to its end: `run.lifecycle("verify", "{}", "--strict")`.

        `{}` stands for the manifest.
        """
        return subprocess.run(
            [str(LIFECYCLE), *(str(self.manifest) if each == "{}" else each for each in words)],
            cwd=self.directory,
            env=self.environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
        )

    # ---- what is seen of it ------------------------------------------------------------------

    @property
    def output(self) -> str:
        """All that the command printed so far; standard error with it."""
        with self._changed:
            return "\n".join(self._lines)

    @property
    def events(self) -> list[dict[str, Any]]:
        """The JSON events that `up` printed so far (docs/events.md)."""
        found = []
        for line in self.output.splitlines():
            if line.startswith('{"event"'):
                with contextlib.suppress(json.JSONDecodeError):
                    found.append(json.loads(line))
        return found

    def of_kind(self, kind: str, **fields: object) -> list[dict[str, Any]]:
        """Return events of a kind with these values: `run.of_kind("node", node="/talker")`."""
        return [
            each
            for each in self.events
            if each.get("event") == kind and all(each.get(k) == v for k, v in fields.items())
        ]

    def until(self, kind: str, *, timeout_s: float = WAIT_S, **fields: object) -> dict[str, Any]:
        """Wait for an event of `up` and return it; fails with the output if none comes."""
        found: list[dict[str, Any]] = []

        def comes() -> bool:
            found[:] = self.of_kind(kind, **fields)
            return bool(found)

        self.wait(comes, f"event {kind} {fields}", timeout_s=timeout_s)
        return found[0]

    def until_active(self) -> None:
        """Wait until the whole system is active."""
        self.until("system", reached="active")

    def until_says(self, pattern: str, *, timeout_s: float = WAIT_S) -> None:
        """Wait for a text in the output: a regular expression."""
        self.wait(lambda: re.search(pattern, self.output) is not None, pattern, timeout_s=timeout_s)

    def wait(self, holds: Callable[[], bool], what: str, *, timeout_s: float = WAIT_S) -> None:
        """Wait until something holds, looked at 50 times a second."""
        deadline = time.monotonic() + timeout_s
        while not holds():
            assert time.monotonic() < deadline, f"not within {timeout_s} s: {what}\n{self.output}"
            with self._changed:
                self._changed.wait(0.02)

    def pid_of(self, process: str) -> int:
        """Return the process id of a process of the system, the latest that runs."""
        self.until("process", process=process, state="running")
        return int(self.of_kind("process", process=process, state="running")[-1]["pid"])

    def stop_reading(self) -> None:
        """Leave what the command prints unread, until `read_on`: its pipe fills up."""
        self._reads.clear()

    def read_on(self) -> None:
        """Read what the command prints."""
        self._reads.set()

    def signal(self, number: signal.Signals) -> None:
        """Send the command a signal."""
        assert self.process is not None
        self.process.send_signal(number)

    def marks(self, node: str = "", what: str = "") -> list[tuple[float, str, str]]:
        """Return what nodes noted: wall-clock seconds, node, what (see `programs/nodes.py`)."""
        path = self.directory / "marks"
        lines = path.read_text().splitlines() if path.exists() else []
        marks = [(float(t), n, w) for t, n, w in (line.split(" ", 2) for line in lines)]
        return [m for m in marks if node in ("", m[1]) and m[2].startswith(what)]

    @property
    def activated(self) -> frozenset[str]:
        """Names of the nodes whose `on_activate` ran."""
        return frozenset(node for _, node, what in self.marks() if what == "activated")

    @property
    def received(self) -> frozenset[str]:
        """All that nodes of the system received, without who and when."""
        return frozenset(
            what.removeprefix("received ") for _, _, what in self.marks(what="received ")
        )

    @property
    def result(self) -> dict[str, Any]:
        """The report; empty while there is none."""
        return dict(json.loads(self.report.read_text())) if self.report.exists() else {}

    def processes(self) -> list[str]:
        """Return the processes of this run that still live, strangers left out."""
        beside = {each.pid for each in self._beside}
        mine = f"OUTSIDE={self.directory}".encode()
        found = []
        for entry in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                if int(entry.name) in beside or entry.name == str(os.getpid()):
                    continue
                if mine not in (entry / "environ").read_bytes().split(b"\0"):
                    continue
                words = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode().strip()
                if words:  # a zombie has none
                    found.append(f"{entry.name} {words}")
        return found

    # ---- the end -----------------------------------------------------------------------------

    def finish(self) -> int:
        """Wait for the command's end and return its exit code; end it where it takes too long."""
        assert self.process is not None
        left = self.case.within_s - (time.monotonic() - self.began_s)
        try:
            code = self.process.wait(max(left, 0.1))
        except subprocess.TimeoutExpired:
            self.process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(GRACE_S)
            raise AssertionError(
                f"still running after {self.case.within_s} s\n{self.output}"
            ) from None
        finally:
            self.took_s = time.monotonic() - self.began_s
        for reader in self._readers:
            reader.join(5.0)
        return code

    def close(self) -> None:
        """End all that still runs."""
        self.read_on()
        for process in [*self._beside, *([self.process] if self.process else [])]:
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.terminate()
        for process in [*self._beside, *([self.process] if self.process else [])]:
            try:
                process.wait(GRACE_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            for stream in (process.stdin, process.stdout):
                if stream is not None:
                    with contextlib.suppress(OSError):
                        stream.close()

    def _read(self, process: subprocess.Popen[str]) -> None:
        def read() -> None:
            assert process.stdout is not None
            with contextlib.suppress(ValueError):
                for line in process.stdout:
                    self._reads.wait()
                    with self._changed:
                        self._lines.append(line.rstrip("\n"))
                        self._changed.notify_all()

        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        self._readers.append(reader)


@contextlib.contextmanager
def running(case: Case, directory: Path, domain_id: int) -> Iterator[Run]:
    """Start a case, tell its story, and leave nothing behind."""
    run = Run(case, directory, domain_id)
    try:
        run.start()
        if case.story is not None:
            case.story(run)
        yield run
    finally:
        run.close()
