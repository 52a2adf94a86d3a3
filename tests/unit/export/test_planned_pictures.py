"""The picture of a plan, in every language."""

from __future__ import annotations

import dataclasses
import itertools
import re
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.export.picture import (
    WRITERS,
    PicturedNodeState,
    Presence,
    picture_to_html,
    picture_to_mermaid,
    picture_to_svg,
    picture_to_text,
    planned_picture,
)
from lifecycle.export.picture.model import LineKind
from lifecycle.export.picture.views import LINE, computational, data_layer, place, text_width
from lifecycle.manifest import load
from lifecycle.manifest.model import Condition, Endpoint, EndpointKind, UniqueHow
from lifecycle.plan import Plan, build_plan
from tests.builders import endpoint, link, node, planned, publisher, subscription
from tests.unit.export.pictures import PUBLISHER, SUBSCRIPTION, TRIGGER, article

CLIENT, SERVER = EndpointKind.SERVICE_CLIENT, EndpointKind.SERVICE_SERVER
SVG = "{http://www.w3.org/2000/svg}"


def test_a_plan_is_drawn_as_declared_and_without_a_verdict() -> None:
    picture = planned_picture(article())
    assert (picture.title, picture.verdict, picture.findings) == (
        "system robot, domain 7",
        None,
        (),
    )
    ends = [end for line in picture.lines for end in (*line.sources, *line.targets)]
    drawn = [*picture.nodes(), *ends, *picture.flows]
    drawn += [arrow for line in picture.lines for arrow in line.arrows]
    drawn += [each for one in picture.nodes() for each in one.participants]
    assert {each.presence for each in drawn} == {Presence.PLANNED}
    assert {each.outcome for each in picture.flows} == {None}
    assert [each.state for each in picture.nodes()] == [
        PicturedNodeState.MANAGED,
        PicturedNodeState.MANAGED,
        PicturedNodeState.PLAIN,
        PicturedNodeState.MANAGED,
    ]


def test_a_flow_of_a_plan_says_what_is_asked_of_it_and_what_is_to_carry_it() -> None:
    picture = planned_picture(article())
    carriers = {each.id: each.name for one in picture.nodes() for each in one.participants}
    video = next(each for each in picture.flows if each.topic == "/video")
    assert (video.medium, video.dscp, video.unique, video.tuples) == (
        "udpv4",
        "EF = DSCP 46 = TOS 184 (0xb8)",
        "strongly unique",
        (),
    )
    assert video.demands == (
        "strongly unique demanded",
        "publisher unique strictly_required",
        "subscription unique strictly_required",
        "at most 5 ms",
    )
    assert carriers[video.publisher] == "_camera_flow_0"
    level = next(each for each in picture.flows if each.topic == "/level")
    assert (level.dscp, level.unique, level.demands) == ("", "", ())


def test_a_text_of_a_plan_has_no_word_on_what_runs() -> None:
    assert (
        picture_to_text(planned_picture(article()))
        == """\
system robot, domain 7

computational graph
  ▣ /camera   managed
  ▣ /battery  managed
  ◆ /base     not managed
  ▣ /viewer   managed
  topic /video  sensor_msgs/msg/Image
    /camera ──▶ /viewer
      /camera  (EF = DSCP 46 = TOS 184 (0xb8), unique strictly_required, by _camera_flow_0)
      /viewer  (unique strictly_required)
  topic /level  std_msgs/msg/String
    /battery ──▶ /viewer
  topic /odometry  std_msgs/msg/String
    /base ──▶ nobody
  service /reset  std_srvs/srv/Trigger
    /viewer ──▶ /base

data layer graph
  machine d1 (10.0.0.1)
    /camera  process n1
      own participant
      _camera_flow_0  unique publisher video marked EF = DSCP 46 = TOS 184 (0xb8)
    /battery  process n1
    /base  process base
  machine d2 (10.0.0.2)
    /viewer  process viewer
  flows
    /video  /camera ──▶ /viewer   udpv4 · EF  strongly unique demanded, publisher unique \
strictly_required, subscription unique strictly_required, at most 5 ms
    /level  /battery ──▶ /viewer  udpv4
"""
    )


def test_a_mermaid_picture_shows_machines_processes_nodes_and_what_is_asked_of_each_flow() -> None:
    assert (
        picture_to_mermaid(planned_picture(article()))
        == """\
---
title: "system robot, domain 7"
---
flowchart LR
  subgraph m0["machine d1 (10.0.0.1)"]
    subgraph m0p0["process n1"]
      n0["/camera<br/>#9635; managed<br/>_camera_flow_0: unique publisher video marked EF = \
DSCP 46 =<br/>TOS 184 (0xb8)"]:::managed
      n1["/battery<br/>#9635; managed"]:::managed
    end
    n3["/base<br/>#9670; not managed"]:::plain
  end
  subgraph m1["machine d2 (10.0.0.2)"]
    n2["/viewer<br/>#9635; managed"]:::managed
  end
  n0 ==>|"/video<br/>udpv4 #183; EF<br/>strongly unique demanded<br/>publisher unique \
strictly_required<br/>subscription unique strictly_required<br/>at most 5 ms<br/>by \
_camera_flow_0"| n2
  n1 -->|"/level<br/>udpv4"| n2
  n3 -->|"/odometry"| s2(( ))
  n2 -.->|"/reset"| n3
  classDef managed fill:#dbe6f3,color:#1b2733,stroke:#4d5a66
  classDef plain fill:#cfe8e0,color:#1b2733,stroke:#4d5a66
"""
    )


def test_an_svg_picture_says_everything_in_text() -> None:
    root = ET.fromstring(picture_to_svg(planned_picture(article())))
    said = [each.text for each in root.iter(f"{SVG}text")]
    for words in (
        "system robot, domain 7",
        "machine d1 (10.0.0.1)",
        "machine d2 (10.0.0.2)",
        "process n1",
        "/camera",
        "/battery",
        "/base",
        "◆ not managed",
        "/viewer",
        "▣ managed",
        "/video",
        "topic sensor_msgs/msg/Image",
        "/viewer: unique strictly_required",
        "/camera → /viewer",
        "asked for: strongly unique demanded, publisher unique",
        "/reset",
        "service std_srvs/srv/Trigger",
        "_camera_flow_0",
        "unique publisher video marked",
        "udpv4 · EF",
        "thick edge: a link demands a unique flow",
    ):
        assert words in said


def test_an_svg_picture_draws_every_flow_and_marks_those_that_a_link_demands() -> None:
    root = ET.fromstring(picture_to_svg(planned_picture(article())))
    rows = [each for each in root.iter(f"{SVG}g") if "flow" in each.get("class", "").split()]
    strokes = [
        each.get("class", "").split()
        for row in rows
        for each in row.iter(f"{SVG}path")
        if "stroke" in each.get("class", "").split()
    ]
    assert strokes == [["stroke", "planned", "o-none", "unique"], ["stroke", "planned", "o-none"]]


@pytest.mark.parametrize(
    ("ends", "words", "red"),
    [
        ((publisher("x"),), "nobody subscribes to it", True),
        ((subscription("x"),), "nobody publishes it", True),
        ((endpoint(SERVER, "x", TRIGGER),), "nobody calls it", False),
        ((endpoint(CLIENT, "x", TRIGGER),), "nobody serves it", False),
    ],
)
def test_who_is_missing_at_the_other_end_is_said_and_red_for_a_topic(
    ends: tuple[Endpoint, ...], words: str, *, red: bool
) -> None:
    root = ET.fromstring(picture_to_svg(planned_picture(planned(node("a", *ends)))))
    (row,) = (each for each in root.iter(f"{SVG}g") if "row" in each.get("class", "").split())
    (said,) = (each for each in row.iter(f"{SVG}text") if each.text == words)
    assert said.get("class") == "quiet alone"
    assert ({"topic", "planned"} <= set(row.get("class", "").split())) is red
    sheet = root.find(f"{SVG}style")
    assert sheet is not None
    assert ".lc-figure .topic.planned .alone{fill:#b3261e;" in (sheet.text or "")


def test_a_page_of_a_plan_has_no_findings_and_no_column_about_what_runs() -> None:
    page = picture_to_html(planned_picture(article()))
    heads = re.findall(r'<th scope="col">([^<]*)</th>', page)
    assert heads == [
        "node",
        "state",
        "machine",
        "process",
        "participants",
        "topic",
        "publisher → subscription",
        "medium",
        "DSCP",
        "unique",
        "asked for",
    ]
    assert '<a class="skip" href="#nodes">Skip to the nodes</a>' in page
    assert '<section id="nodes"' in page
    assert "verdict" not in re.sub(r"<style>.*?</style>", "", page, flags=re.DOTALL)


def test_the_urls_of_a_connection_stand_at_its_participant_and_break_between_options() -> None:
    manifest = load(
        Path(__file__).parents[3] / "manifests/statically_configured_nodes.lifecycle.yaml"
    )
    picture = planned_picture(build_plan(manifest.manifest, environment={}))
    placed = place(*data_layer(picture))
    # The own participant carries no flow here, and is shown because it is told how to connect.
    assert [(each.column.title, each.column.badge, each.notes) for each in placed.columns[:2]] == [
        (
            "/talker",
            "own participant",
            (
                "udpv4://127.0.0.1:8105?",
                "metatraffic_port=8104&",
                "output_port=8106&",
                "peer=127.0.0.1:8100&",
                "peer=127.0.0.1:8107&",
                "multicast=off",
            ),
        ),
        (
            "/talker",
            "data",
            (
                "connection data for 1 endpoint",
                "udpv4://127.0.0.1:8001?",
                "metatraffic_port=8000&",
                "output_port=8002&",
                "peer=127.0.0.1:8010&",
                "multicast=off",
            ),
        ),
    ]


def test_what_a_node_waits_for_stands_at_it() -> None:
    plan = planned(node("lidar"), node("base", after=(("lidar", Condition.ACTIVE),)))
    lidar, base = planned_picture(plan).nodes()
    assert (lidar.notes, base.notes) == ((), ("after lidar active",))


def test_a_node_that_hears_itself_is_one_flow() -> None:
    picture = planned_picture(planned(node("echo", publisher("x"), subscription("x"))))
    (line,) = picture.lines
    assert (line.kind, len(line.arrows), line.alone) == (LineKind.TOPIC, 1, ())
    assert "n0 -->|" in picture_to_mermaid(picture)


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_an_empty_system_has_a_picture(write) -> None:
    assert "system robot" in re.sub("</?h1>", "system ", write(planned_picture(planned())))


def plans() -> st.SearchStrategy[Plan]:
    """Small systems over a few topics, with names that no validation let through."""
    text = st.text(min_size=1, max_size=12)
    ends = st.lists(
        st.tuples(st.sampled_from((PUBLISHER, SUBSCRIPTION)), st.sampled_from("abc")),
        max_size=4,
        unique=True,
    )
    nodes = st.lists(
        st.tuples(ends, st.sampled_from(("", "robot", "operator")), st.sampled_from(("", "p"))),
        max_size=5,
    )
    return st.builds(
        lambda parts, type_, system: dataclasses.replace(
            planned(
                *(
                    node(
                        f"n{i}",
                        *(endpoint(kind, name, type_) for kind, name in each),
                        machine=machine,
                        process=f"{process}{machine}" if process else "",
                    )
                    for i, (each, machine, process) in enumerate(parts)
                )
            ),
            system=system,
        ),
        nodes,
        text,
        text,
    )


@given(plan=plans())
def test_an_svg_is_well_formed_whatever_the_names_are(plan: Plan) -> None:
    picture = planned_picture(plan)
    root = ET.fromstring(picture_to_svg(picture))
    names = {each.text for each in root.iter(f"{SVG}text")}
    assert {each.name for each in picture.nodes()} <= names


@given(plan=plans())
def test_nothing_in_an_svg_overlaps_or_leaves_its_place(plan: Plan) -> None:
    picture = planned_picture(plan)
    for view in (computational(picture), data_layer(picture)):
        placed = place(*view)
        ends = 0
        for column in placed.columns:
            assert column.x >= ends
            ends = column.x + column.width
            assert text_width(column.column.title) <= (
                column.height if placed.upright else column.width
            )
        assert ends <= placed.width
        bottom = 0
        for row in placed.rows:
            assert row.y >= bottom
            bottom = row.y + row.height
            assert row.y + 26 + (LINE - 1) * len(row.notes) <= bottom
            if placed.columns:
                assert text_width(row.row.title) < placed.columns[0].x
        assert bottom <= placed.height
        for frames in (placed.machines, placed.processes):
            assert all(a.x + a.width <= b.x for a, b in itertools.pairwise(frames))


@given(plan=plans())
def test_mermaid_quotes_what_it_is_given(plan: Plan) -> None:
    picture = planned_picture(plan)
    body = picture_to_mermaid(picture).split("---\n", maxsplit=2)[2]
    outside = re.sub(r'"[^"\n]*"', "", body)
    assert '"' not in outside
    assert outside.count("subgraph") == len(re.findall(r"^ *end$", outside, re.MULTILINE))


@pytest.mark.parametrize("unique", [UniqueHow.WEAKLY, UniqueHow.STRONGLY])
def test_both_demands_of_a_link_are_told_apart_in_words(unique: UniqueHow) -> None:
    plan = planned(
        node("a", publisher("x")),
        node("b", subscription("x")),
        links=(link("/x", "a", "b", unique=unique),),
    )
    edge = f'n0 ==>|"/x<br/>shm<br/>{unique.value} unique demanded"| n1'
    assert edge in picture_to_mermaid(planned_picture(plan))
