"""Runs the real command line on a system of two nodes, and looks at what it says and leaves.

Owns: `Up`, a running `lifecycle up`, `pair`, the manifest of these tests, and `left_of`, the
processes that still carry a test's mark. Made for further suites to use.
"""

from __future__ import annotations

import contextlib
import copy
import json
import os
import queue
import re
import select
import signal
import subprocess
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import psutil
import yaml

from lifecycle.middleware.process.shared_memory import leftovers, sweep
from tests.installation import LIFECYCLE, modules
from tests.shared_memory import owned_by

ROOT = Path(__file__).parents[3]
BOUND_S = 40.0
ENOUGH = ("--timeout", str(BOUND_S / 2))
"""For verbs that look until they see what they want: a busy machine takes longer to show it."""

_MARK = "LIFECYCLE_TEST_MARK"
_NODES = "tests.ros.supervisor.systems"

# Ports of unique subscriptions and of ros_discovery_info are counted from 7000 in every domain:
# other systems on this machine may use the same file a moment later.
_SHARED = re.compile(r"port7[0-3]\d\d")

Event = dict[str, Any]


LIMITS = {"start_s": 8, "configure_s": 8, "connect_s": 8, "activate_s": 8, "silent_s": 8}
"""`timeouts` of a node that is neither late nor silent if the machine stands still for a moment."""


def write(
    directory: Path, domain_id: int, nodes: Mapping[str, Any], system: str = "system", **keys: Any
) -> Path:
    """Write the manifest of a system; return its path."""
    document = {
        "manifest_version": 1,
        "system": system,
        "discovery": {"domain_id": domain_id, "range": "localhost"},
        "nodes": nodes,
        **keys,
    }
    file = directory / f"{system}.lifecycle.yaml"
    file.write_text(yaml.safe_dump(document))
    return file


def pair(
    directory: Path, domain_id: int, *, misbehave: str = "", edit: Mapping[str, Any] | None = None
) -> Path:
    """Write the manifest of a talker, which may misbehave, and a listener; return its path."""
    document: dict[str, Any] = {
        "manifest_version": 1,
        "system": "pair",
        "discovery": {"domain_id": domain_id, "range": "localhost"},
        "nodes": {
            "talker": {
                "run": {"python": f"{_NODES}:Talker", "environment": {"MISBEHAVE": misbehave}},
                "timeouts": LIMITS,
                "interface": {"publishers": [{"name": "chatter", "type": "std_msgs/msg/String"}]},
            },
            "listener": {
                "run": {"python": f"{_NODES}:Listener"},
                "timeouts": LIMITS,
                "after": {"talker": "configured"},
                "interface": {
                    "subscriptions": [{"name": "chatter", "type": "std_msgs/msg/String"}]
                },
            },
        },
        "links": [{"topic": "/chatter", "from": "talker", "to": "listener"}],
    }
    for path, value in (edit or {}).items():
        *parents, last = path.split("/")
        place = document
        for key in parents:
            place = place.setdefault(key, {})
        place[last] = copy.deepcopy(value)  # another edit may be inside of it
    file = directory / "pair.lifecycle.yaml"
    file.write_text(yaml.safe_dump(document))
    return file


class Up:
    """A `lifecycle up --format json` in a process of its own.

    Args:
        through: the beginning of its command line, what runs it elsewhere.
        variables: set in its environment.

    Attributes:
        manifest: what it brings up.
        runtime: directory of its runs and logs.
        events: everything it printed so far.
        segments: shared memory that its processes were seen to use.
    """

    def __init__(
        self,
        manifest: Path,
        *options: str,
        runtime: Path,
        through: Sequence[str] = (),
        variables: Mapping[str, str] | None = None,
    ) -> None:
        self.mark = uuid.uuid4().hex
        self.manifest = manifest
        self.runtime = runtime
        self.events: list[Event] = []
        self.segments: set[str] = set()
        self._lines: queue.Queue[str] = queue.Queue()
        self._heard: list[str] = []
        # What hangs is aborted, see `finish`, and says where it stood.
        said = (str(manifest), "--format", "json", *options)
        self.process = subprocess.Popen(
            [*through, *command("up"), *said],
            cwd=modules(),
            env={
                **environment(runtime, self.mark),
                "PYTHONFAULTHANDLER": "1",
                **(variables or {}),
            },
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self._readers = [
            threading.Thread(target=each, daemon=True) for each in (self._read, self._hear)
        ]
        for each in self._readers:
            each.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(line)
        self._lines.put("")

    def _hear(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self._heard.append(line)

    def until(self, kind: str, **fields: object) -> Event:
        """Read on until an event of this kind and with these fields came, and return it."""
        deadline = time.monotonic() + BOUND_S
        while True:
            try:
                line = self._lines.get(timeout=max(0.01, deadline - time.monotonic()))
            except queue.Empty:
                late = f"no {kind} {fields} within {BOUND_S:g} s; the last: {self.events[-5:]}"
                raise AssertionError(late) from None
            assert line, f"ended without {kind} {fields}: {self.events[-5:]} {self.said()}"
            event = json.loads(line)
            self.events.append(event)
            if _is(event, kind, fields):
                return dict(event)

    def catch_up(self) -> int:
        """Read what has come until now, without waiting; return how many events there are."""
        with contextlib.suppress(queue.Empty):
            while line := self._lines.get_nowait():
                self.events.append(json.loads(line))
        return len(self.events)

    def met(self, kind: str, *, since: int = 0, **fields: object) -> Event:
        """Return an event like `until`, which may have come already, after the first `since`.

        For what comes in no order that was promised: what a node says, and how far we think it is.
        """
        for event in self.events[since:]:
            if _is(event, kind, fields):
                return dict(event)
        return self.until(kind, **fields)

    def until_verdict(self, holds: Callable[[Event], bool], *, since: int = 0) -> Event:
        """Return the first verdict that is as wanted, after the first `since` events.

        How many verdicts a system passes through on its way there nobody promises.
        """
        deadline = time.monotonic() + BOUND_S
        while True:
            for event in self.events[since:]:
                if event.get("event") == "verdict" and holds(event["verdict"]):
                    return dict(event["verdict"])
            since = len(self.events)
            assert time.monotonic() < deadline, f"not within {BOUND_S:g} s: {self.events[-5:]}"
            self.until("verdict")

    def until_found(self, rule: str, subject: str = "", *, since: int = 0) -> Event:
        """Return the first verdict with a finding of a rule, on a subject if one is given."""
        return self.until_verdict(lambda verdict: _found(verdict, rule, subject), since=since)

    def until_not_found(self, rule: str, *, since: int) -> Event:
        """Return the first verdict after the first `since` events without such a finding."""
        return self.until_verdict(lambda verdict: not _found(verdict, rule), since=since)

    def pid_of(self, process: str) -> int:
        """Return the pid of a process that was reported to run."""
        return next(
            int(each["pid"])
            for each in reversed(self.of_kind("process"))
            if each["process"] == process and each["pid"]
        )

    def note_segments(self) -> None:
        """Remember the shared memory of all processes that run now."""
        seen = owned_by(each.pid for each in marked(self.mark))
        self.segments |= {name for name in seen if not _SHARED.search(name)}

    def of_kind(self, kind: str) -> list[Event]:
        """Return the events of one kind that came so far."""
        return [event for event in self.events if event.get("event") == kind]

    def signal(self, number: int) -> None:
        """Send a signal to the supervisor alone."""
        self.process.send_signal(number)

    def finish(self) -> int:
        """Wait for the end; return the exit code with every line read."""
        try:
            code = self.process.wait(BOUND_S)
        except subprocess.TimeoutExpired:
            self.catch_up()
            self.process.send_signal(signal.SIGABRT)
            late = f"not ended within {BOUND_S:g} s; the last: {self.events[-5:]}"
            raise AssertionError(f"{late} {self.said()}") from None
        for each in self._readers:
            each.join(BOUND_S)
        while line := self._lines.get(timeout=1):
            self.events.append(json.loads(line))
        return code

    @property
    def verdict(self) -> Event:
        """The last line, which is the verdict."""
        return self.events[-1]

    def assert_nothing_left(self) -> None:
        """Assert that no process of the run lives and no shared memory of it is there."""
        assert left_of(self.mark) == []
        left = set(self.segments).intersection(leftovers())
        assert left == set(), left

    def assert_gate_held(self) -> None:
        """Assert that no activate request was sent before the gate opened on a passing verdict."""
        kinds = [
            "activate" if each.get("operation") == "activate" else each.get("event")
            for each in self.events
        ]
        if "activate" in kinds:
            assert "gate" in kinds[: kinds.index("activate")]
            judged = [
                each["verdict"]
                for each in self.events[: kinds.index("gate")]
                if each.get("event") == "verdict"
            ]
            assert not judged[-1]["blocking"]

    def close(self) -> None:
        """End whatever still runs, with what it would leave in /dev/shm.

        Who is killed still holds its ports until its last thread has ended, and the next test may
        get this domain.
        """
        used: set[str] = set()
        deadline = time.monotonic() + BOUND_S
        while alive := marked(self.mark):
            assert time.monotonic() < deadline, f"cannot be killed: {alive}"
            used |= owned_by(each.pid for each in alive)
            for each in alive:
                with contextlib.suppress(psutil.NoSuchProcess, ProcessLookupError):
                    _kill(each, deadline)
        if used:
            sweep(within_s=0.5)
        self.process.wait(BOUND_S)
        for reader in self._readers:
            reader.join(BOUND_S)
        for stream in (self.process.stdout, self.process.stderr):
            assert stream is not None
            stream.close()

    def said(self) -> str:
        """Wait for the end; return what it wrote to standard error."""
        self.process.wait(BOUND_S)
        self._readers[1].join(BOUND_S)
        return "".join(self._heard)


def _kill(process: psutil.Process, deadline: float) -> None:
    """Kill a process and wait until all its threads have ended: its main one may do so first."""
    descriptor = os.pidfd_open(process.pid)
    try:
        process.kill()
        select.select([descriptor], [], [], max(0.0, deadline - time.monotonic()))
    finally:
        os.close(descriptor)


def _is(event: Event, kind: str, fields: Mapping[str, object]) -> bool:
    wanted = {"event": kind, **fields}
    return all(event.get(name) == value for name, value in wanted.items())


def _found(verdict: Event, rule: str, subject: str = "") -> bool:
    return any(
        each["rule"] == rule and subject in ("", each["subject"]) for each in verdict["findings"]
    )


@contextlib.contextmanager
def up(
    manifest: Path,
    *options: str,
    runtime: Path,
    through: Sequence[str] = (),
    variables: Mapping[str, str] | None = None,
) -> Iterator[Up]:
    """Start `lifecycle up`, and end it whatever happens."""
    running = Up(manifest, *options, runtime=runtime, through=through, variables=variables)
    try:
        yield running
    finally:
        running.close()


def command(verb: str) -> Sequence[str]:
    """Return the command line of a verb."""
    return (str(LIFECYCLE), verb)


def verb(
    name: str,
    *arguments: str,
    runtime: Path,
    variables: Mapping[str, str] | None = None,
    mark: str = "",
    within_s: float = BOUND_S,
) -> subprocess.CompletedProcess[str]:
    """Run a verb to its end, with more variables in its environment."""
    return subprocess.run(
        [*command(name), *arguments],
        cwd=modules(),
        env={**environment(runtime, mark), **(variables or {})},
        capture_output=True,
        text=True,
        timeout=within_s,
        check=False,
    )


def environment(runtime: Path, mark: str) -> dict[str, str]:
    """Return the environment of a run: its own runtime and log directories, and its mark."""
    return {
        **os.environ,
        _MARK: mark,
        "XDG_RUNTIME_DIR": str(runtime),
        "ROS_LOG_DIR": str(runtime / "log"),
    }


def marked(mark: str) -> list[psutil.Process]:
    """Return the living processes that carry a mark in their environment."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            if process.environ().get(_MARK) == mark and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
    return found


def left_of(mark: str, within_s: float = 1.0) -> list[str]:
    """Return what still lives of a run; polls until nothing does or the time is up."""
    deadline = time.monotonic() + within_s
    while (alive := marked(mark)) and time.monotonic() < deadline:
        time.sleep(0.02)
    return [str(each) for each in alive]
