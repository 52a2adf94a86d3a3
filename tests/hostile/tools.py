"""Nodes named as tools beside an active system: harmless to listen, violated to feed.

One system, one process that plays all tools. What listens is judged by the verdict that a node
which is no tool brings about, after it.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import random
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import yaml

from tests.hostile.attack import Attack, HostileClass, Place, Unhandled, check_text
from tests.ros.faults.system import healthy
from tests.ros.supervisor.running import ROOT, Up

TOOLS = (
    *("_ros2cli_4711", "launch_ros_4711", "rqt_robot_steering", "rviz", "rviz2", "rviz_4711"),
    *(
        "rosbag2_player",
        "rosbag2_recorder",
        "transform_listener_impl_4711",
        "_lifecycle_observer_1",
    ),
)
FEEDS = ("publish", "serve", "change_state")
HARMLESS = ("listen", "call")


class Players:
    """A process with nodes of any name that do one thing each."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.hostile.player"],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def do(self, *words: str) -> None:
        """Have a node made (`publish NAME`) or all unmade (`leave`), and wait until it is."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(" ".join(words) + "\n")
        self.process.stdin.flush()
        if self.process.stdout.readline() != "done\n":
            raise Unhandled(f"the player died at {words}")

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


class System:
    """The healthy pair under `up`, its verdicts, and what was found of each tool."""

    def __init__(self, place: Place) -> None:
        folder = place.folder()
        document = healthy()
        document["discovery"] = {"range": "localhost", "domain_id": place.domain}
        manifest = folder / "faults.lifecycle.yaml"
        manifest.write_text(yaml.safe_dump(document))
        os.environ["FAULT_MARKERS"] = str(folder / "markers")
        self.up = Up(manifest, runtime=folder)
        self.found: dict[tuple[str, str], list[Any]] = {}

    def verdict(self, holds: Callable[[list[Any]], bool]) -> list[Any]:
        """Return the findings of the first verdict from now on that is as wanted."""
        since = len(self.up.events)
        return list(
            self.up.until_verdict(lambda each: holds(each["findings"]), since=max(0, since - 1))[
                "findings"
            ]
        )


def names_in(findings: list[Any]) -> str:
    return json.dumps([(each["rule"], each["subject"], each["node"]) for each in findings])


@contextlib.contextmanager
def stage(place: Place, attacks: Sequence[Attack]) -> Iterator[System]:
    system = System(place)
    players = Players()
    try:
        system.up.until("system", reached="active")
        wanted = [tuple(each.name.split(" ")) for each in attacks]
        quiet = [each for each in wanted if each[0] in HARMLESS]
        for way, name in quiet:
            players.do(way, name)
        time.sleep(1.0)  # no event tells that somebody was seen and found harmless
        players.do("publish", "marker")
        findings = system.verdict(lambda found: "/marker" in names_in(found))
        system.found |= dict.fromkeys(quiet, findings)
        players.do("leave")
        system.verdict(lambda found: "/marker" not in names_in(found))
        for way in FEEDS:
            these = [each for each in wanted if each[0] == way]
            for each in these:
                players.do(*each)
            with contextlib.suppress(AssertionError):
                system.verdict(
                    lambda found, these=these: all(
                        f"/{name}" in names_in(found) for _, name in these
                    )
                )
            judged = [e["verdict"]["findings"] for e in system.up.of_kind("verdict")]
            system.found |= dict.fromkeys(these, judged[-1])
            players.do("leave")
            system.verdict(lambda found: "marker" not in names_in(found))
        yield system
        if system.up.process.poll() is not None:
            raise Unhandled(f"the supervisor ended: {system.up.events[-2:]}")
        system.up.signal(2)
        if system.up.finish() != 130:
            raise Unhandled(f"it ended with {system.up.process.returncode}")
        system.up.assert_nothing_left()
        check_text(system.up.said())
    finally:
        players.close()
        system.up.close()


def _listens(way: str, name: str, system: System) -> None:
    wrong = [
        each
        for each in system.found[way, name]
        if each["outcome"] == "violated" and f"/{name}" in (each["subject"], each["node"])
    ]
    if wrong:
        raise Unhandled(f"a tool that only watches is {wrong[0]['rule']}: {wrong[0]['message']}")


def _feeds(way: str, name: str, system: System) -> None:
    findings = system.found[way, name]
    if not any(
        each["outcome"] == "violated" and f"/{name}" in each["message"] for each in findings
    ):
        raise Unhandled(f"nobody says that it feeds the system: {names_in(findings)}")


def attacks(rng: random.Random) -> list[Attack]:
    del rng
    return [
        Attack(name=f"{way} {name}", run=functools.partial(judge, way, name))
        for ways, judge in ((HARMLESS, _listens), (FEEDS, _feeds))
        for way in ways
        for name in TOOLS
    ]


CLASS = HostileClass(name="tools", attacks=attacks, stage=stage)
