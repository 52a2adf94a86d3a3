"""The state machine: rcl's graph outside, connect inside inactive, and what each row runs."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from types import CoroutineType, SimpleNamespace
from typing import Any

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import Timeouts
from lifecycle.node.callbacks import CallbackOutcome, Result
from lifecycle.node.machine import (
    REQUESTS,
    Machine,
    NodeState,
    RefusedError,
    Transition,
)

S = NodeState
OK, FAILURE, ERROR = CallbackOutcome.SUCCESS, CallbackOutcome.FAILURE, CallbackOutcome.ERROR

PATHS: dict[NodeState, str] = {
    S.UNCONFIGURED: "",
    S.CONFIGURING: "configure",
    S.INACTIVE_DISCONNECTED: "configure OK",
    S.CONNECTING: "configure OK connect",
    S.INACTIVE_CONNECTED: "configure OK connect OK",
    S.DISCONNECTING: "configure OK connect OK disconnect",
    S.ACTIVATING_DISCONNECTED: "configure OK activate",
    S.ACTIVATING_CONNECTED: "configure OK activate OK",
    S.ACTIVE: "configure OK activate OK OK",
    S.DEACTIVATING: "configure OK activate OK OK deactivate",
    S.CLEANINGUP_CONNECTED: "configure OK connect OK cleanup",
    S.CLEANINGUP_DISCONNECTED: "configure OK cleanup",
    S.SHUTTINGDOWN: "shutdown",
    S.ERRORPROCESSING: "configure ERROR",
    S.FINALIZED: "shutdown OK",
}

TAKEN: dict[tuple[NodeState, str], NodeState] = {
    (S.UNCONFIGURED, "configure"): S.CONFIGURING,
    (S.UNCONFIGURED, "shutdown"): S.SHUTTINGDOWN,
    (S.INACTIVE_DISCONNECTED, "connect"): S.CONNECTING,
    (S.INACTIVE_DISCONNECTED, "activate"): S.ACTIVATING_DISCONNECTED,
    (S.INACTIVE_DISCONNECTED, "cleanup"): S.CLEANINGUP_DISCONNECTED,
    (S.INACTIVE_DISCONNECTED, "shutdown"): S.SHUTTINGDOWN,
    (S.INACTIVE_CONNECTED, "disconnect"): S.DISCONNECTING,
    (S.INACTIVE_CONNECTED, "activate"): S.ACTIVATING_CONNECTED,
    (S.INACTIVE_CONNECTED, "cleanup"): S.CLEANINGUP_CONNECTED,
    (S.INACTIVE_CONNECTED, "shutdown"): S.SHUTTINGDOWN,
    (S.ACTIVE, "deactivate"): S.DEACTIVATING,
    (S.ACTIVE, "shutdown"): S.SHUTTINGDOWN,
}

FINISHED: dict[tuple[NodeState, CallbackOutcome], NodeState] = {
    (S.CONFIGURING, OK): S.INACTIVE_DISCONNECTED,
    (S.CONFIGURING, FAILURE): S.UNCONFIGURED,
    (S.CONNECTING, OK): S.INACTIVE_CONNECTED,
    (S.CONNECTING, FAILURE): S.INACTIVE_DISCONNECTED,
    (S.DISCONNECTING, OK): S.INACTIVE_DISCONNECTED,
    (S.DISCONNECTING, FAILURE): S.INACTIVE_CONNECTED,
    (S.ACTIVATING_DISCONNECTED, OK): S.ACTIVATING_CONNECTED,
    (S.ACTIVATING_DISCONNECTED, FAILURE): S.INACTIVE_DISCONNECTED,
    (S.ACTIVATING_CONNECTED, OK): S.ACTIVE,
    (S.ACTIVATING_CONNECTED, FAILURE): S.INACTIVE_CONNECTED,
    (S.DEACTIVATING, OK): S.INACTIVE_CONNECTED,
    (S.DEACTIVATING, FAILURE): S.ACTIVE,
    (S.CLEANINGUP_CONNECTED, OK): S.CLEANINGUP_DISCONNECTED,
    (S.CLEANINGUP_CONNECTED, FAILURE): S.INACTIVE_CONNECTED,
    (S.CLEANINGUP_DISCONNECTED, OK): S.UNCONFIGURED,
    (S.CLEANINGUP_DISCONNECTED, FAILURE): S.INACTIVE_DISCONNECTED,
    (S.SHUTTINGDOWN, OK): S.FINALIZED,
    (S.SHUTTINGDOWN, FAILURE): S.FINALIZED,
    (S.ERRORPROCESSING, OK): S.UNCONFIGURED,
    (S.ERRORPROCESSING, FAILURE): S.FINALIZED,
    (S.ERRORPROCESSING, ERROR): S.FINALIZED,
}


class Answer:
    """Awaits what a callback is to return."""

    def __init__(self) -> None:
        self.outcome: CallbackOutcome | None = None

    def __await__(self) -> Any:
        while self.outcome is None:
            yield
        outcome, self.outcome = self.outcome, None
        return outcome


class FakeNode:
    """Writes down what it is asked; fails where the test says, and awaits each callback's end."""

    full_name = "/camera"

    def __init__(self) -> None:
        self.did: list[str] = []
        self.reports: list[Result] = []
        self.changes: list[tuple[NodeState, Transition | None]] = []
        self.fail: dict[str, Exception] = {}
        self.callbacks: dict[str, Callable[..., Any]] = {}
        self.answer = Answer()
        self.running: CoroutineType[Any, Any, Result] | None = None
        self.result: Result | None = None
        do = self._do
        self.data_layer = SimpleNamespace(
            make=lambda: do("make"), undo=lambda: do("undo"), remove=lambda: do("remove")
        )
        self.timers: dict[Callable[[], None], float] = {}
        self.turns = SimpleNamespace(call_after=self._call_after, wake=lambda: None)
        self.gate = SimpleNamespace(open=lambda: do("open"), close=lambda: do("close"))
        self.machine = Machine(self, Timeouts())

    def _do(self, what: str) -> None:
        self.did.append(what)
        if what in self.fail:
            raise self.fail[what]

    def _call_after(self, delay_s: float, callback: Callable[[], None]) -> Callable[[], None]:
        self.timers[callback] = delay_s

        def call_off() -> None:
            del self.timers[callback]

        return call_off

    def prepare(self) -> None:
        self._do("prepare")

    def unprepare(self) -> None:
        self._do("unprepare")

    def take_down(self) -> None:
        self._do("take-down")

    def may_activate(self) -> bool:
        self._do("may?")
        return True

    def changed(self, state: NodeState, event: Transition | None) -> None:
        self.changes.append((state, event))

    def callback(self, name: str) -> Callable[..., Any]:
        self.did.append(name)
        return self.callbacks.get(name, self._answered)

    async def _answered(self) -> Any:
        return await self.answer

    def callback_argument(self, state: NodeState) -> object:
        return state

    def report(self, result: Result) -> None:
        self.reports.append(result)

    # What the tests do with it.

    def request(self, request: str) -> None:
        """Ask for a transition, and run it until its callback waits."""
        running: Any = self.machine.change(request)
        self._go_on(running)

    def finish(self, outcome: CallbackOutcome) -> None:
        """Have the callback that waits return."""
        assert self.running is not None
        self.answer.outcome = outcome
        self._go_on(self.running)

    def _go_on(self, running: CoroutineType[Any, Any, Result]) -> None:
        try:
            running.send(None)
            self.running = running
        except StopIteration as stop:
            self.running, self.result = None, stop.value

    def follow(self, story: str) -> None:
        """Take requests and outcomes, in order."""
        for step in story.split():
            if step in OUTCOMES:
                self.finish(OUTCOMES[step])
            else:
                self.request(step)


OUTCOMES = {"OK": OK, "FAILURE": FAILURE, "ERROR": ERROR}


def node_in(state: NodeState) -> FakeNode:
    """Return a node that was brought to `state`."""
    node = FakeNode()
    node.follow(PATHS[state])
    assert node.machine.state is state
    node.did.clear()
    node.changes.clear()
    return node


def ended(coroutine: Coroutine[Any, Any, Result], *, turns: int = 5) -> Result:
    for _ in range(turns):
        try:
            coroutine.send(None)
        except StopIteration as stop:  # noqa: PERF203
            result: Result = stop.value
            return result
    raise AssertionError("still running")


@pytest.mark.parametrize("state", NodeState)
@pytest.mark.parametrize("request_", REQUESTS)
def test_every_state_takes_or_refuses_every_request_as_the_table_says(
    state: NodeState, request_: str
) -> None:
    node = node_in(state)
    goal = TAKEN.get((state, request_))
    if goal is None:
        with pytest.raises(RefusedError, match=f"^cannot {request_} "):
            node.request(request_)
        assert node.machine.state is state
        assert node.did == []
    else:
        node.request(request_)
        assert node.machine.state is goal


@pytest.mark.parametrize("state", [each for each in NodeState if not each.steady])
@pytest.mark.parametrize("outcome", CallbackOutcome)
def test_every_transition_state_goes_on_by_every_outcome_as_the_table_says(
    state: NodeState, outcome: CallbackOutcome
) -> None:
    node = node_in(state)
    node.finish(outcome)
    assert node.machine.state is FINISHED.get((state, outcome), S.ERRORPROCESSING)


@pytest.mark.parametrize(
    ("state", "asked", "did"),
    [
        (S.UNCONFIGURED, "configure", "prepare on_configure"),
        (S.INACTIVE_DISCONNECTED, "connect", "make on_connect"),
        (S.INACTIVE_DISCONNECTED, "activate", "may? make on_connect on_activate open"),
        (S.INACTIVE_CONNECTED, "activate", "may? on_activate open"),
        (S.ACTIVE, "deactivate", "close on_deactivate"),
        (S.INACTIVE_CONNECTED, "disconnect", "on_disconnect remove"),
        (S.INACTIVE_DISCONNECTED, "cleanup", "on_cleanup unprepare"),
        (S.INACTIVE_CONNECTED, "cleanup", "on_disconnect remove on_cleanup unprepare"),
        (S.UNCONFIGURED, "shutdown", "on_shutdown take-down"),
        (S.ACTIVE, "shutdown", "close on_shutdown take-down"),
    ],
)
def test_a_transition_does_these_things_in_this_order(
    state: NodeState, asked: str, did: str
) -> None:
    node = node_in(state)
    node.request(asked)
    while node.running is not None:
        node.finish(OK)
    assert node.result is not None
    assert node.result.outcome is OK
    assert node.did == did.split()


@pytest.mark.parametrize("asked", ["deactivate", "shutdown"])
def test_nothing_is_sent_any_more_once_the_end_of_being_active_is_announced(asked: str) -> None:
    node = node_in(S.ACTIVE)
    announced: list[int] = []
    node.gate.close = lambda: announced.append(len(node.changes))
    node.machine = Machine(node, Timeouts())
    node.follow(f"{PATHS[S.ACTIVE]} {asked}")
    assert announced == [len(node.changes) - 1]


@pytest.mark.parametrize(
    ("state", "asked", "did", "goal"),
    [
        (S.UNCONFIGURED, "configure", "prepare on_configure unprepare", S.UNCONFIGURED),
        (S.INACTIVE_DISCONNECTED, "connect", "make on_connect undo", S.INACTIVE_DISCONNECTED),
        (
            S.INACTIVE_DISCONNECTED,
            "activate",
            "may? make on_connect on_activate",
            S.INACTIVE_CONNECTED,
        ),
        (S.INACTIVE_CONNECTED, "disconnect", "on_disconnect", S.INACTIVE_CONNECTED),
        (
            S.INACTIVE_CONNECTED,
            "cleanup",
            "on_disconnect remove on_cleanup",
            S.INACTIVE_DISCONNECTED,
        ),
        (S.ACTIVE, "deactivate", "close on_deactivate open", S.ACTIVE),
        (S.ACTIVE, "shutdown", "close on_shutdown take-down", S.FINALIZED),
    ],
)
def test_a_failure_undoes_its_own_step_and_no_other(
    state: NodeState, asked: str, did: str, goal: NodeState
) -> None:
    node = node_in(state)
    node.callbacks[f"on_{asked}"] = lambda: FAILURE
    node.request(asked)
    while node.running is not None:
        node.finish(OK)
    assert node.result == Result(outcome=FAILURE, error=f"/camera: on_{asked} returned FAILURE")
    assert node.did == did.split()
    assert node.machine.state is goal


@pytest.mark.parametrize("answer", CallbackOutcome)
@pytest.mark.parametrize(
    ("state", "request_"),
    [
        (S.UNCONFIGURED, "configure"),
        (S.INACTIVE_DISCONNECTED, "connect"),
        (S.INACTIVE_CONNECTED, "activate"),
    ],
)
def test_an_error_runs_on_error_and_takes_everything_down(
    state: NodeState, request_: str, answer: CallbackOutcome
) -> None:
    node = node_in(state)
    node.callbacks[f"on_{request_}"] = lambda: ERROR
    node.request(request_)
    node.finish(answer)
    assert node.result is not None
    assert node.result.error == f"/camera: on_{request_} returned ERROR"
    assert node.did[-2:] == ["on_error", "take-down"]
    ends = S.UNCONFIGURED if answer is OK else S.FINALIZED
    assert node.machine.state is ends


@pytest.mark.parametrize(
    ("what", "state", "asked", "doing"),
    [
        ("prepare", S.UNCONFIGURED, "configure", "configuring"),
        ("make", S.INACTIVE_DISCONNECTED, "connect", "inactive/connecting"),
        ("open", S.INACTIVE_CONNECTED, "activate", "activating/connected"),
        ("remove", S.INACTIVE_CONNECTED, "disconnect", "inactive/disconnecting"),
        ("unprepare", S.INACTIVE_DISCONNECTED, "cleanup", "cleaningup/disconnected"),
    ],
)
def test_a_bug_of_ours_is_an_error_and_not_a_stuck_node(
    what: str, state: NodeState, asked: str, doing: str
) -> None:
    node = node_in(state)
    node.fail[what] = ZeroDivisionError("ours")
    node.request(asked)
    while node.running is not None:
        node.finish(OK)
    assert node.result is not None
    assert node.result.outcome is ERROR
    assert node.result.error == f"cannot finish {doing} of /camera: ZeroDivisionError('ours')"
    assert node.machine.state is S.UNCONFIGURED


@pytest.mark.parametrize(
    ("asked", "did"), [("connect", "make undo"), ("activate", "may? make undo")]
)
def test_what_cannot_be_made_is_a_failure_of_its_step_alone(asked: str, did: str) -> None:
    node = node_in(S.INACTIVE_DISCONNECTED)
    node.fail["make"] = LifecycleError("no such transport")
    node.request(asked)
    assert node.result == Result(outcome=FAILURE, error="no such transport")
    assert node.did == did.split()
    assert node.machine.state is S.INACTIVE_DISCONNECTED


def test_a_condition_that_refuses_leaves_the_node_as_it_is() -> None:
    node = node_in(S.INACTIVE_CONNECTED)
    node.fail["may?"] = RefusedError("the gate is closed")
    with pytest.raises(RefusedError, match="the gate is closed"):
        node.request("activate")
    assert node.machine.state is S.INACTIVE_CONNECTED
    assert node.changes == []


def test_a_callback_has_until_its_deadline() -> None:
    node = node_in(S.CONNECTING)
    node.callbacks["on_error"] = lambda: OK
    ((late, delay_s),) = node.timers.items()
    assert delay_s == Timeouts().connect_s
    late()
    assert node.running is not None
    result = ended(node.running)
    assert result.outcome is ERROR
    assert result.error == "cannot finish /camera: on_connect within its deadline of 10 s"
    assert node.timers == {}


def test_shutting_down_cancels_what_runs_first() -> None:
    node = node_in(S.CONFIGURING)
    node.callbacks["on_error"] = node.callbacks["on_shutdown"] = lambda: OK
    ending = node.machine.shut_down("the supervisor has gone")
    ending.send(None)
    assert node.running is not None
    assert ended(node.running).error == (
        "cannot go on with /camera: on_configure: the supervisor has gone"
    )
    assert ended(ending).outcome is OK
    assert node.machine.state is S.FINALIZED


def test_shutting_down_a_finalized_node_is_done_already() -> None:
    node = node_in(S.FINALIZED)
    assert ended(node.machine.shut_down("again")).outcome is OK
    assert node.did == []


def test_a_refusal_says_what_is_allowed() -> None:
    with pytest.raises(RefusedError) as refused:
        node_in(S.ACTIVE).request("configure")
    assert str(refused.value) == (
        "cannot configure in state 'active'; allowed here: deactivate, shutdown"
    )


def test_a_refusal_during_a_transition_says_to_wait() -> None:
    with pytest.raises(RefusedError) as refused:
        node_in(S.ACTIVATING_CONNECTED).request("shutdown")
    assert str(refused.value) == (
        "cannot shutdown while the node is 'activating/connected': "
        "one transition at a time; ask again when it has ended"
    )


@pytest.mark.parametrize(
    ("state", "story", "announced"),
    [
        (
            S.INACTIVE_DISCONNECTED,
            "connect OK disconnect OK",
            [(120, "connect inactive inactive"), (121, "disconnect inactive inactive")],
        ),
        (S.CONNECTING, "FAILURE", []),
        (S.CONNECTING, "ERROR", [(0, " inactive errorprocessing")]),
        (
            S.INACTIVE_DISCONNECTED,
            "activate OK OK",
            [(3, "activate inactive activating"), (30, "transition_success activating active")],
        ),
    ],
)
def test_what_is_announced_starts_and_ends_in_states_that_rcl_has(
    state: NodeState, story: str, announced: list[tuple[int, str]]
) -> None:
    node = node_in(state)
    node.follow(story)
    events = [event for _, event in node.changes if event is not None]
    assert [(e.id, f"{e.label} {e.start.label} {e.goal.label}") for e in events] == announced


@pytest.mark.parametrize(
    ("state", "labels"),
    [
        (S.UNCONFIGURED, ["configure", "shutdown"]),
        (S.INACTIVE_DISCONNECTED, ["cleanup", "activate", "shutdown", "connect"]),
        (S.INACTIVE_CONNECTED, ["cleanup", "activate", "shutdown", "disconnect"]),
        (S.CONNECTING, []),
        (S.ACTIVE, ["deactivate", "shutdown"]),
        (S.FINALIZED, []),
        (
            S.CONFIGURING,
            ["transition_success", "transition_failure", "transition_error"],
        ),
    ],
)
def test_available_transitions_are_what_can_be_asked_for_here(
    state: NodeState, labels: list[str]
) -> None:
    assert [t.label for t in node_in(state).machine.available_transitions()] == labels


def test_nobody_outside_may_finish_a_transition() -> None:
    machine = node_in(S.CONFIGURING).machine
    assert machine.resolve(10) is None
    assert machine.resolve(0, "transition_success") is None


class Walk(RuleBasedStateMachine):
    """Any sequence of requests and outcomes keeps the machine on its table."""

    def __init__(self) -> None:
        super().__init__()
        self.node = FakeNode()

    @property
    def state(self) -> NodeState:
        return self.node.machine.state

    @rule(request=st.sampled_from(REQUESTS))
    def ask(self, request: str) -> None:
        before, count = self.state, len(self.node.changes)
        try:
            self.node.request(request)
        except RefusedError:
            assert (before, request) not in TAKEN
            assert self.state is before
            assert len(self.node.changes) == count
        else:
            assert self.state is TAKEN[before, request]

    @precondition(lambda self: not self.state.steady)
    @rule(outcome=st.sampled_from(CallbackOutcome))
    def finish(self, outcome: CallbackOutcome) -> None:
        before = self.state
        self.node.finish(outcome)
        assert self.state is FINISHED.get((before, outcome), S.ERRORPROCESSING)

    @invariant()
    def the_last_change_is_the_state(self) -> None:
        states = [S.UNCONFIGURED, *(state for state, _ in self.node.changes)]
        assert states[-1] is self.state

    @invariant()
    def events_follow_the_seen_state(self) -> None:
        seen = "unconfigured"
        for _, event in self.node.changes:
            if event is not None:
                assert event.start.label == seen
                seen = event.goal.label
        assert seen == self.state.seen.label

    @invariant()
    def the_gate_is_open_exactly_while_it_is_active(self) -> None:
        gate = [each for each in self.node.did if each in ("open", "close")]
        assert (gate[-1:] == ["open"]) == (self.state is S.ACTIVE)

    @invariant()
    def what_is_available_is_what_is_taken(self) -> None:
        if self.state.steady:
            offered = [t.label for t in self.node.machine.available_transitions()]
            allowed = self.node.machine.allowed().split(", ")
            assert sorted(offered or ["nothing"]) == sorted(allowed)


TestWalk = Walk.TestCase
