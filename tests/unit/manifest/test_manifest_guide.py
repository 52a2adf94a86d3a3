"""docs/manifest.md shows a manifest that is valid as it stands."""

from __future__ import annotations

import re
from pathlib import Path

from lifecycle.manifest import load

GUIDE = Path(__file__).parents[3] / "docs/manifest.md"


def test_the_manifest_of_the_guide_loads_without_a_finding(tmp_path: Path) -> None:
    text = re.findall(r"```yaml\n(.*?)```", GUIDE.read_text(encoding="utf-8"), flags=re.DOTALL)[0]
    path = tmp_path / "patrol.lifecycle.yaml"
    path.write_text(text, encoding="utf-8")
    loaded = load(path)
    assert loaded.warnings == ()
    assert [node.key for node in loaded.manifest.nodes] == ["camera", "viewer"]
