"""What runs beside what was declared, drawn in every language."""

from __future__ import annotations

import dataclasses
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

from lifecycle.codec import from_json, to_json
from lifecycle.export.picture import (
    WRITERS,
    Picture,
    PicturedNodeState,
    Presence,
    Supervised,
    build_picture,
    picture_to_html,
    picture_to_mermaid,
    picture_to_svg,
    picture_to_text,
    planned_picture,
)
from lifecycle.export.picture import model as picture_model
from lifecycle.export.picture.model import LINES, OUTCOMES, STATES, LineKind
from lifecycle.export.picture.views import computational, data_layer, place
from lifecycle.plan import build_plan
from lifecycle.verify import Outcome, Stage, verify
from lifecycle.verify.observation import Observation, ObservedEndpoint, ObservedNode
from lifecycle.verify.verdict import Finding
from tests.builders import STRING, node, planned, publisher, subscription, teleop
from tests.unit.export.pictures import PUBLISHER, article, drawn, large, small
from tests.unit.verify.perfect import perfect

SCHEMA = json.loads(
    (Path(__file__).parents[3] / "schemas" / "graph.v1.schema.json").read_text(encoding="utf-8")
)
SVG = "{http://www.w3.org/2000/svg}"
PICTURES = {"plan": planned_picture(article()), "small": small(), "large": large()}
VOID = {"meta", "br", "input", "link", "img", "hr"}


class Page(HTMLParser):
    """Reads a page strictly: every element is closed in order, every id is its own."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[tuple[str, str]] = []
        self.feed(text)
        self.close()
        assert self.open == []
        ids = [attributes["id"] for _, attributes in self.elements if "id" in attributes]
        assert len(ids) == len(set(ids))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append((self.open[-1] if self.open else "", data))

    def of(self, tag: str, class_: str = "") -> list[dict[str, str | None]]:
        return [
            attributes
            for name, attributes in self.elements
            if name == tag and (not class_ or class_ in (attributes.get("class") or "").split())
        ]

    def words(self, *tags: str) -> str:
        return " ".join(text for tag, text in self.texts if not tags or tag in tags)


def classes(svg: str) -> list[set[str]]:
    return [set((each.get("class") or "").split()) for each in ET.fromstring(svg).iter()]


def test_a_text_names_what_is_missing_and_what_is_not_declared() -> None:
    text = picture_to_text(small())
    lines = text.splitlines()
    assert lines[0] == "system robot, domain 7: verdict violated"
    assert lines[3:6] == [
        "  ● /robot/camera  active       pid 1000",
        "  ∅ /viewer        not there              declared, but missing ⚠1",
        "  ◆ /intruder      not managed            there, but not declared ⚠2",
    ]
    assert "    /robot/camera ╌╌▷ /viewer  (declared, but missing, violated)" in lines
    assert "    /robot/camera ··▶ /intruder  (there, but not declared)" in lines
    assert (
        "  ⚠2 ✗ violated graph.undeclared-node: cannot allow node /intruder: the manifest does not "
        "declare it"
    ) in lines


def test_a_system_as_declared_has_every_flow_with_its_tuple_medium_dscp_and_uniqueness() -> None:
    plan = build_plan(teleop(), environment={})
    picture = drawn(plan, perfect(plan, Stage.ACTIVE))
    assert (picture.verdict, picture.findings) == (Outcome.OK, ())
    assert {each.presence for each in picture.nodes()} == {Presence.PRESENT}
    video = next(each for each in picture.flows if each.topic == "/robot/video")
    assert (video.unique, video.dscp) == ("strongly unique", "EF = DSCP 46 = TOS 184 (0xb8)")
    assert re.fullmatch(r"udp [\d.]+:\d+ → [\d.]+:\d+", video.tuples[0])
    carriers = {each.id: each.name for n in picture.nodes() for each in n.participants}
    assert carriers[video.publisher] == "_camera_flow_0"
    assert carriers[video.subscription] == "own participant"
    text = picture_to_text(picture)
    assert f"{video.medium} · EF · strongly unique" in text
    assert video.tuples[0] in text


@pytest.mark.parametrize(
    ("supervised", "state"),
    [
        (Supervised(dead=True), PicturedNodeState.DEAD),
        (Supervised(silent=True), PicturedNodeState.SILENT),
        (Supervised(), PicturedNodeState.ACTIVE),
    ],
)
def test_a_supervisor_adds_who_is_dead_or_silent(
    supervised: Supervised, state: PicturedNodeState
) -> None:
    plan = planned(node("a", publisher("x")), node("b", subscription("x")))
    picture = drawn(plan, perfect(plan, Stage.ACTIVE), supervised={"/a": supervised})
    assert picture.nodes()[0].state is state


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
def test_every_state_of_a_node_has_a_look(
    told: str | None, managed: bool | None, state: PicturedNodeState
) -> None:
    plan = planned(node("a", publisher("x")))
    seen = perfect(plan, Stage.ACTIVE)
    configurations = tuple(
        dataclasses.replace(each, state=told, connected=True)
        for each in seen.configurations
        if told
    )
    nodes = (ObservedNode(full_name="/a", state=told, managed=managed),)
    picture = drawn(plan, dataclasses.replace(seen, nodes=nodes, configurations=configurations))
    assert picture.nodes()[0].state is state
    assert f"{STATES[state].symbol} {state.value}" in picture_to_svg(picture)


@pytest.mark.parametrize(
    ("of_the_flow", "of_the_pair", "drawn_as"),
    [
        (Outcome.OK, Outcome.UNVERIFIABLE, Outcome.UNVERIFIABLE),
        (Outcome.UNVERIFIABLE, Outcome.VIOLATED, Outcome.VIOLATED),
        (Outcome.VIOLATED, Outcome.UNVERIFIABLE, Outcome.VIOLATED),
    ],
)
def test_an_arrow_is_as_bad_as_the_worst_that_is_found_on_it(
    of_the_flow: Outcome, of_the_pair: Outcome, drawn_as: Outcome
) -> None:
    plan = planned(node("a", publisher("x")), node("b", subscription("x")))
    seen = perfect(plan, Stage.ACTIVE)
    verdict = verify(plan, seen, stage=Stage.ACTIVE)
    finding = Finding(
        rule="graph.qos-incompatible",
        outcome=of_the_pair,
        subject="/x: /a → /b",
        expected="",
        observed="",
        message="",
    )
    picture = build_picture(
        plan,
        seen,
        dataclasses.replace(
            verdict,
            findings=(finding,),
            flows=tuple(dataclasses.replace(each, outcome=of_the_flow) for each in verdict.flows),
        ),
    )
    assert [each.outcome for line in picture.lines for each in line.arrows] == [drawn_as]


def test_states_differ_by_colour_and_by_symbol() -> None:
    for looks in (STATES, OUTCOMES):
        assert len({each.symbol for each in looks.values()}) == len(looks)
        assert len({each.fill for each in looks.values()}) == len(looks)


@pytest.mark.parametrize("look", [*STATES.values(), *OUTCOMES.values()])
def test_words_on_a_colour_are_readable(look) -> None:
    """At least 3:1, WCAG 2.2 §1.4.11 for what is no running text; the word stands beside it too."""

    def luminance(colour: str) -> float:
        parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [p / 12.92 if p <= 0.03928 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    light, dark = sorted((luminance(look.fill), luminance(look.ink)), reverse=True)
    assert (light + 0.05) / (dark + 0.05) >= 3


def test_an_svg_shows_missing_dashed_and_undeclared_dotted() -> None:
    svg = picture_to_svg(small())
    found = classes(svg)
    for presence in (Presence.PRESENT, Presence.MISSING, Presence.UNDECLARED):
        assert any({"box", "node", presence.value} <= each for each in found)
    assert any({"stroke", "missing"} <= each for each in found)
    assert any({"stroke", "undeclared"} <= each for each in found)
    sheet = ET.fromstring(svg).find(f"{SVG}style")
    assert sheet is not None
    assert sheet.text is not None
    assert f".missing.box,.lc-figure .missing.stroke{{stroke:{LINES[Presence.MISSING]};" in (
        sheet.text
    )
    words = [each.text for each in ET.fromstring(svg).iter(f"{SVG}text")]
    assert "∅ not there: missing" in words
    assert "missing" in words
    assert "not declared" in words
    assert "Computational graph" in words
    assert "Data layer graph" in words


def test_thirty_nodes_stand_upright_and_nothing_overlaps() -> None:
    for view in (computational(large()), data_layer(large())):
        placed = place(*view)
        assert placed.upright
        edges = sorted((each.x, each.x + each.width) for each in placed.columns)
        assert all(end <= start for (_, end), (start, _) in itertools.pairwise(edges))
        rows = [(each.y, each.y + each.height) for each in placed.rows]
        assert all(end <= start for (_, end), (start, _) in itertools.pairwise(rows))
        assert all(each.y < each.centre < each.y + each.height for each in placed.rows)
    assert place(*computational(large())).width < 2200


def test_a_page_is_whole_by_itself_and_well_formed() -> None:
    text = picture_to_html(small())
    page = Page(text)
    assert text.startswith("<!DOCTYPE html>\n")
    assert page.of("html") == [{"lang": "en"}]
    assert next(each.get("charset") for each in page.of("meta")) == "utf-8"
    policy = next(each for each in page.of("meta") if "http-equiv" in each)
    assert policy["content"] == (
        "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
    )
    for tag, attributes in page.elements:
        assert tag not in ("link", "img", "iframe", "object")
        assert "src" not in attributes
        assert (attributes.get("href") or "#").startswith("#")
    assert len(page.of("svg")) == 3
    assert [each["aria-label"] for each in page.of("svg")] == [
        "Computational graph",
        "Data layer graph",
        "Legend",
    ]
    assert page.words("h2") == ("Computational graph Data layer graph Legend Findings Nodes Flows")
    assert len(page.of("table")) == 3
    assert all(each["scope"] in ("col", "row") for each in page.of("th"))
    targets = {attributes.get("id") for _, attributes in page.elements}
    assert {(each["href"] or "")[1:] for each in page.of("a")} <= targets
    labels = {each.get("for") for each in page.of("label")}
    assert {each["id"] for each in page.of("input")} == labels


def test_a_page_says_everything_without_its_script() -> None:
    page = Page(picture_to_html(small()))
    assert len(page.of("g", "row")) == 9
    assert len(page.of("span", "p-missing")) == 4
    assert len(page.of("span", "p-undeclared")) == 2
    assert "cannot find node /viewer in domain 7" in page.words("td")
    assert page.words("strong") == "✗ verdict violated"


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
        assert len(page.of("script")) == 1
        assert len(page.of("style")) == 1
        assert page.of("b") == []
        assert 'alert("x")' in page.words("code")
    elif write is picture_to_svg:
        root = ET.fromstring(text)
        assert list(root.iter(f"{SVG}script")) == []
        assert any('alert("x")' in (each.text or "") for each in root.iter(f"{SVG}text"))
    elif write is picture_to_mermaid:
        assert "<script" not in text


def test_mermaid_marks_each_node_and_edge() -> None:
    lines = picture_to_mermaid(small()).splitlines()
    assert '    n1["/viewer<br/>#8709; not there<br/>declared, but missing<br/>#9888;1"]' in (
        line.partition(":::")[0] for line in lines
    )
    edges = [line for line in lines if re.match(r"  \w+ -\.?->", line)]
    assert "  linkStyle 0 stroke:#b3261e,stroke-dasharray:7 5" in lines
    assert len(edges) == 6
    used = {line.partition(":::")[2] for line in lines if ":::" in line}
    defined = {line.split()[1] for line in lines if line.startswith("  classDef")}
    assert used == defined


@pytest.mark.parametrize("picture", PICTURES.values(), ids=PICTURES)
def test_a_picture_survives_json(picture: Picture) -> None:
    assert from_json(to_json(picture), Picture) == picture
    assert json.loads(to_json(picture))["system"] == picture.system


@pytest.mark.parametrize("picture", PICTURES.values(), ids=PICTURES)
def test_a_picture_fits_its_schema_and_one_with_an_unknown_key_does_not(picture: Picture) -> None:
    validator = jsonschema.Draft202012Validator(SCHEMA)
    document = json.loads(to_json(picture))
    validator.validate(document)
    with pytest.raises(jsonschema.ValidationError):
        validator.validate({**document, "colour": "red"})


def test_the_schema_names_exactly_the_fields_and_the_values_of_a_picture() -> None:
    enums = {each.__name__: each for each in (Presence, PicturedNodeState, Outcome, LineKind)}
    for name, definition in {**SCHEMA["$defs"], "Picture": SCHEMA}.items():
        if name in enums:
            assert definition["enum"] == [each.value for each in enums[name]]
        else:
            fields = [each.name for each in dataclasses.fields(getattr(picture_model, name))]
            assert list(definition["properties"]) == definition["required"] == fields
            assert definition["additionalProperties"] is False


def test_the_same_facts_in_another_order_are_the_same_picture() -> None:
    plan = build_plan(teleop(), environment={})
    seen = perfect(plan, Stage.ACTIVE)
    mixed = Observation(
        nodes=seen.nodes[::-1],
        endpoints=seen.endpoints[::-1],
        configurations=seen.configurations[::-1],
    )
    assert drawn(plan, mixed) == drawn(plan, seen)


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
    assert '<p class="filter"><label' in run.stdout
    assert run.stdout.count('class="column"') == 31 + 31
