"""Peers that answer `~/get_configuration` with anything, and say anything on the graph's topics.

Every liar is a declared, attached node: `verify`, `flows`, `graph`, `capture` and `up` ask them
all. Then each message is said beside a running supervisor, which must live on.
"""

from __future__ import annotations

import contextlib
import functools
import random
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import yaml

from lifecycle.verify.tool_filter import GRAPH_TOPIC
from tests.hostile.answers import ANSWERS, MESSAGES
from tests.hostile.attack import (
    Attack,
    Done,
    HostileClass,
    Place,
    Unhandled,
    check,
    check_text,
    in_a_process,
)
from tests.ros.supervisor.running import ROOT, Up, pair

VERBS = ("verify", "flows", "graph", "capture", "up")
BOUND_S = 60.0


def node_of(answer: str) -> str:
    """Return the name of the node that gives an answer."""
    return "liar_" + re.sub(r"[^a-z0-9]", "_", answer.lower())


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


class Stage:
    """How verbs ended beside all liars, and a supervisor that is told things."""

    def __init__(self) -> None:
        self.verbs: dict[str, Done | Exception] = {}
        self.players: Players
        self.up: Up


@contextlib.contextmanager
def stage(place: Place, attacks: Sequence[Attack]) -> Iterator[Stage]:
    staged = Stage()
    verbs = {each.name.partition(": ")[0] for each in attacks} & {*VERBS}
    staged.players = Players()
    try:
        if verbs:
            _lie(staged, verbs, place)
            staged.players.do("leave")
        folder = place.folder()
        edit = {
            "data_layer": {"authority": "supervisor", "source": "dynamic", "events": True},
        }
        staged.up = Up(pair(folder, place.domain, edit=edit), runtime=folder)
        try:
            staged.up.until("system", reached="active")
            yield staged
            staged.up.signal(signal.SIGINT)
            staged.up.finish()
            staged.up.assert_nothing_left()
            check_text(staged.up.said())
        finally:
            staged.up.close()
    finally:
        staged.players.close()


def _lie(staged: Stage, verbs: set[str], place: Place) -> None:
    for answer in ANSWERS:
        staged.players.do(answer.replace(" ", "_"), node_of(answer))
    folder = place.folder()
    manifest = folder / "liars.lifecycle.yaml"
    nodes: dict[str, Any] = {
        node_of(each): {
            "run": {"attach": True},
            "managed": False,
            "timeouts": {"start_s": 8},
            "interface": {"publishers": [{"name": "~/said", "type": "std_msgs/msg/String"}]},
            "flows": {"publishers": {"~/said": {"unique": "optionally_required"}}},
        }
        for each in ANSWERS
    }
    document = {
        "manifest_version": 1,
        "system": "liars",
        "discovery": {"domain_id": place.domain, "range": "localhost"},
        "policy": {"unheard": "ignore"},
        "nodes": nodes,
    }
    manifest.write_text(yaml.safe_dump(document))
    for verb in sorted(verbs):
        words = {
            "capture": ("capture", "--domain", str(place.domain), "--wait", "2"),
            "up": ("up", str(manifest), "--stop-after", "1", "--timeout", "20"),
            "graph": ("graph", str(manifest)),
        }.get(verb, (verb, str(manifest), "--timeout", "3"))
        try:
            staged.verbs[verb] = in_a_process(*words, runtime=place.folder(), limit_s=BOUND_S)
        except Unhandled as error:
            staged.verbs[verb] = error


def _judged(verb: str, staged: Stage) -> None:
    done = staged.verbs[verb]
    if isinstance(done, Exception):
        raise done
    check(done, 0, 4, 5, 6)


def _told(topic: str, index: int, staged: Stage) -> None:
    staged.players.do("say", topic, str(index))
    staged.up.catch_up()
    staged.players.do("leave")
    if staged.up.process.poll() is not None:
        raise Unhandled(f"the supervisor ended: {staged.up.events[-2:]}")


def _lives(staged: Stage) -> None:
    """What was said before must not keep it from noticing anything."""
    staged.players.do("publish", "marker")
    staged.up.until_verdict(lambda verdict: "/marker" in str(verdict["findings"]))
    staged.players.do("leave")


def attacks(rng: random.Random) -> list[Attack]:
    found = [
        Attack(name=f"{verb}: {answer}", run=functools.partial(_judged, verb))
        for verb in VERBS
        for answer in ANSWERS
    ]
    for index in rng.sample(range(len(MESSAGES)), len(MESSAGES)):
        run = functools.partial(_told, GRAPH_TOPIC, index)
        found.append(Attack(name=f"message {index}", run=run))
    found.append(Attack(name="after all messages it notices a newcomer", run=_lives))
    return found


CLASS = HostileClass(name="reports", attacks=attacks, stage=stage, limit_s=360.0)
