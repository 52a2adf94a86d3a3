"""The agent of a host and the local transport, with real processes and a supervisor that pretends.

What nobody may do to a robot: end its supervisor because a connection, a coordinator or an agent
ended.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from lifecycle.codec import from_json, to_json
from lifecycle.fleet.protocol import AGENT_MARK, PROTOCOL, Do, Order, Part, Said, SentFile, Word
from lifecycle.run_directory import SENT_PREFIX, RunDirectory, is_held, start_ticks
from tests.unit.fleet.pretend import COMMAND

BOUND_S = 15.0
ROOT = Path(__file__).parents[3]


class Agent:
    """An agent in a process of its own, and a test at the other end."""

    def __init__(self, runtime: Path, **variables: str) -> None:
        self.process = subprocess.Popen(
            [*COMMAND, "host-agent"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={
                **os.environ,
                "XDG_RUNTIME_DIR": str(runtime),
                "PYTHONPATH": str(ROOT),
                **variables,
            },
        )
        self.records: list[dict[str, object]] = []
        assert self.until(Word.HELLO).protocol == PROTOCOL

    def order(self, order: Order) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(to_json(order) + b"\n")
        self.process.stdin.flush()

    def line(self) -> Said | None:
        """Return what the agent says; None for a line of the supervisor, which is noted."""
        assert self.process.stdout is not None
        data = self.process.stdout.readline()
        assert data, f"the agent ended: {self.process.wait(BOUND_S)}"
        if data.startswith(AGENT_MARK):
            return from_json(data, Said)
        if data.strip():
            self.records.append(json.loads(data))
        return None

    def until(self, word: Word) -> Said:
        while (said := self.line()) is None or said.agent is not word:
            pass
        return said

    def until_record(self, **fields: object) -> None:
        while not any(fields.items() <= each.items() for each in self.records):
            self.line()

    def begin(self, part: Part, do: Do = Do.START) -> Said:
        self.order(Order(do=do, part=part))
        words = (Word.STARTED, Word.ATTACHED, Word.ABSENT, Word.REFUSED)
        while (said := self.line()) is None or said.agent not in words:
            pass
        return said

    def close(self) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.close()
        try:
            self.process.wait(BOUND_S)
        finally:
            self.process.kill()
            self.process.wait(BOUND_S)
            self.process.stdout.close()


class Site:
    """A host: its run directories, and what its supervisor is asked to do by files."""

    def __init__(self, path: Path, stack: contextlib.ExitStack) -> None:
        self.runtime = path / "run"
        self.runtime.mkdir(mode=0o700)
        self.control = path / "control"
        self.control.mkdir()
        self.directory = self.runtime / "lifecycle" / "patrol@7.a"
        self._stack = stack

    def agent(self, **variables: str) -> Agent:
        agent = Agent(self.runtime, **variables)
        self._stack.callback(agent.close)
        return agent

    def part(self, digest: str = "1") -> Part:
        return Part(
            name="patrol@7.a",
            machine="a",
            manifest="m.lifecycle.yaml",
            files=(
                SentFile(path="m.lifecycle.yaml", data=str(self.control).encode()),
                SentFile(path="params/a.yaml", data=b"x: 1\n"),
            ),
            arguments=("rate:=-5; rm -rf $HOME",),
            options=("--strict",),
            digest=digest,
            whole="patrol@7",
        )

    def started(self, agent: Agent) -> int:
        said = agent.begin(self.part())
        assert said.agent is Word.STARTED, said
        self._stack.callback(_kill, said.pid, start_ticks(said.pid))
        return said.pid


def _kill(pid: int, ticks: int | None) -> None:
    if ticks is not None and start_ticks(pid) == ticks:
        os.kill(pid, signal.SIGKILL)


def _until_dead(pid: int) -> None:
    deadline = time.monotonic() + BOUND_S
    while start_ticks(pid) is not None:
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with contextlib.ExitStack() as stack:
        yield Site(tmp_path, stack)


def test_a_supervisor_gets_its_files_and_words_as_they_are_and_leaves_nothing(site: Site) -> None:
    agent = site.agent()
    pid = site.started(agent)
    assert agent.until(Word.STDERR).message == "warning of a"
    agent.until_record(event="run")
    words = agent.records[0]["words"]
    assert isinstance(words, list)
    manifest = Path(words[words.index("--") + 1])
    assert words == [
        *("--machine", "a", "--format", "json", "--strict", "--"),
        *(str(manifest), "rate:=-5; rm -rf $HOME"),
    ]
    assert (manifest.parent / "params" / "a.yaml").read_bytes() == b"x: 1\n"
    (site.control / "go").touch()
    agent.until_record(event="system", reached="active")
    agent.order(Order(do=Do.END))
    ended = agent.until(Word.ENDED)
    assert (ended.exit_code, ended.signal) == (0, 0)
    assert agent.records[-1] == {"verdict": "ok", "run": {"exit_code": 0}}
    assert start_ticks(pid) is None
    assert list((site.runtime / "lifecycle").iterdir()) == []


@pytest.mark.parametrize(
    ("stage", "how"),
    [
        ("started", "closed"),
        ("started", "killed"),
        ("started", "silent"),
        ("active", "closed"),
        ("active", "killed"),
    ],
)
def test_a_supervisor_runs_on_without_its_agent_and_is_followed_again(
    site: Site, how: str, stage: str
) -> None:
    first = site.agent(SILENT_S="1" if how == "silent" else "20")
    pid = site.started(first)
    if stage == "active":
        (site.control / "go").touch()
        first.until_record(event="system", reached="active")
    if how == "killed":
        first.process.kill()
    elif how == "closed":
        first.close()
    first.process.wait(BOUND_S)
    second = site.agent()
    said = second.begin(site.part(), Do.START if stage == "started" else Do.ATTACH)
    assert (said.agent, said.pid) == (Word.ATTACHED, pid)
    (site.control / "go").touch()
    if stage == "started":
        second.until_record(event="system", reached="active")
    second.order(Order(do=Do.END))
    assert second.until(Word.ENDED).agent is Word.ENDED
    assert second.records[-1]["run"] == {"exit_code": 0}
    assert list((site.runtime / "lifecycle").iterdir()) == []


def test_the_newer_of_two_agents_follows_and_the_older_one_says_so(site: Site) -> None:
    first = site.agent()
    pid = site.started(first)
    second = site.agent()
    assert second.begin(site.part()).pid == pid
    assert first.until(Word.TAKEN)
    first.process.wait(BOUND_S)
    (site.control / "go").touch()
    second.until_record(event="system", reached="active")


def test_an_agent_that_is_stopped_is_no_obstacle(site: Site) -> None:
    first = site.agent()
    site.started(first)
    first.process.send_signal(signal.SIGSTOP)
    second = site.agent()
    assert second.begin(site.part()).agent is Word.ATTACHED
    assert first.process.wait(BOUND_S) == -signal.SIGKILL


def test_another_manifest_is_not_taken_for_the_one_that_runs(site: Site) -> None:
    first = site.agent()
    site.started(first)
    said = site.agent().begin(site.part(digest="2"))
    assert said.agent is Word.REFUSED
    assert "it runs already, with another manifest or other arguments" in said.message
    assert said.hint == "end it first: lifecycle down patrol@7.a"


@pytest.mark.parametrize("name", ["patrol@7.a", "patrol@7"])  # with --machine a, and without
def test_a_supervisor_that_a_person_started_is_left_alone(site: Site, name: str) -> None:
    held = RunDirectory.acquire(site.directory.parent, name, "1")
    try:
        said = site.agent().begin(site.part())
        asked = site.agent()
        for each in (Do.STATUS, Do.DOWN):
            asked.order(Order(do=each, name="patrol@7.a", whole="patrol@7"))
        # It holds the run and answers nothing, as one that is just starting: it is there.
        assert f"cannot ask {name!r}" in asked.until(Word.REFUSED).message
        assert f"['down', '{name}'" in asked.until(Word.DONE).message
    finally:
        held.release()
    assert said.agent is Word.REFUSED
    assert f"cannot follow {name!r}" in said.message
    assert "was not started by lifecycle up --hosts" in said.message


def test_a_supervisor_that_is_killed_is_reported_and_what_was_sent_swept_by_the_next(
    site: Site,
) -> None:
    agent = site.agent()
    pid = site.started(agent)
    agent.until_record(event="run")
    os.kill(pid, signal.SIGKILL)
    assert agent.until(Word.ENDED).signal == signal.SIGKILL
    again = site.agent()
    assert again.begin(site.part(), Do.ATTACH).agent is Word.ABSENT
    next_pid = site.started(again)
    assert next_pid != pid
    again.until_record(event="run")
    sent = [each for each in site.directory.iterdir() if each.name.startswith(SENT_PREFIX)]
    assert len(sent) == 1


def test_what_nobody_reads_holds_up_no_supervisor(site: Site) -> None:
    agent = site.agent()
    pid = site.started(agent)
    agent.until_record(event="run")
    agent.close()
    os.kill(pid, signal.SIGTERM)
    _until_dead(pid)
    assert not is_held(site.directory)


@pytest.mark.parametrize("path", ["../a.yaml", "/etc/a.yaml", "", "a/../../b"])
def test_no_file_is_written_outside_of_its_directory(site: Site, path: str) -> None:
    part = Part(
        name="patrol@7.a",
        machine="a",
        manifest="m.yaml",
        files=(SentFile(path=path, data=b"x"),),
    )
    said = site.agent().begin(part)
    assert said.agent is Word.REFUSED
    assert "it would lie outside of its directory" in said.message


@pytest.mark.parametrize("name", ["../other", ".sent", "a/b", ""])
def test_a_run_has_a_name_that_is_no_path(site: Site, name: str) -> None:
    part = Part(name=name, machine="a", manifest="m.yaml", files=())
    assert "as the name of a run" in site.agent().begin(part).message


@pytest.mark.parametrize("do", [Do.DOWN, Do.STATUS])
def test_what_does_not_run_is_already_down(site: Site, do: Do) -> None:
    agent = site.agent()
    agent.order(Order(do=do, name="patrol@7.a", whole="patrol@7"))
    assert agent.until(Word.ABSENT)
