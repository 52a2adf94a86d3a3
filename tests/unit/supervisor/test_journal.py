"""The journal of a run: all that it tells can be had back, whatever happens to its files.

That a journal tells the story of a run, and that its verdicts can be had again, is checked at the
end of every session in the world of fakes (session_world.py).
"""

from __future__ import annotations

import asyncio
import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.cli.verbs import history
from lifecycle.errors import UsageError
from lifecycle.supervisor.run import journal as module
from lifecycle.supervisor.run.events import Notice, RunStarted, Stopped
from lifecycle.supervisor.run.history import (
    explained,
    journal_files,
    moment_of,
    named_findings,
    read_run,
    replayed,
)
from lifecycle.supervisor.run.journal import Journal, changed, restored
from lifecycle.verify import Observation, ObservedNode, Stage, verify
from tests.unit.supervisor.fakes import run
from tests.unit.supervisor.session_world import CHAIN, SessionWorld

NOON = 1_700_000_000.0


class Clock:
    """Goes forward by a second each time that it is asked."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 1.0
        return self.now


class Kept:
    """A journal in a directory, and what it says to people."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.said: list[str] = []
        self.set_s = 0.0
        clock = Clock()
        self.journal = Journal(
            "robot",
            "42",
            say=self.said.append,
            wall=lambda: NOON + clock.now + self.set_s,
            clock=clock,
        )
        self.output: dict[str, int] = {}

    def look(self, *nodes: str, observation: Observation | None = None) -> None:
        seen = observation or Observation(
            nodes=tuple(ObservedNode(full_name=each, state="inactive") for each in nodes)
        )
        verdict = verify(CHAIN, seen, stage=Stage.CONNECTED)
        self.journal.looked(
            CHAIN,
            seen,
            verdict,
            stage=Stage.CONNECTED,
            machines=None,
            ahead=frozenset(),
            over={},
        )

    def lines(self) -> list[dict[str, Any]]:
        (file,) = journal_files(self.directory)
        return [json.loads(line) for line in file.read_text().splitlines()]

    def seen(self, *files: Path) -> list[list[str]]:
        recorded = read_run(files or journal_files(self.directory))
        assert recorded.unreadable == ()
        return [
            [node.full_name for node in each.seen.nodes]
            for each in recorded.moments
            if each.line.look is not None and each.seen is not None
        ]


@pytest.fixture
def kept(tmp_path: Path) -> Iterator[Kept]:
    made = Kept(tmp_path)
    with made.journal.writing(tmp_path, positions=lambda: made.output):
        yield made


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 2))), st.data())
def test_what_changed_gives_back_what_is(
    before: list[tuple[int, int]], data: st.DataObject
) -> None:
    now = data.draw(
        st.permutations(before) | st.lists(st.sampled_from(before or [(0, 0)]) | st.just((9, 9)))
    )
    told = changed(tuple(before), tuple(now), lambda value: value[0])
    if told is None:
        assert before == now
    else:
        assert restored(tuple(before), *told) == tuple(now)


def test_a_look_is_told_by_what_changed_and_one_like_the_last_not_at_all(kept: Kept) -> None:
    kept.look("/camera")
    kept.look("/camera")
    kept.look("/camera", "/viewer")
    kept.look("/viewer")
    assert kept.seen() == [["/camera"], ["/camera", "/viewer"], ["/viewer"]]
    lines = kept.lines()
    changes = [each["look"]["nodes"] for each in lines if "look" in each]
    assert [(each["gone"], len(each["new"])) for each in changes] == [([], 1), ([], 1), ([0], 0)]


def test_every_line_is_as_the_schema_says(kept: Kept) -> None:
    schema = json.loads(Path("schemas/journal.v1.schema.json").read_text())
    kept.output["camera"] = 7
    kept.look("/camera")
    kept.journal.on_event(Stopped(exit_code=0, elapsed_s=1.0))
    lines = kept.lines()
    assert [{*each} - {"at", "elapsed_s"} for each in lines] == [
        {"run"},
        {"plan"},
        {"look"},
        {"event", "output"},
    ]
    for each in lines:
        jsonschema.validate(each, schema)


def test_a_full_file_makes_room_and_each_can_be_read_alone(
    kept: Kept, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "LARGEST_JOURNAL", 5_000)
    names = [f"/node_{number}" for number in range(40)]
    for number in range(40):
        kept.look(*names[: number + 1])
    older, newest = journal_files(kept.directory)
    assert older.stat().st_size < 5_000 + 40 * 400
    for each in (older, newest):
        seen = kept.seen(each)
        assert [len(one) for one in seen] == list(range(len(seen[0]), len(seen[-1]) + 1))
    assert kept.seen(older, newest)[-1] == names


def test_what_cannot_be_written_is_said_once_and_what_follows_is_told_from_nothing(
    kept: Kept, tmp_path: Path
) -> None:
    full = tmp_path / "journal.jsonl"
    kept.look("/camera")
    assert kept.journal._file is not None
    kept.journal._shut()
    full.rename(tmp_path / "journal.jsonl.1")
    full.symlink_to("/dev/full")
    kept.look("/camera", "/viewer")
    kept.journal.on_event(Notice(message="lost"))
    full.unlink()
    kept.journal._shut()
    kept.look("/viewer")
    kept.look("/viewer", "/camera")
    assert len(kept.said) == 1
    assert "No space left on device; the run goes on" in kept.said[0]
    assert kept.seen() == [["/camera"], ["/viewer"], ["/viewer", "/camera"]]


def test_a_torn_line_and_a_foreign_one_are_passed_over_and_named(kept: Kept) -> None:
    kept.look("/camera")
    (file,) = journal_files(kept.directory)
    with file.open("ab") as journal:
        journal.write(b'{"look": 7}\n\x00\xff\n' + file.read_bytes().splitlines()[-1][:50])
    recorded = read_run(journal_files(kept.directory))
    assert [place for place, _ in recorded.unreadable] == [
        f"journal.jsonl:{number}" for number in (4, 5, 6)
    ]
    assert recorded.unreadable[-1][1] == "it is incomplete"
    assert len(recorded.moments) == 3


def test_an_explanation_names_what_was_seen_to_change_and_what_happened_before(
    tmp_path: Path,
) -> None:
    async def main() -> None:
        world = SessionWorld(CHAIN, tmp_path, stop_after_s=30.0)

        async def intruded() -> None:
            await world.story.until("[system] active")
            await asyncio.sleep(5)
            world.intrude()
            await world.story.until("[verdict] active violated")
            await asyncio.sleep(5)
            world.retreat()

        await world.run(intruded())

    run(main())
    recorded = read_run(journal_files(tmp_path / "logs"))
    assert explained(recorded, moment_of("+4", recorded)) == ()
    (why,) = explained(recorded, moment_of("+7", recorded), "undeclared")
    assert (why.finding.subject, why.first) == ("/intruder", False)
    assert why.facts == ("node /intruder: there now",)
    assert why.others == 0
    assert why.elapsed_s == pytest.approx(5.0, abs=1.5)
    assert explained(recorded, moment_of("+20", recorded), "undeclared") == ()
    assert named_findings(recorded) == ("graph.undeclared-node /intruder",)


def test_times_are_read_as_people_write_them(kept: Kept, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TZ", "UTC")
    kept.look("/camera")
    recorded = read_run(journal_files(kept.directory))
    assert moment_of("+2.5", recorded) == 2.5
    assert moment_of("2023-11-14T22:13:30Z", recorded) == 10
    assert moment_of("22:13:22", recorded) == pytest.approx(3, abs=1e-5)
    assert moment_of("22:13:22", recorded, first=True) == 2
    assert moment_of("22:14", recorded, first=True) == 40
    for word in ("soon", "25:00:00", "12", "+x"):
        with pytest.raises(UsageError, match="12:03:05"):
            moment_of(word, recorded)


def test_times_are_those_that_the_clock_showed_also_where_it_was_set_meanwhile(
    kept: Kept, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TZ", "UTC")
    for set_s in (0.0, 3600.0, -5.0, -86_400.0):
        kept.set_s = set_s
        for word in ("begins", "lasts"):
            kept.journal.on_event(Notice(message=f"{word} at {set_s:g}"))
    lines = [
        line.split("  ") for line in _verb(history.command, str(kept.directory))[1].splitlines()
    ]
    told = [line[-1] for line in lines]
    assert [each for each in told if each.startswith("the clock")] == [
        "the clock of this host was set forward by 3600.0 s",
        "the clock of this host was set back by 3605.0 s",
        "the clock of this host was set back by 86395.0 s",
    ]
    assert told.index("the clock of this host was set forward by 3600.0 s") + 1 == told.index(
        "begins at 3600"
    )

    def shown(*options: str) -> list[str]:
        text = _verb(history.command, str(kept.directory), *options)[1]
        return [line.split("  ")[-1] for line in text.splitlines() if " at " in line]

    every = shown()
    assert every == [each for each in told if " at " in each]
    assert shown("--since", "23:00:00") == every[2:]
    assert shown("--until", "22:30") == every[:2]
    assert shown("--until", "22:13") == every  # it was that late three times
    assert shown("--until", "2023-11-14T23:13:59Z") == every
    assert shown("--since", "+4.5", "--until", "+6") == every[3:5]


def _verb(command: object, *words: str) -> tuple[int, str]:
    result = CliRunner().invoke(command, words, standalone_mode=False)  # type: ignore[arg-type]
    if result.exception is not None:
        raise result.exception
    return int(result.return_value), result.stdout


def test_the_verbs_tell_a_run_whose_supervisor_was_killed(kept: Kept) -> None:
    started = RunStarted(
        system="robot",
        domain_id=3,
        rmw="rmw_fastrtps_cpp",
        discovery_range="localhost",
        nodes=("/camera", "/viewer"),
        processes=("camera", "viewer"),
        log_directory="here",
    )
    kept.journal._run = dataclasses.replace(kept.journal._run, supervisor=2**22 + 1)
    kept.journal.on_event(started)
    kept.look("/camera")
    kept.journal.on_event(Notice(message="about /camera\x1b[2J"))
    kept.journal.on_event(Notice(message="about /camera_2"))
    folder = str(kept.directory)
    code, text = _verb(history.command, folder)
    assert code == 0
    assert "robot: 2 nodes in 2 processes" in text.splitlines()[0]
    assert text.splitlines()[-1].endswith("ended without saying so")
    assert [
        line.split("  ")[-1]
        for line in _verb(history.command, folder, "--node", "camera")[1].splitlines()[:-1]
    ] == ["about /camera\\x1b[2J"]
    code, text = _verb(history.command, folder, "--format", "json")
    assert [{*json.loads(line)} - {"at", "elapsed_s"} for line in text.splitlines()] == [
        {"run"},
        {"event"},
        {"plan"},
        {"look"},
        {"event"},
        {"event"},
    ]
    assert _verb(history.replay_command, folder) == (
        0,
        "1 observations judged again: all as recorded\n",
    )


def test_a_verdict_that_is_otherwise_with_these_rules_is_shown(kept: Kept) -> None:
    kept.look("/camera")
    (file,) = journal_files(kept.directory)
    file.write_text(file.read_text().replace("graph.missing-node", "graph.gone-node"))
    (differs,) = replayed(read_run([file]))
    assert differs is not None
    assert {each.rule for each in differs.lost} == {"graph.gone-node"}
    code, text = _verb(history.replay_command, str(file))
    assert code == 4
    assert "  + violated: graph.missing-node: /viewer" in text.splitlines()


def test_a_journal_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot find a journal"):
        _verb(history.command, str(tmp_path))
    (tmp_path / "journal.jsonl").write_text("hello\n")
    with pytest.raises(UsageError, match="no line says of which run"):
        _verb(history.command, str(tmp_path))
