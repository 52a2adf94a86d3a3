"""docs/flows.md: its manifest is valid as it stands, every test and file that it names exists."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from lifecycle.manifest import load

ROOT = Path(__file__).parents[3]
GUIDE = ROOT / "docs/flows.md"
TEXT = GUIDE.read_text(encoding="utf-8")
NAMED = sorted(
    set(re.findall(r"`((?:tests|lifecycle|benchmarks|manifests)/[\w./-]+)(::\w+)?", TEXT))
)


def test_the_guide_s_manifest_is_valid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (yaml,) = re.findall(r"^```yaml\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(tmp_path)
    Path("guide.lifecycle.yaml").write_text(yaml, encoding="utf-8")
    loaded = load("guide.lifecycle.yaml", environment={})
    # The one warning is what the guide explains: the video's frames do not fit a datagram.
    assert {each.rule for each in loaded.warnings} == {"check.flow-fragments"}


def test_the_guide_names_tests() -> None:
    assert len([name for _, name in NAMED if name]) > 40


@pytest.mark.parametrize(("path", "name"), NAMED)
def test_what_the_guide_names_exists(path: str, name: str) -> None:
    file = ROOT / path
    assert file.exists()
    if name:
        source = file.read_text(encoding="utf-8")
        assert re.search(rf"^(?:async )?def {name[2:]}\(", source, re.MULTILINE)


@pytest.mark.parametrize("link", sorted(set(re.findall(r"\]\((\w+\.md)\)", TEXT))))
def test_pages_that_the_guide_links_to_exist(link: str) -> None:
    assert (GUIDE.parent / link).exists()
