"""Is the system up and running, and if not, what is missing?"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from simulated import Reader, System, configuration

from lifecycle.graph import GraphState, Running
from lifecycle.manifest import load
from lifecycle.manifest.model import EndpointKind
from lifecycle.plan import build_plan
from lifecycle.verify import Outcome
from lifecycle.verify.observation import EndpointReport, NodeConfiguration

MANIFEST = Path(__file__).parents[3] / "manifests" / "first_node.lifecycle.yaml"
FLOW = "/chatter: /talker → /listener"


def node(name: str, kind: EndpointKind, state: str = "active", **options: Any) -> NodeConfiguration:
    report = EndpointReport(
        **{
            "kind": kind,
            "name": "chatter",
            "resolved": "/chatter",
            "mapped": True,
            "type": "std_msgs/msg/String",
            "matched": 1,
            **options,
        }
    )
    return dataclasses.replace(configuration(name, report), state=state)


def talker(**options: Any) -> NodeConfiguration:
    return node("/talker", EndpointKind.PUBLISHER, **options)


def listener(**options: Any) -> NodeConfiguration:
    return node("/listener", EndpointKind.SUBSCRIPTION, **options)


def state_of(*nodes: NodeConfiguration) -> GraphState:
    reader = Reader(System())
    for each in nodes:
        reader.state.put_configuration(each)
    return reader.state


@pytest.mark.parametrize(
    ("nodes", "missing", "unknown"),
    [
        ((talker(), listener()), (), ()),
        ((talker(),), ("/listener is not there",), ()),
        ((talker(state="inactive"), listener()), ("/talker is inactive, not active",), ()),
        ((talker(), listener(state="")), ("/listener is not managed, not active",), ()),
        (
            (dataclasses.replace(talker(), endpoints=()), listener()),
            ("/talker: publishers/chatter is not there",),
            (),
        ),
        (
            (talker(error="no participant"), listener()),
            ("/talker: publishers/chatter: no participant", f"{FLOW}: /talker: no participant"),
            (),
        ),
        (
            (talker(mapped=False), listener()),
            (
                "/talker: publishers/chatter is not mapped onto a connection",
                f"{FLOW}: /talker has not mapped it onto a connection",
            ),
            (),
        ),
        (
            (talker(matched=0), listener(matched=0)),
            (f"{FLOW}: the publisher matched 0 of 1, the subscription matched 0 of 1",),
            (),
        ),
        (
            (talker(matched=None), listener(matched=None)),
            (),
            (f"{FLOW}: neither end reports whom it is matched with",),
        ),
    ],
)
def test_what_is_missing_is_named(
    nodes: tuple[NodeConfiguration, ...], missing: tuple[str, ...], unknown: tuple[str, ...]
) -> None:
    plan = build_plan(load(MANIFEST, environment={}).manifest, environment={})
    outcome = Outcome.VIOLATED if missing else Outcome.UNVERIFIABLE if unknown else Outcome.OK
    answer = state_of(*nodes).is_up_and_running(plan)
    assert answer == Running(outcome=outcome, missing=missing, unknown=unknown)


def test_a_silent_node_and_one_of_which_only_the_name_is_known_are_named() -> None:
    plan = build_plan(load(MANIFEST, environment={}).manifest, environment={})
    state = state_of(talker(), listener())
    state.events.report_silent("/talker", "its process stopped")
    answer = state.is_up_and_running(plan)
    assert answer.missing == (
        "/talker is silent: its process stopped",
        f"{FLOW}: /talker is silent",
    )
    state = state_of(talker())
    state.events.report_seen("/listener")
    answer = state.is_up_and_running(plan)
    assert (answer.outcome, answer.missing) == (Outcome.UNVERIFIABLE, ())
    assert answer.unknown == (
        "the state of /listener is not known",
        "the endpoints of /listener are not known",
    )
