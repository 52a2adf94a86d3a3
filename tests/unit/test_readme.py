"""The README shows files as they are, and links that lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SHOWN = re.findall(r"<!-- file: (\S+) -->\n```\w+\n(.*?)```", README, flags=re.DOTALL)


def test_the_readme_shows_a_node_and_its_manifest() -> None:
    assert [name for name, _ in SHOWN] == [
        "examples/first_node/nodes.py",
        "manifests/first_node.lifecycle.yaml",
    ]


@pytest.mark.parametrize(("name", "text"), SHOWN)
def test_a_file_in_the_readme_is_the_file_in_the_tree(name: str, text: str) -> None:
    assert text == (ROOT / name).read_text(encoding="utf-8")


@pytest.mark.parametrize("target", re.findall(r"\]\(([^)#:]+)\)", README))
def test_a_link_of_the_readme_leads_to_a_file(target: str) -> None:
    assert (ROOT / target).exists()
