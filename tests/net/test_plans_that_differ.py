"""Two hosts that were given different manifests: neither activates, and both say so."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from lifecycle.errors import ExitCode
from tests.net.hosts import Host
from tests.net.running import article, up_on, up_on_both
from tests.ros.supervisor.running import Event, Up

RULE = "run.plans-differ"
_SOURCE = "tests.net.systems:Source"


def write(directory: Path, pair: tuple[Host, Host], edit: Mapping[str, Any]) -> Path:
    directory.mkdir()
    arguments = {
        "arguments": {"level": {"default": "info", "description": "of the talker's log"}},
        "nodes/n1/log_level": "$(arg level)",
    }
    return article(directory, pair[0].ipv4, pair[1].ipv4, edit={**arguments, **edit})


def differing(up: Up) -> Event:
    """Return the finding that the two plans differ."""
    verdict = up.until_found(RULE)
    return next(dict(each) for each in verdict["findings"] if each["rule"] == RULE)


def activated(up: Up) -> bool:
    return "activate" in {each["operation"] for each in up.of_kind("request")}


@pytest.mark.parametrize(
    ("first", "edit", "options"),
    [
        pytest.param(
            first,
            {"nodes/n3": {"run": {"python": _SOURCE}, "machine": "a"}},
            (),
            id=f"one node more on the other's machine, {first} first",
        )
        for first in "ab"
    ]
    + [
        pytest.param(first, {"system": "other"}, (), id=f"another name, {first} first")
        for first in "ab"
    ]
    + [
        pytest.param(
            "a",
            {"nodes/n1/flows": {"publishers": {"video": {"unique": "strictly_required"}}}},
            (),
            id="another flow need",
        ),
        pytest.param(
            "b",
            {"nodes/n1/run": {"python": "examples.nine_systems.nodes:Talker"}},
            (),
            id="another run",
        ),
        pytest.param(
            "a",
            {},
            ("level:=debug",),
            id="another argument",
        ),
    ],
)
def test_neither_host_activates_and_both_say_that_their_plans_differ(
    pair: tuple[Host, Host],
    tmp_path: Path,
    first: str,
    edit: Mapping[str, Any],
    options: tuple[str, ...],
) -> None:
    starts = {
        "a": (pair[0], write(tmp_path / "A", pair, {}), ()),
        "b": (pair[1], write(tmp_path / "B", pair, edit), options),
    }
    order = sorted(starts, key=lambda machine: machine != first)
    ups: dict[str, Up] = {}
    with contextlib.ExitStack() as stack:
        for machine in order:
            host, manifest, said = starts[machine]
            ups[machine] = stack.enter_context(
                up_on(host, manifest, "--machine", machine, *said, runtime=tmp_path / machine)
            )
            if machine == first:
                ups[machine].until("run")
        here, there = differing(ups["a"]), differing(ups["b"])
        assert (here["expected"], here["observed"]) == (there["observed"], there["expected"])
        for each in (here, there):
            assert "lifecycle plan MANIFEST" in each["message"]
        assert "machine 'b'" in here["subject"]
        assert "machine 'a'" in there["subject"]
        assert {name: up.finish() for name, up in ups.items()} == {
            "a": ExitCode.VIOLATED,
            "b": ExitCode.VIOLATED,
        }
    assert not any(map(activated, ups.values()))
    for up in ups.values():
        assert RULE in {each["rule"] for each in up.verdict["findings"]}
        up.assert_nothing_left()


def test_a_host_started_again_with_another_manifest_is_noticed_by_one_that_is_active(
    pair: tuple[Host, Host], tmp_path: Path
) -> None:
    right = write(tmp_path / "A", pair, {})
    with up_on_both(*pair, right, runtime=tmp_path) as (up_a, up_b):
        for up in (up_a, up_b):
            up.until("system", reached="active")
        since = len(up_a.events)
        up_b.signal(signal.SIGTERM)
        assert up_b.finish() == ExitCode.OK
        gone = up_a.until_found("graph.missing-node", "/n2", since=since)
        (finding,) = (each for each in gone["findings"] if each["subject"] == "/n2")
        assert "machine 'b' was shut down by its supervisor" in finding["message"]
        assert finding["hint"].endswith("lifecycle up MANIFEST --machine b")
        left = up_a.met("connection", since=since, machine="b", established=False)
        assert left["left"] is True
        assert RULE not in {each["rule"] for each in gone["findings"]}

        wrong = write(tmp_path / "B", pair, {"nodes/n1/log_level": "warn"})
        with up_on(pair[1], wrong, "--machine", "b", runtime=tmp_path / "b") as again:
            differing(up_a)
            assert again.finish() == ExitCode.VIOLATED
            assert not activated(again)
        since = len(up_a.events)
        with up_on(pair[1], right, "--machine", "b", runtime=tmp_path / "b") as well:
            well.until("system", reached="active")
            up_a.until_verdict(lambda verdict: verdict["verdict"] == "ok", since=since)
