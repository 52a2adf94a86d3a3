"""What the tests of semantic checks share: a manifest as text, its findings as text."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest

from lifecycle.manifest.diagnostics import ManifestError
from lifecycle.manifest.loading import load
from lifecycle.plan.build import check_plan

FILE = "s.lifecycle.yaml"

Findings = Callable[..., list[str]]


@pytest.fixture
def findings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Findings:
    """Return what `check` finds in a manifest, each as rule and text, without the file's name.

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
            loaded = load(FILE)
            each_of = (*loaded.warnings, *check_plan(loaded.manifest, files=loaded.files))
        except ManifestError as error:
            each_of = error.diagnostics
        return [f"{each.rule} {each}".replace(f"{FILE}:", "") for each in each_of]

    return find
