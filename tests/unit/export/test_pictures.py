"""What is declared, and what runs beside it, drawn in every language."""

from __future__ import annotations

import itertools
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree as ET

import jsonschema
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from lifecycle.codec import from_json, to_json
from lifecycle.export.picture import (
    STATES,
    Picture,
    PicturedNodeState,
    Presence,
    Supervised,
    build_picture,
)
from lifecycle.export.picture_writers import (
    OUTCOMES,
    WRITERS,
    picture_to_html,
    picture_to_mermaid,
    picture_to_svg,
    picture_to_text,
)
from lifecycle.manifest.model import Condition
from lifecycle.plan.build import build_plan
from lifecycle.verify.observation import Observation, ObservedEndpoint, ObservedNode
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Stage
from tests.builders import STRING, node, planned, publisher, subscription, teleop
from tests.unit.export.pictures import PUBLISHER, article, drawn, large, small
from tests.unit.verify.perfect import perfect

ROOT = Path(__file__).parents[3]
SCHEMA = json.loads((ROOT / "schemas" / "graph.v1.schema.json").read_text(encoding="utf-8"))
SVG = "{http://www.w3.org/2000/svg}"
PICTURES = {"plan": build_picture(article()), "small": small(), "large": large()}
EACH = pytest.mark.parametrize("picture", PICTURES.values(), ids=PICTURES)


class Page(HTMLParser):
    """Reads a page strictly: every element is closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in {"meta", "br", "input"}:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)

    def count(self, tag: str) -> int:
        return sum(name == tag for name, _ in self.elements)


def test_a_text_names_what_is_missing_and_what_is_not_declared() -> None:
    lines = picture_to_text(small()).splitlines()
    assert lines[0] == "system robot, domain 7: verdict violated"
    flat = [re.sub(r"  +", "  ", line) for line in lines]
    assert any(each.startswith("  ∅ /viewer  not there") for each in flat)
    assert any(each.endswith("there, but not declared, ⚠2") for each in flat)
    assert any(re.match(r"    /robot/camera ╌╌▷ /viewer  \(missing, .*violated", e) for e in lines)
    assert "    /robot/camera ··▶ /intruder  (undeclared)" in lines
    assert (
        "  ⚠2 ✗ violated graph.undeclared-node: the manifest does not declare node /intruder"
    ) in lines


def test_a_system_as_declared_has_every_flow_with_its_tuple_medium_dscp_and_uniqueness() -> None:
    plan = build_plan(teleop(), environment={})
    picture = drawn(plan, perfect(plan, Stage.ACTIVE))
    assert (picture.verdict, picture.findings) == (Outcome.OK, ())
    assert {each.presence for each in picture.nodes} == {Presence.PRESENT}
    (video,) = (each for each in picture.lines if each.name == "/robot/video")
    (flow,) = video.flows
    assert flow.label.endswith("· EF · strongly unique")
    assert flow.unique
    assert re.fullmatch(r"udp [\d.]+:\d+ → [\d.]+:\d+", flow.notes[0])
    assert flow.notes[0] in picture_to_text(picture)


def test_a_plan_says_what_is_asked_and_no_word_on_what_runs() -> None:
    picture = build_picture(article())
    assert (picture.title, picture.verdict) == ("system robot, domain 7", None)
    text = picture_to_text(picture)
    assert "/camera ──▶ /viewer  (udpv4 · EF, strongly unique demanded" in text
    assert "at most 5 ms" in text
    assert "    /base ──▶ nobody" in text
    for write in WRITERS.values():
        plain = re.sub(r"<style>.*?</style>", "", write(picture), flags=re.DOTALL)
        assert "verdict" not in plain


def test_what_a_node_waits_for_is_beside_it() -> None:
    plan = planned(node("lidar"), node("base", after=(("lidar", Condition.ACTIVE),)))
    assert [each.notes for each in build_picture(plan).nodes] == [(), ("after lidar active",)]


@pytest.mark.parametrize(
    ("supervised", "state"),
    [
        (Supervised(dead=True), PicturedNodeState.DEAD),
        (Supervised(silent=True), PicturedNodeState.SILENT),
        (Supervised(), PicturedNodeState.ACTIVE),
    ],
)
def test_a_supervisor_adds_which_nodes_are_dead_or_silent(
    supervised: Supervised, state: PicturedNodeState
) -> None:
    plan = planned(node("a", publisher("x")), node("b", subscription("x")))
    picture = drawn(plan, perfect(plan, Stage.ACTIVE), supervised={"/a": supervised})
    assert picture.nodes[0].state is state


@pytest.mark.parametrize(
    ("told", "managed", "state"),
    [
        ("inactive", True, PicturedNodeState.CONNECTED),
        ("unconfigured", True, PicturedNodeState.UNCONFIGURED),
        ("finalized", True, PicturedNodeState.FINALIZED),
        ("activating", True, PicturedNodeState.CHANGING),
        (None, False, PicturedNodeState.PLAIN),
        (None, True, PicturedNodeState.SILENT),
        (None, None, PicturedNodeState.UNKNOWN),
    ],
)
def test_every_state_of_a_node_is_drawn(
    told: str | None, managed: bool | None, state: PicturedNodeState
) -> None:
    plan = planned(node("a", publisher("x")))
    seen = perfect(plan, Stage.ACTIVE)
    configurations = tuple(
        replace(each, state=told, connected=True) for each in seen.configurations if told
    )
    nodes = (ObservedNode(full_name="/a", state=told, managed=managed),)
    picture = drawn(plan, replace(seen, nodes=nodes, configurations=configurations))
    assert picture.nodes[0].state is state
    assert f"{STATES[state].symbol} {state.value}" in picture_to_svg(picture)


def test_states_differ_by_colour_and_by_symbol() -> None:
    assert len({each.symbol for each in STATES.values()}) == len(STATES)
    assert len({each.fill for each in STATES.values()}) == len(STATES)
    assert len({*OUTCOMES.values()}) == len(OUTCOMES)


@EACH
def test_columns_do_not_overlap_and_every_node_and_row_is_drawn(picture: Picture) -> None:
    root = ET.fromstring(picture_to_svg(picture))
    boxes = [
        (float(each.get("x", "")), float(each.get("width", "")))
        for each in root.iter(f"{SVG}rect")
        if "box" in each.get("class", "").split()
    ]
    assert len(boxes) == len(picture.nodes)
    assert all(x + wide < following for (x, wide), (following, _) in itertools.pairwise(boxes))
    assert boxes[-1][0] + boxes[-1][1] < float(root.get("width", ""))
    rows = [each for each in root.iter(f"{SVG}g") if each.get("class") == "row"]
    assert len(rows) == len(picture.lines)
    drawn_as = {word for e in root.iter() for word in (e.get("class") or "").split()}
    assert {each.presence.value for each in picture.nodes} <= drawn_as


def test_a_page_is_whole_by_itself() -> None:
    page = Page(picture_to_html(small()))
    for tag, attributes in page.elements:
        assert tag not in ("link", "img", "iframe", "object", "a")
        assert "src" not in attributes
    policy = next(each for _, each in page.elements if "http-equiv" in each)
    assert policy["content"] == (
        "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
    )
    assert (page.count("svg"), page.count("table"), page.count("script")) == (1, 1, 1)
    assert any("there is no node /viewer in domain 7" in each for each in page.texts)


NASTY = '</style><script>alert("x")</script>&amp;\x1b[2J\n`|"]]>--><b>'


@pytest.fixture
def nasty() -> Picture:
    """A graph of foreign nodes whose names are as bad as bytes can be."""
    plan = planned(node("a", publisher("x")))
    seen = perfect(plan, Stage.ACTIVE)
    return drawn(
        plan,
        Observation(
            nodes=(*seen.nodes, ObservedNode(full_name=f"/{NASTY}", managed=False)),
            endpoints=(
                *seen.endpoints,
                ObservedEndpoint(kind=PUBLISHER, node=f"/{NASTY}", name=f"/t{NASTY}", type=NASTY),
                ObservedEndpoint(kind=PUBLISHER, node="", name="/x", type=STRING),
            ),
            configurations=seen.configurations,
        ),
    )


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_nothing_of_a_graph_is_taken_for_markup(
    nasty: Picture, write: Callable[[Picture], str]
) -> None:
    text = write(nasty)
    assert "\x1b" not in text
    if write is picture_to_html:
        page = Page(text)
        assert (page.count("script"), page.count("b")) == (1, 0)
    elif write is picture_to_svg:
        root = ET.fromstring(text)
        assert list(root.iter(f"{SVG}script")) == []
        assert any('alert("x")' in (each.text or "") for each in root.iter(f"{SVG}text"))
    elif write is picture_to_mermaid:
        assert "<script" not in text


@given(st.text(max_size=20), st.text(max_size=20))
def test_mermaid_quotes_what_it_is_given(system: str, name: str) -> None:
    picture = build_picture(article())
    nodes = (replace(picture.nodes[0], notes=(name,)), *picture.nodes[1:])
    text = picture_to_mermaid(replace(picture, system=system, nodes=nodes))
    outside = re.sub(r'"[^"\n]*"', "", text.split("---\n", maxsplit=2)[2])
    assert '"' not in outside
    assert outside.count("subgraph") == len(re.findall(r"^ *end$", outside, re.MULTILINE))


@EACH
def test_mermaid_defines_each_class_that_it_uses(picture: Picture) -> None:
    lines = picture_to_mermaid(picture).splitlines()
    used = {line.partition(":::")[2] for line in lines if ":::" in line}
    defined = {line.split()[1] for line in lines if line.startswith("  classDef")}
    assert used == defined


@EACH
def test_a_picture_survives_json_and_fits_its_schema(picture: Picture) -> None:
    assert from_json(to_json(picture), Picture) == picture
    validator = jsonschema.Draft202012Validator(SCHEMA)
    document = json.loads(to_json(picture))
    validator.validate(document)
    with pytest.raises(jsonschema.ValidationError):
        validator.validate({**document, "colour": "red"})


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_an_empty_system_has_a_picture(write: Callable[[Picture], str]) -> None:
    assert "robot" in write(build_picture(planned()))


def test_a_browser_draws_the_page(tmp_path: Path) -> None:
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium is installed")
    page = tmp_path / "graph.html"
    page.write_text(picture_to_html(large()))
    run = subprocess.run(
        [
            browser,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-quic",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            f"--user-data-dir={tmp_path}/c",
            "--dump-dom",
            page.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    # The script ran: it shows the filter that the page hides without it.
    assert '<p><label for="filter"' in run.stdout
    assert run.stdout.count('class="column"') == 31
