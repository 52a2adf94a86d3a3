"""`--report FILE`: the suffix says the format."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from lifecycle.cli.report import write_report
from lifecycle.errors import UsageError
from lifecycle.plan import build_plan
from lifecycle.verify import Outcome, Stage, Verdict, verify
from tests.unit.plan.samples import teleop
from tests.unit.verify.edits import drop_node
from tests.unit.verify.perfect import perfect

PLAN = build_plan(teleop(), environment={})
RULE = "graph.missing-node"


def violated() -> Verdict:
    verdict = verify(PLAN, drop_node("/viewer")(perfect(PLAN)), stage=Stage.CONNECTED)
    assert verdict.verdict is Outcome.VIOLATED
    return verdict


def written(directory: Path, name: str) -> str:
    write_report(directory / name, violated(), PLAN)
    text = (directory / name).read_text(encoding="utf-8")
    assert text.endswith("\n")
    return text


def test_xml_is_junit_and_names_what_failed(tmp_path: Path) -> None:
    cases = ET.fromstring(written(tmp_path, "report.xml")).iter("testcase")
    failed = [each.get("classname") for each in cases if each.find("failure") is not None]
    assert RULE in failed


def test_sarif_is_sarif(tmp_path: Path) -> None:
    results = json.loads(written(tmp_path, "report.sarif"))["runs"][0]["results"]
    assert RULE in {each["ruleId"] for each in results}


@pytest.mark.parametrize("name", ["report.json", "report"])
def test_any_other_suffix_is_json(tmp_path: Path, name: str) -> None:
    assert RULE in {each["rule"] for each in json.loads(written(tmp_path, name))["findings"]}


def test_txt_is_what_people_read(tmp_path: Path) -> None:
    assert written(tmp_path, "report.txt").startswith("verdict: violated")


def test_a_report_that_cannot_be_written_is_one_clear_error(tmp_path: Path) -> None:
    file = tmp_path / "no" / "report.json"
    with pytest.raises(UsageError) as caught:
        write_report(file, violated(), PLAN)
    assert str(caught.value) == f"cannot write report {str(file)!r}: No such file or directory"
