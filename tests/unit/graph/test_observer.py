"""How an observation is put together, with a graph and clients that do what they are told."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Collection, Iterable, Sequence
from typing import Any, TypeVar

import pytest
from msgspec.structs import replace

from lifecycle.errors import MiddlewareError
from lifecycle.graph.graph import Graph
from lifecycle.graph.loop import GraphLoop
from lifecycle.graph.readings import Diagnostic, DiagnosticReadings
from lifecycle.manifest.model import (
    After,
    EndpointKind,
    Readiness,
    ReadyBy,
    Run,
    RunKind,
)
from lifecycle.plan.model import ExpectedParameter, Plan
from lifecycle.verify.observation import (
    HealthReport,
    NodeConfiguration,
    NodeParameters,
    Observation,
    ObservedEndpoint,
    ObservedNode,
    ParameterReport,
)
from lifecycle.verify.tool_filter import NO_NAMES, DeclaredNames
from tests.builders import configuration, plan_of, planned_node
from tests.unit.supervisor.fakes import run as run_jumping

T = TypeVar("T")
VIDEO = ObservedEndpoint(
    kind=EndpointKind.PUBLISHER, node="/a", name="/video", type="std_msgs/msg/String"
)


class FakeGraph:
    def __init__(self) -> None:
        self.nodes: tuple[ObservedNode, ...] = ()
        self.endpoints: tuple[ObservedEndpoint, ...] = ()
        self.kept: Collection[str] = ()
        self.callbacks: list[Callable[[], None]] = []
        self.destroyed = False
        self.arriving: list[tuple[ObservedNode, ...]] = []
        self.offered: set[str] = set()
        self.foreign: set[str] = set()
        self.elsewhere: set[str] = set()
        self.settling = self
        self.departed: tuple[ObservedEndpoint, ...] = ()

    def snapshot(
        self, *, names: DeclaredNames = NO_NAMES
    ) -> tuple[tuple[ObservedNode, ...], tuple[ObservedEndpoint, ...]]:
        self.kept = names.nodes
        if self.arriving:
            self.nodes = self.arriving.pop(0)
        return self.nodes, self.endpoints

    def left_s(self) -> float:
        return 0.01 if self.arriving else 0.0

    def offers(self, node: str, service: str) -> bool:
        return service in self.offered

    def hosted(self, nodes: Iterable[str]) -> dict[str, bool]:
        return {each: each not in self.foreign for each in nodes if each not in self.elsewhere}

    def on_change(self, callback: Callable[[], None]) -> Callable[[], None]:
        self.callbacks.append(callback)
        return lambda: self.callbacks.remove(callback)

    def destroy(self) -> None:
        self.destroyed = True

    def change(self) -> None:
        for callback in self.callbacks:
            callback()


class FakeClients:
    def __init__(self) -> None:
        self.states: dict[str, str] = {}
        self.configurations: dict[str, NodeConfiguration | None] = {}
        self.asked: list[str] = []
        self.answer_s = 0.0
        self.read_configurations: list[str] = []
        self.followed: dict[str, Callable[[], None]] = {}
        self.forgotten: list[str] = []
        self.destroyed = False
        self.listening = False
        self.read: list[tuple[str, frozenset[str]]] = []
        self.while_read: Callable[[], None] = lambda: None

    async def get_state(self, node: str, *, timeout_s: float) -> str:
        self.asked.append(node)
        if node not in self.states:
            raise MiddlewareError(f"cannot call service '{node}/get_state': it is hung")
        return self.states[node]

    async def get_configuration(
        self, node: str, *, timeout_s: float, expected: bool
    ) -> NodeConfiguration | None:
        self.read_configurations.append(node)
        answer = self.configurations.get(node)
        await asyncio.sleep(self.answer_s)
        return answer

    def on_transition(self, node: str, callback: Callable[[], None]) -> None:
        self.followed[node] = callback

    def serves_parameters(self, node: str) -> bool | None:
        return True

    async def report_parameters(
        self, node: str, names: Collection[str], *, timeout_s: float
    ) -> tuple[ParameterReport, ...]:
        self.read.append((node, frozenset(names)))
        self.while_read()
        await asyncio.sleep(0)
        return (ParameterReport(name="gain", type="double", value=1.5),)

    def on_parameters(self, callback: Callable[[str, frozenset[str]], None]) -> None:
        self.listening = True

    def on_diagnostics(self, callback: Callable[[Sequence[Diagnostic]], None]) -> None:
        self.diagnose = callback

    def forget(self, node: str) -> None:
        self.forgotten.append(node)

    def destroy(self) -> None:
        self.destroyed = True


def plan(*names: str) -> Plan:
    return plan_of(*(planned_node(name, kind=RunKind.ATTACH) for name in names))


LOOP = asyncio.new_event_loop()


@pytest.fixture
def graph() -> FakeGraph:
    return FakeGraph()


@pytest.fixture
def clients() -> FakeClients:
    return FakeClients()


def observing(graph: FakeGraph, clients: FakeClients, **options: Any) -> Graph:
    """An observer as a supervisor has it."""
    try:
        loop = asyncio.get_running_loop()
    except RuntimeError:
        loop = LOOP
    return Graph(graph, clients, GraphLoop(loop), **options)


@pytest.fixture
def observer(graph: FakeGraph, clients: FakeClients) -> Graph:
    return observing(graph, clients)


def run(awaitable: Awaitable[T]) -> T:
    async def bounded() -> T:
        return await asyncio.wait_for(awaitable, 10)

    return LOOP.run_until_complete(bounded())


def managed(*names: str) -> tuple[ObservedNode, ...]:
    return tuple(ObservedNode(full_name=name, managed=True) for name in names)


def test_planned_nodes_are_asked_and_others_only_seen(
    observer: Graph, graph: FakeGraph, clients: FakeClients
) -> None:
    graph.nodes, graph.endpoints = managed("/a", "/other"), (VIDEO,)
    clients.states = {"/a": "inactive", "/other": "active"}
    clients.configurations = {"/a": configuration("/a")}
    assert run(observer.observe(plan("a", "b"))) == Observation(
        nodes=(
            ObservedNode(full_name="/a", managed=True, state="inactive"),
            ObservedNode(full_name="/other", managed=True),
        ),
        endpoints=(VIDEO,),
        configurations=(configuration("/a"),),
    )
    assert clients.asked == ["/a"]
    assert graph.kept == {"/a", "/b"}


def test_a_node_without_lifecycle_services_is_not_asked_for_its_state(
    observer: Graph, graph: FakeGraph, clients: FakeClients
) -> None:
    graph.nodes = (ObservedNode(full_name="/a", managed=False),)
    clients.configurations = {"/a": configuration("/a", state="active")}
    observation = run(observer.observe(plan("a")))
    assert clients.asked == []
    assert observation.nodes == graph.nodes
    assert observation.configurations == (configuration("/a", state="active"),)


@pytest.mark.parametrize(
    ("kind", "where", "believed"),
    [
        (RunKind.ATTACH, "a host of ours", True),
        (RunKind.ATTACH, "foreign", False),
        (RunKind.ATTACH, "elsewhere", False),
        (RunKind.COMMAND, "foreign", False),
        (RunKind.PYTHON, "a host of ours", True),
        (RunKind.PYTHON, "foreign", False),
        (RunKind.PYTHON, "elsewhere", True),
    ],
)
def test_a_node_is_believed_of_itself_in_a_host_of_ours_only(
    graph: FakeGraph,
    clients: FakeClients,
    observer: Graph,
    kind: RunKind,
    where: str,
    *,
    believed: bool,
) -> None:
    graph.nodes = managed("/a")
    clients.states = {"/a": "active"}
    clients.configurations = {"/a": configuration("/a")}
    graph.foreign = {"/a"} if where == "foreign" else set()
    graph.elsewhere = {"/a"} if where == "elsewhere" else set()
    node = planned_node("a", kind=kind)
    if kind is not RunKind.PYTHON:
        node = replace(node, run=Run(kind=kind))
    observation = run(observer.observe(plan_of(node)))
    assert observation.nodes[0].state == "active"
    assert bool(observation.configurations) is believed


def test_what_was_put_is_believed_and_not_asked_for(
    observer: Graph, graph: FakeGraph, clients: FakeClients
) -> None:
    graph.nodes = managed("/a")
    clients.states = {"/a": "unconfigured"}
    observer.state.put_configuration(configuration("/a", state="active"))
    observation = run(observer.observe(plan("a")))
    assert observation.nodes == (ObservedNode(full_name="/a", managed=True, state="active"),)
    assert observation.configurations == (configuration("/a", state="active"),)
    assert clients.asked == []


def test_what_was_put_stands_before_discovery_shows_the_node_and_goes_with_it(
    observer: Graph, graph: FakeGraph
) -> None:
    observer.state.put_configuration(configuration("/a"))
    assert run(observer.observe(plan("a"))).configurations == (configuration("/a"),)
    graph.nodes = managed("/a")
    assert run(observer.observe(plan("a"))).configurations == (configuration("/a"),)
    graph.nodes = ()
    assert run(observer.observe(plan("a"))).configurations == ()


def test_a_node_that_does_not_answer_has_no_state_and_the_log_says_why(
    observer: Graph, graph: FakeGraph, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    graph.nodes = managed("/a")
    assert run(observer.observe(plan("a"))).nodes == managed("/a")
    assert caplog.messages == [
        "state of /a unknown: cannot call service '/a/get_state': it is hung"
    ]


def test_a_node_that_left_is_forgotten_once(
    observer: Graph, graph: FakeGraph, clients: FakeClients
) -> None:
    graph.nodes, clients.states = managed("/a"), {"/a": "active"}
    run(observer.observe(plan("a")))
    graph.nodes = ()
    run(observer.observe(plan("a")))
    run(observer.observe(plan("a")))
    assert clients.forgotten == ["/a"]


def test_nothing_was_looked_at_yet_counts_as_a_change(observer: Graph) -> None:
    run(observer.wait_change())


def test_a_look_uses_up_the_changes_before_it(observer: Graph, graph: FakeGraph) -> None:
    async def look_and_wait() -> None:
        await observer.observe(plan())
        graph.change()
        await asyncio.wait_for(observer.wait_change(), 5)
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(observer.wait_change(), 0.1)
        graph.change()
        await asyncio.sleep(0)
        await observer.observe(plan())
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(observer.wait_change(), 0.1)

    run(look_and_wait())


def test_a_burst_is_waited_out_but_not_for_ever(graph: FakeGraph, clients: FakeClients) -> None:
    async def burst() -> tuple[float, float]:
        loop, observer = asyncio.get_running_loop(), observing(graph, clients)
        await observer.observe(plan())

        async def keep_changing() -> None:
            while True:
                graph.change()
                await asyncio.sleep(0.002)

        began = loop.time()
        changing = asyncio.ensure_future(keep_changing())
        await observer.wait_change()
        cut_off_s = loop.time() - began
        changing.cancel()
        await observer.observe(plan())
        began = loop.time()
        graph.change()
        await observer.wait_change()
        return cut_off_s, loop.time() - began

    cut_off_s, quiet_s = run_jumping(burst())
    assert cut_off_s == pytest.approx(0.05, abs=0.003)
    assert quiet_s == pytest.approx(0.005, abs=0.003)


def test_a_transition_of_a_node_that_is_asked_wakes(
    observer: Graph, graph: FakeGraph, clients: FakeClients
) -> None:
    graph.nodes, clients.states = managed("/a"), {"/a": "inactive"}

    async def transition() -> None:
        await observer.observe(plan("a"))
        clients.followed["/a"]()
        await asyncio.wait_for(observer.wait_change(), 5)

    run(transition())


def test_who_has_left_is_called_back_no_more(graph: FakeGraph, clients: FakeClients) -> None:
    observer = observing(graph, clients)
    assert len(graph.callbacks) == 1
    observer.close()
    assert graph.callbacks == []


def test_an_observation_waits_for_who_answered_and_is_not_seen_yet() -> None:
    graph = FakeGraph()
    graph.arriving = [(), (), (ObservedNode(full_name="/stranger"),)]
    observer = observing(graph, FakeClients())
    observation = run(observer.observe(plan()))
    assert [node.full_name for node in observation.nodes] == ["/stranger"]


def with_parameter(made: Plan, *names: str) -> Plan:
    """Expect the parameter gain of some nodes."""
    gain = ExpectedParameter(name="gain", type="double", at=made.nodes[0].at)
    nodes = tuple(
        replace(each, expected_parameters=(gain,)) if each.name in names else each
        for each in made.nodes
    )
    return replace(made, nodes=nodes)


def test_only_nodes_that_report_no_parameters_are_asked_for_those_that_are_planned(
    observer: Graph, graph: FakeGraph, clients: FakeClients
) -> None:
    graph.nodes = managed("/foreign", "/ours", "/asked", "/unplanned")
    observer.state.put_configuration(replace(configuration("/ours"), parameters=()))
    clients.configurations["/asked"] = replace(configuration("/asked"), parameters=())
    named = with_parameter(plan("foreign", "ours", "asked", "gone"), "foreign", "ours", "asked")
    seen = run(observer.observe(named))
    gain = ParameterReport(name="gain", type="double", value=1.5)
    assert seen.parameters == (NodeParameters(node="/foreign", parameters=(gain,)),)
    assert clients.read == [("/foreign", frozenset({"gain"}))]
    assert clients.listening


def test_a_parameter_that_is_waited_for_is_read_too_by_looks_at_all_and_at_its_node_alone(
    observer: Graph, graph: FakeGraph, clients: FakeClients
) -> None:
    graph.nodes = managed("/foreign", "/viewer")
    ready = Readiness(by=ReadyBy.PARAMETER, name="ready")
    made = with_parameter(plan("foreign", "viewer"), "foreign", "viewer")
    after = After(node="foreign", condition=ready, at=made.nodes[0].at)
    made = replace(made, nodes=(made.nodes[0], replace(made.nodes[1], after=(after,))))
    run(observer.observe(made, only=frozenset({"/foreign"})))
    assert clients.read == [("/foreign", frozenset({"gain", "ready"}))]
    run(observer.observe(made, only=frozenset()))
    run(observer.observe(made))  # the same names: nothing is read anew
    assert clients.read[1:] == [("/viewer", frozenset({"gain"}))]


def test_without_a_planned_parameter_of_others_nobody_listens_for_changes(
    observer: Graph, graph: FakeGraph, clients: FakeClients
) -> None:
    graph.nodes = managed("/foreign", "/ours")
    observer.state.put_configuration(replace(configuration("/ours"), parameters=()))
    seen = run(observer.observe(with_parameter(plan("foreign", "ours"), "ours")))
    assert (seen.parameters, clients.read, clients.listening) == ((), [], False)


def test_what_changed_while_parameters_were_read_is_seen(
    observer: Graph, graph: FakeGraph, clients: FakeClients
) -> None:
    graph.nodes = managed("/foreign")

    def more() -> None:
        graph.nodes = managed("/foreign", "/late")

    clients.while_read = more
    seen = run(observer.observe(with_parameter(plan("foreign"), "foreign")))
    assert [each.full_name for each in seen.nodes] == ["/foreign", "/late"]


def test_what_diagnostics_say_of_a_node_is_its_worst_entry_until_that_is_stale() -> None:
    now_s, woken = [0.0], []
    clients = FakeClients()
    readings = DiagnosticReadings(clients, lambda: woken.append(now_s[0]), lambda: now_s[0])
    readings.listen({})
    assert not hasattr(clients, "diagnose")  # nothing is subscribed to
    readings.listen({"/arm": ("arm: *", "gripper")})
    assert readings.reports() == {}
    clients.diagnose([("arm: motor", 0, "fine"), ("arms", 2, "of another"), ("gripper", 1, "warm")])
    assert readings.reports() == {"/arm": HealthReport(ok=True)}
    assert len(woken) == 1
    now_s[0] = 4.0
    clients.diagnose([("arm: motor", 2, "stalled")])
    stalled = HealthReport(ok=False, message="'arm: motor': stalled")
    assert readings.reports() == {"/arm": stalled}
    now_s[0] = 6.0
    clients.diagnose([("arm: motor", 0, "fine")])
    stale = HealthReport(ok=None, message="'gripper' was not published for 5 s")
    assert readings.reports() == {"/arm": stale}
    now_s[0] = 8.0
    clients.diagnose([("gripper", 3, "no data")])
    stale = HealthReport(ok=None, message="'gripper' is stale: no data")
    assert readings.reports() == {"/arm": stale}
    clients.diagnose([("gripper", 0, "")])
    assert readings.reports() == {"/arm": HealthReport(ok=True)}
    asleep = len(woken)
    now_s[0] = 10.0
    clients.diagnose([])
    assert len(woken) == asleep
    now_s[0] = 12.0
    clients.diagnose([])  # as each second
    assert len(woken) == asleep + 1


def test_what_diagnostics_call_an_entry_is_taken_by_the_letter() -> None:
    clients = FakeClients()
    readings = DiagnosticReadings(clients, lambda: None, lambda: 0.0)
    readings.listen({"/lidar": ("lidar [front]: *",)})
    clients.diagnose([("lidar f: status", 2, "of another"), ("lidar [front]: rpm", 2, "")])
    bad = HealthReport(ok=False, message="'lidar [front]: rpm' has level ERROR")
    assert readings.reports() == {"/lidar": bad}
    # Another process comes in its place: what was said of the last one is not said of it.
    readings.forget("/lidar")
    assert readings.reports() == {}
