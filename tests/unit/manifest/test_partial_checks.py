"""A mistake in one place: nothing is said that is not wrong, and nothing is missed elsewhere."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from lifecycle.manifest import ManifestError, Severity, load
from lifecycle.manifest.checks.system import SEPARABLE
from tests.unit.manifest.test_corpus import pairs

REPOSITORY = Path(__file__).parents[3]
VALID = REPOSITORY / "tests" / "corpus" / "valid"
# Not those about YAML itself, which PyYAML reads by other rules than ours.
DOCUMENTS = [each for each in sorted(VALID.glob("*.lifecycle.yaml")) if "yaml_" not in each.name]
MANIFESTS = sorted((REPOSITORY / "manifests").glob("*.lifecycle.yaml"))
COLOUR = "nothing_like_a_key"


def _mistakes(document: Any) -> Iterator[tuple[str, Any]]:
    """Yield copies of a document with one unknown key each, and where it is."""
    places: list[tuple[str | int, ...]] = [()]
    for section in ("discovery", "network", "data_layer", "policy"):
        places += [(section,)] if isinstance(document.get(section), dict) else []
    places += [("machines", name) for name in document.get("machines", {})]
    places += [("links", index) for index in range(len(document.get("links", ())))]
    for key, node in document.get("nodes", {}).items():
        places.append(("nodes", key))
        places += [
            ("nodes", key, part) for part in (*SEPARABLE, "interface") if _closed(node.get(part))
        ]
    for place in places:
        changed = copy.deepcopy(document)
        target = changed
        for step in place:
            target = target[step]
        target[COLOUR] = 1
        yield ".".join(map(str, place)), changed
    yield "include", {**document, "include": [{"manifest": f"{COLOUR}.lifecycle.yaml"}]}


def _closed(part: object) -> bool:
    """Whether a part of a node is a mapping; parameters take any key, so nothing is wrong there."""
    return isinstance(part, dict) and not {*part} - {
        "python", "command", "package", "executable", "environment", "working_directory",
        "publishers", "subscriptions", "service_servers", "service_clients", "parameters",
        "action_servers", "action_clients", "start_s", "configure_s", "connect_s", "activate_s",
    }  # fmt: skip


@pytest.mark.parametrize("path", [*DOCUMENTS, *MANIFESTS], ids=lambda path: path.name.split(".")[0])
def test_one_mistake_in_a_sound_manifest_makes_nothing_else_wrong(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "folder"
    shutil.copytree(path.parent, folder)
    monkeypatch.chdir(folder)
    text = path.read_text(encoding="utf-8")
    arguments = pairs(text, "corpus-arguments", ":=")
    for name, value in pairs(text, "corpus-environment", "=").items():
        monkeypatch.setenv(name, value)
    document = yaml.safe_load(text)
    known = {each.at.path for each in load(path.name, arguments).warnings}
    known |= {each.message for each in load(path.name, arguments).warnings}
    for where, changed in _mistakes(document):
        (folder / path.name).write_text(yaml.safe_dump(changed, sort_keys=False), encoding="utf-8")
        with pytest.raises(ManifestError) as caught:
            load(path.name, arguments)
        found = caught.value.diagnostics
        errors = [str(each) for each in found if each.severity is Severity.ERROR]
        assert all(COLOUR in each for each in errors), (where, errors)
        warnings = [each for each in found if each.severity is Severity.WARNING]
        # Some are said once for many places, at the first; that one may have gone.
        assert all({each.at.path, each.message} & known for each in warnings), (where, warnings)
