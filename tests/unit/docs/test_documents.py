"""The documents: every page is on the site, links lead somewhere, keys and events are explained."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from lifecycle.manifest.loading import load
from lifecycle.supervisor.run import events
from lifecycle.verify.rules import RULES
from tests import keys_page

ROOT = Path(__file__).parents[3]
PAGES = sorted((ROOT / "docs").glob("*.md"))
ARTICLES = sorted((ROOT / "tests/articles").glob("*.md"))
ROOTS = [ROOT / f"{name}.md" for name in ("README", "ARCHITECTURE", "CONTRIBUTING")]
DOCUMENTS = [*ROOTS, *PAGES, *ARTICLES]
SITE = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
each_document = pytest.mark.parametrize("document", DOCUMENTS, ids=lambda each: each.name)


def read(path: Path) -> str:
    return path.read_text(encoding="utf-8")


README = read(ROOT / "README.md")


def prose(path: Path) -> str:
    """A document without blocks of code, line by line."""
    text = re.sub(r"^ *```.*?^ *```$", _blank, read(path), flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"^ {4}.*$", "", text, flags=re.MULTILINE)


def _blank(match: re.Match[str]) -> str:
    return "\n" * match[0].count("\n")


def anchors(path: Path) -> set[str]:
    """Anchors of the headings, as the forge and the site make them."""
    titles = re.findall(r"^#+ (.+)$", prose(path), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title).strip().lower().replace(" ", "-") for title in titles}


def in_nav(entry: object) -> Iterator[str]:
    if isinstance(entry, str):
        yield entry
    elif isinstance(entry, dict):
        for value in entry.values():
            yield from in_nav(value)
    elif isinstance(entry, list):
        for value in entry:
            yield from in_nav(value)


def test_every_document_is_once_in_the_nav_of_the_site() -> None:
    nav = list(in_nav(SITE["nav"]))
    pages = [f"docs/{page.name}" for page in PAGES]
    roots = ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md"]
    assert sorted(nav) == sorted([*roots, *pages, "examples/teleop/README.md"])


def test_what_the_site_is_built_from_is_what_is_read_on_the_forge() -> None:
    folder = ROOT / SITE["docs_dir"]
    assert {each.name: each.resolve() for each in folder.iterdir()} == {
        each.name: (ROOT / each.name).resolve() for each in folder.iterdir()
    }


@each_document
def test_a_link_between_documents_leads_to_a_file_and_a_heading(document: Path) -> None:
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(document)):
        if re.match(r"\w+:", target):
            continue
        name, _, anchor = target.partition("#")
        file = (document.parent / name).resolve() if name else document
        if not file.is_file() or (anchor and anchor not in anchors(file)):
            broken.append(target)
    assert broken == []


NAMED = sorted(
    set(
        re.findall(
            r"`((?:tests|lifecycle|benchmarks|manifests|examples)/[\w./-]+)(?:::(\w+))?`",
            "\n".join(read(each) for each in DOCUMENTS),
        )
    )
)


@pytest.mark.parametrize(("path", "test"), NAMED)
def test_a_file_that_is_named_is_there_and_has_the_test_that_is_named(path: str, test: str) -> None:
    file = ROOT / path
    assert file.exists()
    if test:
        assert re.search(rf"^(?:async )?def {test}\(", read(file), re.MULTILINE)


@pytest.mark.parametrize(
    ("name", "text"), re.findall(r"<!-- file: (\S+) -->\n```\w+\n(.*?)```", README, re.DOTALL)
)
def test_a_file_that_the_readme_shows_is_the_file_in_the_tree(name: str, text: str) -> None:
    assert text == read(ROOT / name)


@each_page
def test_a_page_starts_with_what_its_reader_can_do_afterwards(page: Path) -> None:
    title, first = read(page).split("\n\n")[:2]
    assert re.fullmatch(r"# \S.*", title)
    assert re.fullmatch(r"After reading this page you can [^.]+(?:\.\w+[^.]*)*\.", first, re.DOTALL)


IDIOM = re.compile(
    r"\b(tells?|told|telling|hears?|heard|hearing|stands?|stood|standing|somebody|nobody|whoever"
    r"|words?|voices?|ears?|eyes?|hands)\b",
    re.IGNORECASE,
)


@each_document
def test_a_document_uses_the_field_s_terms(document: Path) -> None:
    text = re.sub(r"`[^`]*`|“[^”]*”", _blank, prose(document))
    for rule in RULES:  # quoted as the program prints them
        text = text.replace(f"\n{rule.meaning[0].upper()}{rule.meaning[1:]}.\n", "\n\n")
    found = [
        f"{document.name}:{number}: {match[0]}"
        for number, line in enumerate(text.splitlines(), 1)
        for match in IDIOM.finditer(line)
    ]
    assert found == [], "say it in the field's terms (notified, receives, is, another, name, …)"


def test_the_book_can_be_read() -> None:
    reference = {"keys.md", "rules.md", "events.md", "api.md"}
    book = [page for page in PAGES if page.name not in reference]
    assert sum(len(read(page).split()) for page in book) <= 25_000
    assert len(README.split()) <= 1_200


def test_the_architecture_fits_two_pages_and_names_folders_that_are_there() -> None:
    lines = read(ROOT / "ARCHITECTURE.md").splitlines()
    assert len(lines) <= 155
    assert [line for line in lines if len(line) > 100] == []


@pytest.mark.parametrize("name", ["ARCHITECTURE.md", "docs/decisions.md"])
def test_a_folder_that_is_named_is_there(name: str) -> None:
    named = re.findall(r"`([a-z_]+(?:/[a-z_]+)*/)`", read(ROOT / name))
    assert named
    missing = {each for each in named if not (ROOT / each).is_dir()}
    assert {each for each in missing if not (ROOT / "lifecycle" / each).is_dir()} == set()


def test_the_page_of_keys_is_made_from_the_schema_of_a_manifest() -> None:
    schema = json.loads(read(ROOT / "schemas/manifest.v1.schema.json"))
    assert read(keys_page.PAGE) == keys_page.page(schema), "make schemas"


def blocks(page: str, language: str) -> list[str]:
    found = re.findall(rf"^```{language}\n(.*?)^```$", read(ROOT / page), re.DOTALL | re.MULTILINE)
    return [str(each) for each in found]


def test_the_first_manifest_of_its_page_is_valid(tmp_path: Path) -> None:
    path = tmp_path / "patrol.lifecycle.yaml"
    path.write_text(blocks("docs/manifest.md", "yaml")[0], encoding="utf-8")
    loaded = load(path)
    assert loaded.warnings == ()
    assert [node.key for node in loaded.manifest.nodes] == ["camera", "viewer"]


def test_the_manifest_of_the_page_of_flows_is_valid(tmp_path: Path) -> None:
    (manifest,) = blocks("docs/flows.md", "yaml")
    path = tmp_path / "asks.lifecycle.yaml"
    path.write_text(manifest, encoding="utf-8")
    # The one warning is what the page explains: the video's frames do not fit a datagram.
    warnings = load(path, environment={}).warnings
    assert {each.rule for each in warnings} == {"check.flow-fragments"}


def test_the_examples_of_the_manifest_s_page_are_valid(tmp_path: Path) -> None:
    named = {}
    for block in blocks("docs/manifest.md", "yaml")[1:]:
        name = block.partition("\n")[0].removeprefix("# ")
        named[name] = tmp_path / name
        named[name].write_text(block, encoding="utf-8")
    (tmp_path / "config").mkdir()
    for name in ("all", "camera"):
        (tmp_path / f"config/{name}.yaml").write_text("/**: {ros__parameters: {rate: 15.0}}\n")

    arms = load(named["two_arms.lifecycle.yaml"])
    assert arms.warnings == ()
    assert [f"{each.namespace.rstrip('/')}/{each.name}" for each in arms.manifest.nodes] == [
        "/monitor",
        "/left/driver",
        "/left/controller",
        "/right/driver",
        "/right/controller",
    ]
    speeds = [dict(each.parameters).get("speed") for each in arms.manifest.nodes]
    assert speeds == [None, 0.5, None, 0.25, None]
    assert [each.topic for each in arms.manifest.links] == ["/left/joints", "/right/joints"]

    loaded = load(named["surroundings.lifecycle.yaml"])
    assert loaded.warnings == ()
    (camera,) = loaded.manifest.nodes
    assert dict(camera.run.environment) == {"CAMERA_SERIAL": "A1234", "OMP_NUM_THREADS": "2"}
    assert camera.run.working_directory == str(tmp_path / "calibration")
    assert dict(camera.parameters) == {"exposure.auto": False, "exposure.time_ms": 4.0}


def test_the_node_of_its_page_fits_its_manifest(tmp_path: Path) -> None:
    page = "docs/writing_a_node.md"
    node, alone = blocks(page, "python")
    (manifest,) = blocks(page, "yaml")
    (tmp_path / "bump_counter.py").write_text(f"{node}\n{alone}", encoding="utf-8")
    (tmp_path / "bumps.lifecycle.yaml").write_text(manifest, encoding="utf-8")
    check = [sys.executable, "-m", "lifecycle", "check", "--strict", "bumps.lifecycle.yaml"]
    result = subprocess.run(check, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.stdout == "bumps: 1 node, 3 endpoints, 0 links: ok\n"
    ruff = [sys.executable, "-m", "ruff", "check", "--isolated", "--select", "E9,F", "."]
    result = subprocess.run(ruff, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout


def test_the_page_of_events_has_every_event_with_its_fields() -> None:
    table = re.findall(r"^\| `(\w+)` \| ([^|]+) \|", read(ROOT / "docs/events.md"), re.MULTILINE)
    assert [(name, re.findall(r"`(\w+)`", fields)) for name, fields in table] == [
        (event.__struct_config__.tag, list(event.__struct_fields__))
        for event in events.Event.__subclasses__()
    ]


@pytest.mark.skipif(
    importlib.util.find_spec("mkdocs") is None
    or importlib.util.find_spec("mkdocstrings_handlers") is None,
    reason="needs the extra `docs`: make docs",
)
def test_the_site_is_built_without_a_warning_and_loads_nothing_from_elsewhere(
    tmp_path: Path,
) -> None:
    result = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", tmp_path],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (result.returncode, result.stdout + result.stderr) == (0, "")
    loaded = re.compile(r'<(?:script|link|img|iframe)\b[^>]*(?:src|href)="?https?:[^>]*>')
    for page in tmp_path.rglob("*.html"):
        assert loaded.findall(read(page)) == []
    api = read(tmp_path / "docs/api.html")
    for name in ("LifecycleNode.on_configure", "on_service", "graph.graph.Graph.verdict"):
        assert f'id="lifecycle.{name}"' in api


@each_document
def test_a_table_has_all_its_cells_and_a_page_its_end(document: Path) -> None:
    """What a merge left behind: a row that lost its start, a page that lost its last lines."""
    text = read(document)
    assert text.endswith("\n")
    assert not re.findall(r"^([^\s\w])\1{6}(?:\s|$)|^(\w)\2{5}", text, flags=re.MULTILINE)
    columns = 0
    for number, line in enumerate(prose(document).splitlines(), 1):
        cells = line.replace(r"\|", "").count("|") if line.lstrip(" ").startswith("|") else 0
        assert not (columns and line and not cells), f"{document.name}:{number}: no row: {line}"
        assert columns in (0, cells) or not cells, f"{document.name}:{number}: {line}"
        columns = cells
