"""What was found, in one line for each finding, and all of it, which is a line of `findings.txt`.

Tests compare rules, places and the like. All that they find is in that file, with its texts, one
line for each. `make findings` writes it anew: read the difference before you commit it.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import hypothesis

from lifecycle.verify import judge
from lifecycle.verify.verdict import Finding, Verdict

_FILE = Path(__file__).with_name("findings.txt")
_WRITES = "WRITE_FINDINGS" in os.environ
_found: set[str] = set()


def verify(*what: Any, **how: Any) -> Verdict:
    """Judge as `lifecycle.verify` does, and compare the texts of what is found."""
    verdict = judge.verify(*what, **how)
    _compare(verdict.findings)
    return verdict


def lines(findings: Iterable[Finding]) -> list[str]:
    """Return outcome, rule, subject, node and place (line:column) of each finding."""
    found = list(findings)
    _compare(found)
    return [_line(each) for each in found]


def _line(finding: Finding) -> str:
    kind = f" ({finding.endpoint.noun})" if finding.endpoint else ""
    at = f" at {str(finding.at).partition(':')[2]}" if finding.at else ""
    what = f"{finding.outcome.value} {finding.rule}: {finding.subject}"
    return f"{what}, {finding.node or 'no node'}{kind}{at}"


def _text(finding: Finding) -> str:
    texts = (finding.message, finding.expected, finding.observed, finding.hint)
    assert all(isinstance(each, str) for each in texts), finding
    return " | ".join((_line(finding), *texts, *finding.nodes)).replace("\n", "\\n")


def _compare(findings: Iterable[Finding]) -> None:
    if hypothesis.currently_in_test_context():
        return
    texts = {_text(each) for each in findings}
    if not _WRITES:
        assert texts - _as_read() == set(), "run `make findings`, and read the difference"
    elif not texts <= _found:
        _found.update(texts)
        _FILE.write_text("".join(f"{each}\n" for each in sorted(_found)))


@functools.cache
def _as_read() -> set[str]:
    return set(_FILE.read_text().splitlines())
