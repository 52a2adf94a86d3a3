"""Every row of the catalogue, through the real command."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.outside.case import Case
from tests.outside.cases import CASES
from tests.outside.running import Run, running


def _rules(run: Run) -> set[str]:
    return {str(each["rule"]) for each in run.result.get("findings", ())}


def _judge(case: Case, run: Run, exit_code: int) -> None:
    """Compare what happened with the row; each failure shows all that was said."""
    said = f"\n{_short(run.output)}\nmarks: {sorted({mark[1:] for mark in run.marks()})}"
    assert exit_code in case.exit_codes, f"exit code {exit_code}, not {case.exit_codes}{said}"
    if case.verdict is not None:
        assert run.result.get("verdict") == case.verdict, said
    assert set(case.findings) <= _rules(run), f"findings {_rules(run)}{said}"
    assert not set(case.not_findings) & _rules(run), f"findings {_rules(run)}{said}"
    violated = [f for f in run.result.get("findings", ()) if f["outcome"] == "violated"]
    for name in case.violated:
        assert any(name in each["message"] for each in violated), f"nothing names {name}{said}"
    if case.activated is not None:
        assert run.activated == case.activated, f"activated {set(run.activated)}{said}"
    if case.received is not None:
        assert run.received == case.received, f"received {set(run.received)}{said}"
    for text in case.says:
        assert _flat(text) in _flat(run.output), f"does not say {text!r}{said}"
    for text in case.not_says:
        assert _flat(text) not in _flat(run.output), f"says {text!r}{said}"
    assert run.processes() == []


def _short(output: str) -> str:
    """Leave out the flows of each verdict: they fill pages."""
    return re.sub(r'"flows":\[.*?\],"(?=tolerated|measured|run|judged)', '"flows":[…],"', output)


def _flat(text: str) -> str:
    return re.sub(r"\s+", " ", text)


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(each, id=each.attack, marks=() if each.quick else pytest.mark.thorough)
        for each in CASES
    ],
)
def test_case(case: Case, tmp_path: Path, domain: int) -> None:
    with running(case, tmp_path, domain) as run:
        _judge(case, run, run.finish())
