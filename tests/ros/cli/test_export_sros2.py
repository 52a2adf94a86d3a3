"""What `lifecycle export sros2` allows is what a running system and its supervisor make."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from rclpy.node import Node

from lifecycle.errors import ExitCode
from lifecycle.export.sros2 import Enclave, enclaves_of
from lifecycle.manifest.loading import load
from lifecycle.manifest.model import EndpointKind
from lifecycle.plan.build import build_plan
from tests.ros.supervisor.running import up
from tests.ros.supervisor.test_systems_of_actions import acting

pytestmark = pytest.mark.thorough

SYSTEM = {"counter", "caller", "_counter_net"}


VERBS = {
    EndpointKind.PUBLISHER: "publish",
    EndpointKind.SUBSCRIPTION: "subscribe",
    EndpointKind.SERVICE_SERVER: "reply",
    EndpointKind.SERVICE_CLIENT: "request",
}


def made_by(watcher: Node, name: str, namespace: str) -> dict[str, set[str]]:
    """What a node publishes, subscribes to, serves and asks."""
    return {
        verb: {found for found, _ in ask(name, namespace)}
        for verb, ask in (
            ("publish", watcher.get_publisher_names_and_types_by_node),
            ("subscribe", watcher.get_subscriber_names_and_types_by_node),
            ("reply", watcher.get_service_names_and_types_by_node),
            ("request", watcher.get_client_names_and_types_by_node),
        )
    }


def allowed_in(enclave: Enclave) -> dict[str, set[str]]:
    """What an enclave allows: of an action, its topics and services."""
    found: dict[str, set[str]] = {each: set() for each in VERBS.values()}
    for kind, name in {each for profile in enclave.profiles for each in profile.allowed}:
        if kind in VERBS:
            found[VERBS[kind]].add(name)
            continue
        serves = kind is EndpointKind.ACTION_SERVER
        services = {f"{name}/_action/{each}" for each in ("cancel_goal", "get_result", "send_goal")}
        found["reply" if serves else "request"] |= services
        topics = {f"{name}/_action/{each}" for each in ("feedback", "status")}
        found["publish" if serves else "subscribe"] |= topics
    return found


def test_everything_that_runs_is_allowed(
    tmp_path: Path, domain_id: int, make_node: Callable[..., Node], wait_until: Callable
) -> None:
    manifest = acting(tmp_path, domain_id)
    enclaves = enclaves_of(build_plan(load(manifest).manifest))
    watcher = make_node("_ros2cli_watcher")
    seen: dict[tuple[str, str], dict[str, set[str]]] = {}

    def complete() -> bool:
        seen.clear()
        for name, namespace in watcher.get_node_names_and_namespaces():
            if name != "_ros2cli_watcher":
                seen[name, namespace] = made_by(watcher, name, namespace)
        asked = [each for name, each in seen if name.startswith("_lifecycle_")]
        served = [each for each in seen.values() if "/tally/_action/send_goal" in each["reply"]]
        return bool(asked) and bool(served) and {name for name, _ in seen} >= SYSTEM

    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        wait_until(complete)
        # Whoever is killed leaves its ports to the watcher, which does not remove them.
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK

    hidden = {"_counter_net": "counter"}
    for (name, namespace), made in seen.items():
        process = hidden.get(name, name)
        (enclave,) = (
            each
            for each in enclaves
            if each.processes == (() if process.startswith("_lifecycle_") else (process,))
        )
        for verb, allowed in allowed_in(enclave).items():
            assert made[verb] - allowed == set(), (namespace, name, verb)
