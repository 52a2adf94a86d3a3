"""JUnit XML, SARIF 2.1.0 and annotations of GitHub, as continuous integration reads them.

Owns: one writer of each, for `check` and `verify` alike, and `Problem`, the one shape of what they
have found; what is in them is their callers'. Sources: OASIS SARIF 2.1.0; "Workflow commands for
GitHub Actions", setting an error message. Pure.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from urllib.parse import quote
from xml.etree import ElementTree as ET

import msgspec

from lifecycle.printable import json_text, lines

Json = dict[str, object]


class Case(msgspec.Struct, frozen=True, kw_only=True):
    """One test case of JUnit.

    Attributes:
        name: says what holds if it passes.
        at: `file:line:column` that it is about; empty for none.
        failure: (message, text); None if it passes.
        note: text beside its result; empty for none.
    """

    classname: str
    name: str
    at: str = ""
    failure: tuple[str, str] | None = None
    note: str = ""


def junit(name: str, cases: Sequence[Case], *, note: str = "") -> str:
    """Return JUnit XML of one suite, with text that is of all of its cases."""
    root = ET.Element("testsuites")
    suite = ET.SubElement(root, "testsuite", name=lines(name))
    failures = sum(each.failure is not None for each in cases)
    for element in (root, suite):
        element.attrib |= {"tests": str(len(cases)), "failures": str(failures)}
    for case in cases:
        names = {"classname": lines(case.classname), "name": lines(case.name)}
        one = ET.SubElement(suite, "testcase", names)
        if case.at:
            file, line, _ = _place(case.at)
            one.attrib |= {"file": lines(file), "line": line}
        if case.failure is not None:
            message, text = map(lines, case.failure)
            ET.SubElement(one, "failure", message=message).text = text
        _note(one, case.note)
    _note(suite, note)
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _note(place: ET.Element, text: str) -> None:
    if text:
        ET.SubElement(place, "system-out").text = lines(text)


class Problem(msgspec.Struct, frozen=True, kw_only=True):
    """Something that `check` or `verify` has found.

    Attributes:
        level: "error", "warning", "note" or "none".
        message: a sentence.
        hint: what to do about it; empty for nothing.
        subject: what it is about, in words of the system; empty for none.
        at: `file:line:column` of a declaration; empty for none.
        properties: for readers of this tool.
    """

    rule: str
    level: str
    message: str
    hint: str = ""
    subject: str = ""
    at: str = ""
    properties: Json = {}

    @property
    def text(self) -> str:
        """The message, with what to do behind it."""
        return f"{self.message}; {self.hint}" if self.hint else self.message


_ESCAPED = str.maketrans({"%": "%25", "\r": "%0D", "\n": "%0A"})
_ESCAPED_IN_PROPERTIES = {**_ESCAPED, ord(":"): "%3A", ord(","): "%2C"}


def github(problem: Problem) -> str:
    """Return a workflow command that GitHub Actions shows beside the line of a file."""
    file, line, column = _place(problem.at) if problem.at else ("", "", "")
    values = {"file": file, "line": line, "col": column, "title": problem.rule}
    named = ",".join(
        f"{name}={value.translate(_ESCAPED_IN_PROPERTIES)}"
        for name, value in values.items()
        if value
    )
    level = "notice" if problem.level == "note" else problem.level
    return f"::{level} {named}::{problem.text.translate(_ESCAPED)}"


def _place(at: str) -> tuple[str, str, str]:
    """Return file, line and column."""
    file, line, column = at.rsplit(":", 2)
    return file, line, column


def sarif(
    problems: Iterable[Problem],
    rules: Sequence[Mapping[str, object]],
    *,
    properties: Json,
    invocation: Json | None,
) -> str:
    """Return a SARIF log with one run.

    Args:
        problems: in their order.
        rules: each with its `id`.
        properties: of the run.
        invocation: how it ended; None if it did not yet.
    """
    index = {rule["id"]: position for position, rule in enumerate(rules)}
    run: Json = {
        "tool": {"driver": {"name": "lifecycle", "rules": rules}},
        "columnKind": "unicodeCodePoints",
        "results": [_result(each, index.get(each.rule)) for each in problems],
        "properties": properties,
    }
    if invocation is not None:
        run["invocations"] = [invocation]
    log = {
        "$schema": "https://json.schemastore.org/sarif-2.1.0.json",
        "version": "2.1.0",
        "runs": [run],
    }
    return json_text(json.dumps(log, ensure_ascii=False, indent=2)) + "\n"


def _result(each: Problem, rule_index: int | None) -> Json:
    location: Json = {}
    if each.subject:
        location["logicalLocations"] = [{"fullyQualifiedName": each.subject, "kind": "resource"}]
    if each.at:
        file, line, column = _place(each.at)
        location["physicalLocation"] = {
            "artifactLocation": {"uri": quote(file)},
            "region": {"startLine": int(line), "startColumn": int(column)},
        }
    return {
        "ruleId": each.rule,
        **({} if rule_index is None else {"ruleIndex": rule_index}),
        "level": each.level,
        "message": {"text": each.text},
        **({"locations": [location]} if location else {}),
        **({"properties": each.properties} if each.properties else {}),
    }
