"""What the tests of semantic checks share: a manifest as text, its findings as text."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest

from lifecycle.manifest.diagnostics import ManifestError
from lifecycle.manifest.loading import Loaded, load

FILE = "s.lifecycle.yaml"

Findings = Callable[..., list[str]]


@pytest.fixture
def findings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Findings:
    """Return the findings of a manifest, each as its rule and its text, without the file's name.

    The text starts below `manifest_version` and `system`; further files are given by keyword with
    underscores for dots.
    """
    monkeypatch.chdir(tmp_path)

    def find(text: str, **files: str) -> list[str]:
        for name, content in files.items():
            Path(name.replace("_yaml", ".yaml")).write_text(textwrap.dedent(content))
        header = "manifest_version: 1\nsystem: s\n"
        Path(FILE).write_text(header + textwrap.dedent(text).lstrip("\n"))
        try:
            found: Loaded | ManifestError = load(FILE)
        except ManifestError as error:
            found = error
        each_of = found.warnings if isinstance(found, Loaded) else found.diagnostics
        return [f"{each.rule} {each}".replace(f"{FILE}:", "") for each in each_of]

    return find
