"""`lifecycle check` and `up` of programs that are not there, and the formats of what is found."""

from __future__ import annotations

import json
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import jsonschema
import pytest

from lifecycle.cli import main
from lifecycle.manifest.schema import read_schema

MANIFEST = """manifest_version: 1
system: talk
nodes:
  talker:
    run: {python: "talk:%s"}
"""
SOURCE = "from lifecycle import LifecycleNode\nclass Talker(LifecycleNode): ...\nMade = print()\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "talk.py").write_text(SOURCE)
    for name in ("Talker", "Talkr", "Made"):
        (tmp_path / f"{name}.lifecycle.yaml").write_text(MANIFEST % name)
    return tmp_path


@pytest.mark.usefixtures("folder")
def test_a_class_that_is_not_there_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "Talker.lifecycle.yaml"]) == 0
    assert capsys.readouterr().out == "talk: 1 node, 0 endpoints, 0 links: ok\n"
    assert main(["check", "Talkr.lifecycle.yaml"]) == 3
    assert capsys.readouterr().out == (
        "Talkr.lifecycle.yaml:5:19: nodes.talker.run.python: cannot find class 'Talkr' in talk "
        "(talk.py); it has Talker; did you mean 'Talker'?\n"
        "Talkr.lifecycle.yaml: not ok (1 error)\n"
    )


@pytest.mark.usefixtures("folder")
def test_what_could_not_be_resolved_is_said_and_fails_only_when_strict(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["check", "Made.lifecycle.yaml"]) == 0
    assert capsys.readouterr().out == (
        "Made.lifecycle.yaml:5:19: nodes.talker.run.python: could not resolve class 'talk:Made': "
        "Made is made by running talk.py\n"
        "talk: 1 node, 0 endpoints, 0 links: ok (1 not resolved)\n"
    )
    assert main(["check", "Made.lifecycle.yaml", "--strict"]) == 5
    capsys.readouterr()
    assert main(["check", "Made.lifecycle.yaml", "--format", "json"]) == 0
    report = json.loads(capsys.readouterr().out)
    jsonschema.validate(report, read_schema("check.v1.schema.json"))
    assert [each["subject"] for each in report["unresolved"]] == ["class 'talk:Made'"]


def test_a_junit_report_has_the_same_test_whatever_was_found(folder: Path) -> None:
    for name, failures in (("Talker", "0"), ("Talkr", "1"), ("Made", "0")):
        main(["check", f"{name}.lifecycle.yaml", "--report", "report.xml"])
        suite = ET.parse(folder / "report.xml").getroot().find("testsuite")
        assert suite is not None
        assert (suite.get("failures"), suite.get("skipped")) == (failures, "0")
        assert [each.get("name") for each in suite.findall("testcase")] == ["the manifest is valid"]


def test_a_report_is_written_by_its_suffix_on_every_exit_code(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", "Talkr.lifecycle.yaml", "--report", "report.sarif"]) == 3
    log = json.loads((folder / "report.sarif").read_text())
    (result,) = log["runs"][0]["results"]
    assert (result["ruleId"], result["level"]) == ("program.missing", "error")
    assert result["locations"][0]["physicalLocation"]["region"]["startLine"] == 5
    assert main(["check", "nowhere.lifecycle.yaml", "--report", "report.json"]) == 3
    assert json.loads((folder / "report.json").read_text())["ok"] is False
    capsys.readouterr()
    assert main(["check", "Talker.lifecycle.yaml", "--report", "report.pdf"]) == 2
    wrong = ["--machine", "nowhere", "--report", "report.json"]
    assert main(["check", "Talker.lifecycle.yaml", *wrong]) == 2
    (why,) = json.loads((folder / "report.json").read_text())["diagnostics"]
    assert why["rule"] == "check.usage"
    assert "allowed: .json" in capsys.readouterr().err


def test_up_refuses_before_it_starts_anything(folder: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "lifecycle", "up", "Talkr.lifecycle.yaml"],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 3
    assert "cannot find class 'Talkr' in talk" in done.stderr
