"""The graph interface on real DDS: who comes, who goes, who is late, and what two observers see."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import rclpy
from managed_node import ManagedNode
from msgspec.structs import replace
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from reporting_node import ReportingNode
from std_msgs.msg import String
from std_srvs.srv import Trigger

from lifecycle import codec
from lifecycle.graph.graph import Graph
from lifecycle.graph.state import EventKind, GraphEvent, GraphState
from lifecycle.manifest.loading import load
from lifecycle.manifest.model import EndpointKind
from lifecycle.middleware.process.shared_memory import sweep
from lifecycle.plan.build import build_plan
from lifecycle.verify.observation import EndpointReport
from lifecycle.verify.outcome import Outcome
from tests.builders import configuration
from tests.ros.supervisor.running import ROOT, pair, up
from tests.shared_memory import owned_by

LIMIT_S = 30.0

WaitUntil = Callable[..., None]

PROCESS = "tests.ros.graph.reporting_node"


@contextlib.contextmanager
def spinning(*nodes: Node) -> Iterator[None]:
    executor = SingleThreadedExecutor(context=nodes[0].context)
    for node in nodes:
        executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    try:
        yield
    finally:
        executor.shutdown()
        thread.join()


_killed: set[str] = set()


@pytest.fixture(autouse=True)
def _sweep() -> Iterator[None]:
    """Remove what killed processes leave, once no graph of the test has their ports open."""
    yield
    sweep(within_s=0.5)
    _killed.clear()


@contextlib.contextmanager
def process(name: str, topic: str) -> Iterator[subprocess.Popen[str]]:
    started = subprocess.Popen(
        [sys.executable, "-m", PROCESS, name, topic], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    try:
        assert started.stdout is not None
        assert started.stdout.readline() == "reporting\n"
        _killed.update(owned_by([started.pid]))
        yield started
    finally:
        with contextlib.suppress(ProcessLookupError):
            started.kill()
        started.communicate()


@pytest.fixture
def graph(domain_id: int) -> Iterator[Graph]:
    with Graph.open(domain_id) as graph:
        yield graph


def publishers(topic: str, *nodes: str) -> Callable[[GraphState], bool]:
    return lambda state: [end.node.name for end in state.publishers_of(topic)] == list(nodes)


def until(graph: Graph, holds: Callable[[GraphState], object]) -> None:
    found = threading.Event()

    def look(*_: object) -> None:
        if holds(graph.state):
            found.set()

    remove = graph.state.on_change(look)
    look()
    assert found.wait(LIMIT_S), graph.state.nodes()
    remove()


def test_a_node_joins_tells_its_changes_and_leaves(
    graph: Graph, make_node: Callable[..., Node], wait_until: WaitUntil
) -> None:
    told: list[tuple[EventKind, str]] = []

    def note(event: GraphEvent) -> None:
        if event.node == "/teller":
            told.append((event.kind, event.reason))

    graph.events.on([EventKind.JOINED, EventKind.LEFT, EventKind.STATE_CHANGED], note)
    node = make_node("teller")
    with spinning(node):
        teller = ReportingNode(node, "/told")
        until(graph, publishers("/told", "/teller"))
        # Its status comes: what was read of it says the same, and could have come before it.
        until(graph, lambda state: (seen := state.node("/teller")) and seen.status)
        until(graph, lambda state: (seen := state.node("/teller")) and seen.state == "inactive")
        teller.reporter.report(state="active")
        until(graph, lambda state: (seen := state.node("/teller")) and seen.state == "active")
        asked = teller.asked
        teller.configuration = replace(
            teller.configuration, endpoints=(), state="active", checksum="2"
        )
        teller.reporter.report(checksum="2")
        until(graph, publishers("/told"))
        assert teller.asked > asked
        teller.reporter.left("done")
        until(graph, lambda state: state.node("/teller") is None)
    joined = [(EventKind.JOINED, ""), (EventKind.STATE_CHANGED, ""), (EventKind.LEFT, "done")]
    wait_until(lambda: told == joined)


def test_a_late_joiner_learns_what_was_before_and_both_see_the_same(
    graph: Graph, domain_id: int, make_node: Callable[..., Node], wait_until: WaitUntil
) -> None:
    nodes = [make_node(f"early_{number}") for number in range(5)]
    with spinning(*nodes):
        for number, node in enumerate(nodes):
            ReportingNode(node, f"/early/t{number}")
        until(graph, publishers("/early/t4", "/early_4"))
        with Graph.open(domain_id) as late:
            for number in range(5):
                until(late, publishers(f"/early/t{number}", f"/early_{number}"))
            for node in nodes:
                name = node.get_fully_qualified_name()
                until(graph, lambda state, name=name: state.node(name))
                wait_until(lambda name=name: graph.state.node(name) == late.state.node(name))


def test_a_killed_node_falls_silent_and_its_next_instance_takes_its_place(
    fresh_domain: int, wait_until: WaitUntil
) -> None:
    told: list[EventKind] = []
    with Graph.open(fresh_domain) as graph:
        graph.events.on(
            [EventKind.JOINED, EventKind.LEFT, EventKind.SILENT],
            lambda event: told.append(event.kind),
            node="/mortal",
        )
        with process("mortal", "/mortal/t") as first:
            until(graph, publishers("/mortal/t", "/mortal"))
            # Discovery may show it before its first status, without which none is missed.
            until(graph, lambda state: (seen := state.node("/mortal")) and seen.status)
            born = graph.state.node("/mortal")
            assert born is not None
            os.kill(first.pid, signal.SIGKILL)
            first.wait(LIMIT_S)
            until(
                graph,
                lambda state: (seen := state.node("/mortal")) and seen.silent,
            )
        with process("mortal", "/mortal/t") as second:
            until(
                graph,
                lambda state: (
                    (seen := state.node("/mortal"))
                    and not seen.silent
                    and seen.status.instance > born.status.instance
                    and seen.configuration
                ),
            )
            until(graph, publishers("/mortal/t", "/mortal"))
            second.terminate()
            until(graph, lambda state: state.node("/mortal") is None)
        joined, silent, left = EventKind.JOINED, EventKind.SILENT, EventKind.LEFT
        wait_until(lambda: told == [joined, silent, left, joined, left])


def test_a_node_that_reports_nothing_is_seen_by_discovery(
    graph: Graph, make_node: Callable[..., Node]
) -> None:
    node = make_node("stranger", namespace="/far")
    with spinning(node):
        publisher = node.create_publisher(String, "/strange", 1)
        until(graph, publishers("/strange", "/far/stranger"))
        node.destroy_publisher(publisher)
        until(graph, publishers("/strange"))
    node.destroy_node()
    until(graph, lambda state: state.node("/far/stranger") is None)


def test_a_node_of_ours_that_tells_no_events_is_read_again_when_its_connections_change(
    graph: Graph, make_node: Callable[..., Node]
) -> None:
    node = make_node("quiet")
    topic = "/before"

    def answer(_: object, response: Trigger.Response) -> Trigger.Response:
        report = EndpointReport(
            kind=EndpointKind.PUBLISHER, name="t", resolved=topic, type="std_msgs/msg/String"
        )
        told = configuration("/quiet", report, state="active", checksum=topic)
        response.success, response.message = True, codec.to_json(told).decode()
        return response

    node.create_service(Trigger, "~/get_configuration", answer)
    with spinning(node):
        until(graph, publishers("/before", "/quiet"))
        topic = "/after"
        hidden = make_node("_quiet_net")
        hidden.create_publisher(String, topic, 10)
        until(graph, publishers("/after", "/quiet"))
        topic = "/remapped"
        hidden.create_publisher(String, "/remapped", 1)
        until(graph, publishers("/remapped", "/quiet"))
        topic = "/gone"
        hidden.destroy_node()
        until(graph, publishers("/gone", "/quiet"))
    node.destroy_node()


def test_the_state_of_a_foreign_managed_node_is_followed(
    graph: Graph, context: rclpy.Context, wait_until: WaitUntil
) -> None:
    node = ManagedNode("foreign_managed", context=context, enable_rosout=False)

    def is_in(label: str) -> Callable[[GraphState], bool]:
        return lambda state: (
            (seen := state.node("/foreign_managed")) is not None and (seen.state == label)
        )

    with spinning(node):
        until(graph, is_in("unconfigured"))
        # Only then is it sure that the transition is heard.
        wait_until(lambda: node.count_subscribers("/foreign_managed/transition_event"))
        node.trigger_configure()
        until(graph, is_in("inactive"))
    node.destroy_node()


def test_a_graph_on_a_users_node_needs_no_participant_of_its_own(
    make_node: Callable[..., Node], context: rclpy.Context
) -> None:
    watching, teller = make_node("watching"), make_node("told_of")
    executor = MultiThreadedExecutor(num_threads=2, context=context)
    for node in (watching, teller):
        executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    try:
        with Graph.on(watching) as graph:
            appeared, vanished = threading.Event(), threading.Event()
            graph.events.on_publisher("/on/t", lambda _: appeared.set(), lambda _: vanished.set())
            reporting = ReportingNode(teller, "/on/t")
            assert appeared.wait(LIMIT_S)
            until(graph, lambda state: state.node("/watching"))
            reporting.reporter.left()
            assert vanished.wait(LIMIT_S)
    finally:
        executor.shutdown()
        thread.join()


def test_a_program_asks_whether_the_system_is_up_and_running(
    tmp_path: Path, fresh_domain: int, wait_until: WaitUntil
) -> None:
    manifest = pair(tmp_path, fresh_domain)
    plan = build_plan(load(manifest).manifest)
    with Graph.open(fresh_domain) as graph:
        nothing = graph.verdict(plan)
        assert nothing.verdict is Outcome.VIOLATED
        assert "graph.missing-node" in {each.rule for each in nothing.findings}
        with up(manifest, runtime=tmp_path) as run:
            run.until("system", reached="active")
            # Its own discovery may show them later than the supervisor's.
            wait_until(lambda: not graph.verdict(plan).findings)
            assert graph.observation(plan).configurations
            with Graph.open(fresh_domain) as late:
                wait_until(lambda: late.verdict(plan).verdict is Outcome.OK)
            # Killed, it would leave its ports, which our own graph still has open.
            run.signal(signal.SIGTERM)
            run.finish()
