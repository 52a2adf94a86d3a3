"""The verdict as SARIF 2.1.0, for editors and code scanning. Pure.

Source of the format: OASIS SARIF 2.1.0. Violated is an error, unverifiable a warning; a finding
points at the declaration in the manifest. A run that was no success has at least one error; its
rule is `run.end` where no finding is to blame, so that an unjudged system does not look good.
"""

from __future__ import annotations

import json
from urllib.parse import quote

from lifecycle.printable import json_text
from lifecycle.verify.rules import RULES
from lifecycle.verify.verdict import Finding, Outcome, RunEnd, Verdict

_SCHEMA = "https://json.schemastore.org/sarif-2.1.0.json"
_LEVELS = {Outcome.VIOLATED: "error", Outcome.UNVERIFIABLE: "warning", Outcome.OK: "none"}

_Json = dict[str, object]


def to_sarif(verdict: Verdict) -> str:
    """Write a SARIF log with one run; every rule is described, found or not."""
    index = {rule.id: position for position, rule in enumerate(RULES)}
    rules = [
        {
            "id": rule.id,
            "shortDescription": {"text": rule.meaning},
            "help": {"text": rule.fix},
            "defaultConfiguration": {"level": _LEVELS[rule.outcomes[0]]},
        }
        for rule in RULES
    ]
    log = {
        "$schema": _SCHEMA,
        "version": "2.1.0",
        "runs": [
            {
                "tool": {"driver": {"name": "lifecycle", "rules": rules}},
                "columnKind": "unicodeCodePoints",
                "results": [
                    *(_result(each, index.get(each.rule)) for each in verdict.findings),
                    *_end_result(verdict),
                ],
                "properties": {"verdict": verdict.verdict.value},
                **_invocations(verdict.run),
            }
        ],
    }
    return json_text(json.dumps(log, ensure_ascii=False, indent=2)) + "\n"


def _invocations(run: RunEnd | None) -> _Json:
    if run is None:
        return {}
    ended = {
        "executionSuccessful": run.exit_code == 0,
        "exitCode": run.exit_code,
        "exitCodeDescription": run.describe(),
    }
    return {"invocations": [ended]}


def _end_result(verdict: Verdict) -> list[_Json]:
    """Return what a log without an error has to say of a run that was no success."""
    run = verdict.run
    if run is None or run.exit_code == 0:
        return []
    if any(each.outcome is Outcome.VIOLATED for each in verdict.findings):
        return []
    return [{"ruleId": "run.end", "level": "error", "message": {"text": run.describe()}}]


def _result(finding: Finding, rule_index: int | None) -> _Json:
    location: _Json = {
        "logicalLocations": [{"fullyQualifiedName": finding.subject, "kind": "resource"}]
    }
    if finding.at:
        file, line, column = finding.at.rsplit(":", 2)
        location["physicalLocation"] = {
            "artifactLocation": {"uri": quote(file)},
            "region": {"startLine": int(line), "startColumn": int(column)},
        }
    return {
        "ruleId": finding.rule,
        **({} if rule_index is None else {"ruleIndex": rule_index}),
        "level": _LEVELS[finding.outcome],
        "message": {
            "text": f"{finding.message}; {finding.hint}" if finding.hint else finding.message
        },
        "locations": [location],
        "properties": {
            "outcome": finding.outcome.value,
            "expected": finding.expected,
            "observed": finding.observed,
        },
    }
