"""The journal of a run: all that it tells can be had back, whatever happens to its files.

That a journal tells the story of a run is checked at the end of every session in the world of fakes
(session_world.py).
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from click.testing import CliRunner
from msgspec.structs import replace

from lifecycle.cli.verbs.history import command as history_command
from lifecycle.errors import UsageError
from lifecycle.supervisor.run.events import Notice, Stopped, VerdictChanged
from lifecycle.supervisor.run.journal import Journal, journal_files, read_run
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Stage
from tests.unit.supervisor.fakes import run_started, verdict_of

VERDICT = VerdictChanged(
    stage=Stage.CONNECTED, verdict=verdict_of(Outcome.VIOLATED, "graph.missing-node")
)


class Kept:
    """A journal in a directory, and what it says to people."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.said: list[str] = []
        self.journal = Journal(directory, "robot", "42", say=self.said.append)

    def say(self, message: str) -> None:
        self.journal.on_event(Notice(message=message))

    def lines(self) -> list[dict[str, Any]]:
        (file,) = journal_files(self.directory)
        return [json.loads(line) for line in file.read_text().splitlines()]


@pytest.fixture
def kept(tmp_path: Path) -> Iterator[Kept]:
    made = Kept(tmp_path)
    yield made
    made.journal.close()


def test_every_line_is_as_the_schema_says(kept: Kept) -> None:
    schema = json.loads(Path("schemas/journal.v1.schema.json").read_text())
    kept.journal.on_event(VERDICT)
    kept.journal.on_event(Stopped(exit_code=0, elapsed_s=1.0))
    lines = kept.lines()
    assert [{*each} - {"at", "elapsed_s"} for each in lines] == [{"run"}, {"event"}, {"event"}]
    for each in lines:
        jsonschema.validate(each, schema)


def test_a_full_file_makes_room_and_each_says_of_which_run_it_is(kept: Kept) -> None:
    kept.journal._file.largest = 2_000
    for number in range(40):
        kept.say(f"{number}")
    older, newest = journal_files(kept.directory)
    assert older.stat().st_size < 2_200
    assert all(read_run([each], print)[0].line.run is not None for each in (older, newest))
    said = [each.event.message for each in read_run((older, newest), print) if each.event]
    assert said == [f"{number}" for number in range(40 - len(said), 40)]


def test_a_torn_line_and_a_foreign_one_are_passed_over_and_named(kept: Kept) -> None:
    kept.say("one")
    (file,) = journal_files(kept.directory)
    with file.open("ab") as journal:
        journal.write(b'{"event": 7}\n\x00\xff\n' + file.read_bytes().splitlines()[-1][:50])
    unreadable: list[str] = []
    assert len(read_run(journal_files(kept.directory), unreadable.append)) == 2
    places = [each.partition(": ")[0] for each in unreadable]
    assert places == [f"journal.jsonl:{number}" for number in (3, 4, 5)]
    assert unreadable[-1].endswith(": it is incomplete")


def _verb(command: object, *words: str) -> tuple[int, str]:
    result = CliRunner().invoke(command, words, standalone_mode=False)  # type: ignore[arg-type]
    if result.exception is not None:
        raise result.exception
    return int(result.return_value), result.stdout


def test_the_verbs_tell_a_run_whose_supervisor_was_killed(kept: Kept) -> None:
    started = run_started("/camera", "/viewer")
    kept.journal._run = replace(kept.journal._run, supervisor=2**22 + 1)
    kept.journal.on_event(started)
    kept.journal.on_event(VERDICT)
    kept.journal.on_event(Notice(message="about /camera\x1b[2J"))
    kept.journal.on_event(Notice(message="about /camera_2"))
    folder = str(kept.directory)
    code, text = _verb(history_command, folder)
    assert code == 0
    assert "robot: 2 nodes in 2 processes" in text.splitlines()[0]
    assert text.splitlines()[-1].endswith("ended without saying so")
    said = [line.split("  ")[-1] for line in text.splitlines() if "about" in line]
    assert said == ["about /camera\\x1b[2J", "about /camera_2"]
    code, text = _verb(history_command, folder, "--format", "json")
    assert text.splitlines() == (kept.directory / "journal.jsonl").read_text().splitlines()


def test_below_a_verdict_are_the_findings_that_came_and_went(kept: Kept) -> None:
    for each in (VERDICT, VERDICT, replace(VERDICT, verdict=verdict_of(Outcome.OK))):
        kept.journal.on_event(each)
    text = _verb(history_command, str(kept.directory))[1]
    assert [line for line in text.splitlines() if line.startswith("    ")] == [
        "    + violated graph.missing-node: graph.missing-node /camera",
        "    - violated graph.missing-node: /camera",
    ]


def test_a_journal_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot find a journal"):
        _verb(history_command, str(tmp_path))
    (tmp_path / "journal.jsonl").write_text("hello\n")
    with pytest.raises(UsageError, match="no line says of which run"):
        _verb(history_command, str(tmp_path))
