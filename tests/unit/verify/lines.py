"""What was found, in one line for each finding, and its texts as `findings.json` has them.

Tests compare lines; the texts of all findings of a test are compared here with those that somebody
has read. `make findings` writes them anew: read the difference.
"""

from __future__ import annotations

import functools
import json
import os
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import hypothesis

from lifecycle.verify.verdict import Finding

_READ = Path(__file__).with_name("findings.json")
_WRITES = "WRITE_FINDINGS" in os.environ
_found: defaultdict[str, list[list[str]]] = defaultdict(list)


def lines(findings: Iterable[Finding]) -> list[str]:
    """Return outcome, rule, subject, node and place (line:column) of each finding."""
    found = list(findings)
    _compare([_texts(each) for each in found])
    return [_line(each) for each in found]


def _line(finding: Finding) -> str:
    kind = f" ({finding.endpoint.noun})" if finding.endpoint else ""
    at = f" at {str(finding.at).partition(':')[2]}" if finding.at else ""
    what = f"{finding.outcome.value} {finding.rule}: {finding.subject}"
    return f"{what}, {finding.node or 'no node'}{kind}{at}"


def _texts(finding: Finding) -> str:
    texts = (finding.message, finding.expected, finding.observed, finding.hint)
    assert all(isinstance(each, str) for each in texts), finding
    return " | ".join((*texts, *finding.nodes))


def _compare(texts: list[str]) -> None:
    test = os.environ["PYTEST_CURRENT_TEST"].rpartition(" ")[0]
    if hypothesis.currently_in_test_context():
        return
    number = len(_found[test])
    _found[test].append(texts)
    if _WRITES:
        _READ.write_text(json.dumps(_found, indent=1, ensure_ascii=False, sort_keys=True) + "\n")
    else:
        assert texts == _as_read()[test][number], "read it, and run `make findings`"


@functools.cache
def _as_read() -> dict[str, list[list[str]]]:
    found: dict[str, list[list[str]]] = json.loads(_READ.read_text())
    return found
