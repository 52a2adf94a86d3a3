"""Every document in tests/corpus, found automatically, loaded and planned as `check` does it.

Format: `valid/NAME.lifecycle.yaml` loads; its warnings, if any, are the text of
`valid/NAME.expected`. `invalid/NAME.lifecycle.yaml` has errors; its diagnostics, one per line,
files by base name, are exactly the text of `invalid/NAME.expected`. A comment line
`# corpus-arguments: a:=1 b:=2` gives arguments, `# corpus-environment: A=1` environment variables.
Files in subdirectories are there to be included or referred to.

LIFECYCLE_CORPUS=regenerate rewrites the expected texts; read the difference before committing it.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from lifecycle.manifest.diagnostics import ManifestError, Severity
from lifecycle.manifest.loading import load
from lifecycle.plan.build import check_plan

CORPUS = Path(__file__).parents[2] / "corpus"
VALID = sorted((CORPUS / "valid").glob("*.lifecycle.yaml"))
INVALID = sorted((CORPUS / "invalid").glob("*.lifecycle.yaml"))
REGENERATE = os.environ.get("LIFECYCLE_CORPUS") == "regenerate"


def pairs(text: str, keyword: str, separator: str) -> dict[str, str]:
    """Return the words of a comment line `# KEYWORD: name=value …` in a document of the corpus."""
    words = [
        word
        for line in re.findall(rf"^# {keyword}: (.*)$", text, re.MULTILINE)
        for word in line.split()
    ]
    return dict(word.split(separator, 1) for word in words)


def _load(path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[bool, str]:
    """Return whether the document can be used, and its diagnostics as text."""
    text = path.read_bytes().decode("utf-8", errors="replace")
    monkeypatch.chdir(path.parent)
    for name, value in pairs(text, "corpus-environment", "=").items():
        monkeypatch.setenv(name, value)
    try:
        loaded = load(path.name, pairs(text, "corpus-arguments", ":="))
    except ManifestError as error:
        return False, "".join(f"{each}\n" for each in error.diagnostics)
    found = (*loaded.warnings, *check_plan(loaded.manifest, files=loaded.files))
    is_sound = all(each.severity is not Severity.ERROR for each in found)
    return is_sound, "".join(f"{each}\n" for each in found)


def _compare(path: Path, text: str) -> None:
    expected = path.with_name(path.name.replace(".lifecycle.yaml", ".expected"))
    if REGENERATE:
        if text:
            expected.write_text(text, encoding="utf-8")
        else:
            expected.unlink(missing_ok=True)
    assert text == (expected.read_text(encoding="utf-8") if expected.exists() else "")


@pytest.mark.parametrize("path", VALID, ids=lambda path: path.name.split(".")[0])
def test_a_valid_document_loads_with_exactly_its_warnings(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loads, text = _load(path, monkeypatch)
    assert loads, text
    _compare(path, text)


@pytest.mark.parametrize("path", INVALID, ids=lambda path: path.name.split(".")[0])
def test_an_invalid_document_fails_with_exactly_its_text(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loads, text = _load(path, monkeypatch)
    assert not loads
    assert "cannot" in text
    _compare(path, text)


def test_the_corpus_holds_at_least_sixty_invalid_documents() -> None:
    assert len(INVALID) >= 60


def test_every_expected_text_belongs_to_a_document() -> None:
    names = {path.name.replace(".lifecycle.yaml", ".expected") for path in (*VALID, *INVALID)}
    found = {
        path.name
        for folder in ("valid", "invalid")
        for path in (CORPUS / folder).glob("*.expected")
    }
    assert found <= names
