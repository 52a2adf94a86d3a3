"""docs/rules.md and the registry of rules say the same."""

from __future__ import annotations

import functools
import json
import re
from pathlib import Path

import pytest

import lifecycle
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import RULES, Heals, Rule

TESTS = Path(__file__).parents[2]
PAGE = TESTS.parent / "docs" / "rules.md"


def sections() -> dict[str, str]:
    found = re.split(r"^### (.+)$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return dict(zip(found[1::2], found[2::2], strict=True))


@functools.cache
def all_other_tests() -> str:
    files = (each for each in TESTS.rglob("*.py") if each != Path(__file__))
    return "\n".join(each.read_text(encoding="utf-8") for each in files)


def test_the_page_documents_exactly_the_registered_rules():
    assert sorted(sections()) == sorted(rule.id for rule in RULES)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.id)
def test_every_rule_is_tried_somewhere(rule: Rule):
    assert rule.id in all_other_tests()


def test_no_rule_is_registered_twice():
    ids = [rule.id for rule in RULES]
    assert len(ids) == len(set(ids))


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.id)
def test_a_section_gives_meaning_outcomes_reason_and_remedy(rule: Rule):
    body = sections()[rule.id]
    meaning = body.strip().splitlines()[0]
    assert meaning == rule.meaning[0].upper() + rule.meaning[1:] + "."
    assert f"- Outcomes: {', '.join(each.value for each in rule.outcomes)}\n" in body
    assert re.search(r"^- Why: \S", body, re.MULTILINE)
    assert re.search(r"^- What to do: \S", body, re.MULTILINE)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.id)
def test_a_rule_has_a_one_line_meaning_and_remedy_and_a_bad_outcome(rule: Rule):
    assert rule.meaning
    assert "\n" not in rule.meaning + rule.fix
    assert rule.fix
    assert rule.outcomes
    assert Outcome.OK not in rule.outcomes


def test_a_rule_cannot_be_given_an_outcome_that_it_does_not_document():
    rule = next(each for each in RULES if each.id == "graph.undeclared-node")
    with pytest.raises(ValueError) as error:
        rule.finding(
            outcome=Outcome.UNVERIFIABLE, subject="/a", expected="", observed="", message=""
        )
    assert str(error.value) == "cannot give rule graph.undeclared-node the outcome unverifiable"


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.id)
def test_what_is_only_not_there_yet_may_come(rule: Rule):
    passing = rule.awaits or rule.about or rule.if_undiscovered
    assert not passing or rule.heals is Heals.WITH_TIME


@pytest.mark.parametrize("room", ["supervisor", "verify", "cli"])
def test_nobody_reads_from_the_id_of_a_rule_what_the_rule_says(room: str):
    files = sorted((Path(lifecycle.__path__[0]) / room).rglob("*.py"))
    assert files
    parsed = re.compile(r"\.(rule|subject)\.(startswith|partition|rpartition|split)\(")
    assert [each.name for each in files if parsed.search(each.read_text("utf-8"))] == []


def test_a_manifest_may_name_every_rule_and_every_family_in_on_violation() -> None:
    schema = json.loads((PAGE.parents[1] / "schemas" / "manifest.v1.schema.json").read_text())
    names = schema["$defs"]["OnViolation"]["anyOf"][1]["propertyNames"]["enum"]
    assert sorted(names) == sorted(
        {"default", *(each.family for each in RULES), *(each.id for each in RULES)}
    )
    trusted = schema["$defs"]["Policy"]["properties"]["trust"]["items"]["anyOf"][0]["enum"]
    assert sorted(trusted) == sorted(each.id for each in RULES)
