"""What `lifecycle export sros2` allows is what a running system and its supervisor make."""

from __future__ import annotations

import datetime as dt
import signal
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import pytest
from rclpy.node import Node

from lifecycle.errors import ExitCode
from lifecycle.export.sros2 import documents
from lifecycle.manifest import load
from lifecycle.plan import build_plan
from tests.ros.supervisor.running import up
from tests.ros.supervisor.test_systems_of_actions import acting

pytestmark = pytest.mark.thorough

SYSTEM = {"counter", "caller", "_counter_net"}


def made_by(watcher: Node, name: str, namespace: str) -> tuple[set[str], set[str]]:
    """The DDS topics that a node writes and reads."""
    names = {
        kind: {found for found, _ in ask(name, namespace)}
        for kind, ask in (
            ("publish", watcher.get_publisher_names_and_types_by_node),
            ("subscribe", watcher.get_subscriber_names_and_types_by_node),
            ("reply", watcher.get_service_names_and_types_by_node),
            ("request", watcher.get_client_names_and_types_by_node),
        )
    }
    replies = {f"rr{each}Reply" for each in names["reply"]}
    asked = {f"rq{each}Request" for each in names["reply"]}
    requests = {f"rq{each}Request" for each in names["request"]}
    answers = {f"rr{each}Reply" for each in names["request"]}
    return (
        {f"rt{each}" for each in names["publish"]} | replies | requests,
        {f"rt{each}" for each in names["subscribe"]} | asked | answers,
    )


def test_everything_that_runs_is_allowed(
    tmp_path: Path, domain_id: int, make_node: Callable[..., Node], wait_until: Callable
) -> None:
    manifest = acting(tmp_path, domain_id)
    now = dt.datetime.now(dt.timezone.utc)
    plan = build_plan(load(manifest).manifest)
    enclaves, files = documents(plan, not_before=now, not_after=now)
    watcher = make_node("_ros2cli_watcher")
    seen: dict[tuple[str, str], tuple[set[str], set[str]]] = {}

    def complete() -> bool:
        seen.clear()
        for name, namespace in watcher.get_node_names_and_namespaces():
            if name != "_ros2cli_watcher":
                seen[name, namespace] = made_by(watcher, name, namespace)
        asked = [each for (name, _), (each, _) in seen.items() if name.startswith("_lifecycle_")]
        served = [each for each, _ in seen.values() if "rr/tally/_action/send_goalReply" in each]
        return bool(asked) and bool(served) and {name for name, _ in seen} >= SYSTEM

    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        wait_until(complete)
        # Whoever is killed leaves its ports to the watcher, which does not remove them.
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK

    hidden = {"_counter_net": "counter"}
    for (name, namespace), (published, subscribed) in seen.items():
        process = hidden.get(name, name)
        (path,) = (
            each.path
            for each in enclaves
            if each.processes == (() if process.startswith("_lifecycle_") else (process,))
        )
        document = ET.fromstring(files[f"enclaves{path}/permissions.xml"])
        for verb, topics in (("publish", published), ("subscribe", subscribed)):
            allowed = {each.text for each in document.iterfind(f".//{verb}//topic")}
            assert topics - allowed == set(), (namespace, name, verb)
