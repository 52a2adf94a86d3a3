"""`--report FILE`: the suffix says the format, and every end of a command is written."""

from __future__ import annotations

import errno
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree as ET

import click
import pytest
from msgspec.structs import replace

from lifecycle.cli.common import write_text
from lifecycle.cli.report import ReportFile, open_report
from lifecycle.cli.up_output import output
from lifecycle.cli.verbs.up import _finished
from lifecycle.errors import ExitCode, MiddlewareError, UsageError
from lifecycle.manifest.diagnostics import Diagnostic, ManifestError, Position, Severity
from lifecycle.plan.build import build_plan
from lifecycle.supervisor.run.options import UpResult
from lifecycle.supervisor.run.signals import Ended
from lifecycle.verify.judge import verify
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Stage, Verdict
from tests.builders import teleop
from tests.unit.verify.edits import drop_node
from tests.unit.verify.perfect import perfect

PLAN = build_plan(teleop(), environment={})
RULE = "graph.missing-node"


def violated() -> Verdict:
    verdict = verify(PLAN, drop_node("/viewer")(perfect(PLAN)), stage=Stage.CONNECTED)
    assert verdict.verdict is Outcome.VIOLATED
    return verdict


def written(directory: Path, name: str) -> str:
    path = directory / name
    open_report(path)
    with ReportFile(path) as report:
        report.begin(PLAN)
        report.end(violated())
    text = path.read_text(encoding="utf-8")
    assert text.endswith("\n")
    return text


@pytest.mark.parametrize("name", ["report.xml", "report.junit.XML"])
def test_xml_is_junit_and_names_what_failed(tmp_path: Path, name: str) -> None:
    cases = ET.fromstring(written(tmp_path, name)).iter("testcase")
    failed = [each.get("classname") for each in cases if each.find("failure") is not None]
    assert RULE in failed


@pytest.mark.parametrize("name", ["report.sarif", "report.sarif.json"])
def test_sarif_is_sarif(tmp_path: Path, name: str) -> None:
    results = json.loads(written(tmp_path, name))["runs"][0]["results"]
    assert RULE in {each["ruleId"] for each in results}


def test_json_is_json(tmp_path: Path) -> None:
    findings = json.loads(written(tmp_path, "report.json"))["findings"]
    assert RULE in {each["rule"] for each in findings}


def test_txt_is_what_people_read(tmp_path: Path) -> None:
    assert written(tmp_path, "report.txt").startswith("verdict: violated")


@pytest.mark.parametrize("name", ["report", "report.yaml", "report.xml.bak", ".xml"])
def test_a_suffix_that_says_no_format_is_an_error(tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError) as caught:
        open_report(tmp_path / name)
    path = tmp_path / name
    assert str(caught.value) == (
        f"cannot tell the format of report {str(path)!r} by its suffix {path.suffix!r}; "
        "allowed: .json, .xml (JUnit), .sarif, .txt"
    )
    assert not path.exists()


def _directory(path: Path) -> None:
    (path / "report.json").mkdir(parents=True)


def _file(path: Path) -> None:
    path.touch()


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda _: None, "No such file or directory"),
        (_directory, "Is a directory"),
        (_file, "Not a directory"),
    ],
)
def test_a_report_that_cannot_be_written_is_one_clear_error(
    tmp_path: Path, make: Callable[[Path], None], reason: str
) -> None:
    make(tmp_path / "no")
    path = tmp_path / "no" / "report.json"
    with pytest.raises(UsageError) as caught:
        open_report(path)
    assert str(caught.value) == f"cannot write report {str(path)!r}: {reason}"


def test_a_full_disk_leaves_a_report_whole_and_red(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / "report.txt"
    with ReportFile(path) as report:
        report.begin(PLAN)
        before = path.read_text()
        monkeypatch.setattr(Path, "replace", full)
        assert report.end(violated()) == ExitCode.USAGE
    assert "No space left on device" in capsys.readouterr().err
    assert path.read_text() == before
    assert "it never came to its end" in before


def test_nothing_old_outlives_a_run_that_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "report.xml"
    path.write_text("<testsuites failures='0'/>")
    open_report(path)
    assert path.read_text() == ""
    ReportFile(path).begin(PLAN)
    root = ET.parse(path).getroot()
    assert root.get("failures") == "1"
    (failure,) = root.iter("failure")
    assert failure.get("message") == "it never came to its end: the process was killed"


def test_a_pipe_is_written_once_in_the_end(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    open_report(path)
    with ReportFile(path) as report:
        report.begin(PLAN)
        report.end(violated())
    text = os.read(reader, 1 << 20).decode()
    os.close(reader)
    assert json.loads(text)["verdict"] == "violated"


ENDS: list[tuple[BaseException, int, str]] = [
    (UsageError("cannot run machine 'x'"), 2, "cannot run machine 'x'"),
    (click.UsageError("no such option"), 2, "no such option"),
    (MiddlewareError("cannot make a participant"), 6, "cannot make a participant"),
    (Ended(signal.SIGTERM), 143, "terminated"),
    (Ended(signal.SIGHUP), 129, "the terminal was closed"),
    (Ended(signal.SIGINT), 130, "interrupted"),
    (KeyboardInterrupt(), 130, "interrupted"),
    (ValueError("oops"), 70, "a bug in lifecycle: ValueError: oops"),
]


@pytest.mark.parametrize(("error", "code", "reason"), ENDS, ids=lambda each: type(each).__name__)
@pytest.mark.parametrize("suffix", ["json", "xml", "sarif", "txt"])
def test_every_end_is_reported_and_none_of_these_is_a_success(
    tmp_path: Path, error: BaseException, code: int, reason: str, suffix: str
) -> None:
    path = tmp_path / f"report.{suffix}"

    def fail() -> None:
        with ReportFile(path):
            raise error

    with pytest.raises(type(error)):
        fail()
    text = path.read_text()
    if suffix == "json":
        document = json.loads(text)
        assert document["run"] == {
            "reason": reason,
            "reached": None,
            "exit_code": code,
        }
        assert (document["verdict"], document["judged"]) == ("unverifiable", False)
    elif suffix == "xml":
        root = ET.fromstring(text)
        assert [each.get("message") for each in root.iter("failure")] == [reason]
    elif suffix == "sarif":
        (run,) = json.loads(text)["runs"]
        assert run["invocations"][0]["exitCode"] == code
        assert [each["level"] for each in run["results"]] == ["error"]
    else:
        assert f"exit code {code}: {reason}" in text


def test_an_invalid_manifest_is_reported_with_every_error(tmp_path: Path) -> None:
    at = Position(file="m.lifecycle.yaml", line=3, column=5, path="nodes.a")
    wrong = [
        Diagnostic(rule=f"manifest.{each}", severity=severity, at=at, message=f"cannot {each}")
        for each, severity in (
            ("read", Severity.ERROR),
            ("warn", Severity.WARNING),
            ("use", Severity.ERROR),
        )
    ]
    path = tmp_path / "report.json"

    def fail() -> None:
        with ReportFile(path):
            raise ManifestError(wrong)

    with pytest.raises(ManifestError):
        fail()
    document = json.loads(path.read_text())
    assert document["verdict"] == "violated"
    assert [each["message"] for each in document["findings"]] == ["cannot read", "cannot use"]
    assert document["run"]["exit_code"] == 3
    assert document["run"]["reason"] == "the manifest is invalid: 2 errors"


def test_a_report_that_cannot_be_written_in_the_end_is_no_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = tmp_path / "reports"
    directory.mkdir()
    path = directory / "report.json"
    open_report(path)
    with ReportFile(path) as report:
        report.begin(PLAN)
        path.unlink()
        directory.rmdir()
        assert report.end(violated()) == ExitCode.USAGE
    assert "cannot write report" in capsys.readouterr().err


def test_a_run_that_took_another_manifest_is_reported_by_that_one(tmp_path: Path) -> None:
    """Whether what is unverifiable is a failure in JUnit is the policy's to say."""
    found = [replace(each, outcome=Outcome.UNVERIFIABLE) for each in violated().findings]
    verdict = replace(
        violated(), verdict=Outcome.UNVERIFIABLE, findings=tuple(found), blocking=False
    )
    policy = replace(PLAN.policy, unverifiable="block")
    result = UpResult(
        exit_code=ExitCode.UNVERIFIABLE,
        verdict=verdict,
        plan=replace(PLAN, policy=policy),
    )
    failed = []
    for taken in (replace(result, plan=None), result):
        path = tmp_path / "report.xml"
        open_report(path)
        with ReportFile(path) as report, output("json") as listener:
            report.begin(PLAN)
            assert _finished(taken, listener, report) == ExitCode.UNVERIFIABLE
        failed.append(sum(1 for _ in ET.parse(path).iter("failure")))
    assert failed[0] == 0
    assert failed[1] > 0


def test_a_text_goes_into_what_is_no_file_and_through_a_link_and_leaves_both(
    tmp_path: Path,
) -> None:
    pipe, link, file = tmp_path / "pipe", tmp_path / "link", tmp_path / "file"
    os.mkfifo(pipe)
    link.symlink_to(file)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        for each in (pipe, link):
            write_text(each, "graph {}\n")
        assert os.read(reader, 100) == b"graph {}\n"
    finally:
        os.close(reader)
    assert pipe.is_fifo()
    assert link.is_symlink()
    assert file.read_text() == "graph {}\n"
