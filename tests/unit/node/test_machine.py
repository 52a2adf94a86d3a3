"""The state machine: rcl's graph outside, connect inside inactive, every pair on purpose."""

from __future__ import annotations

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from lifecycle.node.lifecycle.machine import (
    TRANSITION_GRAPH,
    CallbackOutcome,
    LifecycleMachine,
    NodeState,
    RefusedError,
    StateChange,
    TransitionRequest,
)

OK, FAILURE, ERROR = CallbackOutcome.SUCCESS, CallbackOutcome.FAILURE, CallbackOutcome.ERROR

PATHS: dict[NodeState, str] = {
    NodeState.UNCONFIGURED: "",
    NodeState.CONFIGURING: "configure",
    NodeState.INACTIVE_DISCONNECTED: "configure OK",
    NodeState.CONNECTING: "configure OK connect",
    NodeState.INACTIVE_CONNECTED: "configure OK connect OK",
    NodeState.DISCONNECTING: "configure OK connect OK disconnect",
    NodeState.ACTIVATING_DISCONNECTED: "configure OK activate",
    NodeState.ACTIVATING_CONNECTED: "configure OK activate OK",
    NodeState.ACTIVE: "configure OK activate OK OK",
    NodeState.DEACTIVATING: "configure OK activate OK OK deactivate",
    NodeState.CLEANINGUP_CONNECTED: "configure OK connect OK cleanup",
    NodeState.CLEANINGUP_DISCONNECTED: "configure OK cleanup",
    NodeState.SHUTTINGDOWN: "shutdown",
    NodeState.ERRORPROCESSING: "configure ERROR",
    NodeState.FINALIZED: "shutdown OK",
}

TAKEN: dict[tuple[NodeState, TransitionRequest], NodeState] = {
    (NodeState.UNCONFIGURED, TransitionRequest.CONFIGURE): NodeState.CONFIGURING,
    (NodeState.UNCONFIGURED, TransitionRequest.SHUTDOWN): NodeState.SHUTTINGDOWN,
    (NodeState.INACTIVE_DISCONNECTED, TransitionRequest.CONNECT): NodeState.CONNECTING,
    (
        NodeState.INACTIVE_DISCONNECTED,
        TransitionRequest.ACTIVATE,
    ): NodeState.ACTIVATING_DISCONNECTED,
    (NodeState.INACTIVE_DISCONNECTED, TransitionRequest.CLEANUP): NodeState.CLEANINGUP_DISCONNECTED,
    (NodeState.INACTIVE_DISCONNECTED, TransitionRequest.SHUTDOWN): NodeState.SHUTTINGDOWN,
    (NodeState.INACTIVE_CONNECTED, TransitionRequest.DISCONNECT): NodeState.DISCONNECTING,
    (NodeState.INACTIVE_CONNECTED, TransitionRequest.ACTIVATE): NodeState.ACTIVATING_CONNECTED,
    (NodeState.INACTIVE_CONNECTED, TransitionRequest.CLEANUP): NodeState.CLEANINGUP_CONNECTED,
    (NodeState.INACTIVE_CONNECTED, TransitionRequest.SHUTDOWN): NodeState.SHUTTINGDOWN,
    (NodeState.ACTIVE, TransitionRequest.DEACTIVATE): NodeState.DEACTIVATING,
    (NodeState.ACTIVE, TransitionRequest.SHUTDOWN): NodeState.SHUTTINGDOWN,
}

FINISHED: dict[tuple[NodeState, CallbackOutcome], NodeState] = {
    (NodeState.CONFIGURING, OK): NodeState.INACTIVE_DISCONNECTED,
    (NodeState.CONFIGURING, FAILURE): NodeState.UNCONFIGURED,
    (NodeState.CONNECTING, OK): NodeState.INACTIVE_CONNECTED,
    (NodeState.CONNECTING, FAILURE): NodeState.INACTIVE_DISCONNECTED,
    (NodeState.DISCONNECTING, OK): NodeState.INACTIVE_DISCONNECTED,
    (NodeState.DISCONNECTING, FAILURE): NodeState.INACTIVE_CONNECTED,
    (NodeState.ACTIVATING_DISCONNECTED, OK): NodeState.ACTIVATING_CONNECTED,
    (NodeState.ACTIVATING_DISCONNECTED, FAILURE): NodeState.INACTIVE_DISCONNECTED,
    (NodeState.ACTIVATING_CONNECTED, OK): NodeState.ACTIVE,
    (NodeState.ACTIVATING_CONNECTED, FAILURE): NodeState.INACTIVE_CONNECTED,
    (NodeState.DEACTIVATING, OK): NodeState.INACTIVE_CONNECTED,
    (NodeState.DEACTIVATING, FAILURE): NodeState.ACTIVE,
    (NodeState.CLEANINGUP_CONNECTED, OK): NodeState.CLEANINGUP_DISCONNECTED,
    (NodeState.CLEANINGUP_CONNECTED, FAILURE): NodeState.INACTIVE_CONNECTED,
    (NodeState.CLEANINGUP_DISCONNECTED, OK): NodeState.UNCONFIGURED,
    (NodeState.CLEANINGUP_DISCONNECTED, FAILURE): NodeState.INACTIVE_DISCONNECTED,
    (NodeState.SHUTTINGDOWN, OK): NodeState.FINALIZED,
    (NodeState.SHUTTINGDOWN, FAILURE): NodeState.FINALIZED,
    (NodeState.ERRORPROCESSING, OK): NodeState.UNCONFIGURED,
    (NodeState.ERRORPROCESSING, FAILURE): NodeState.FINALIZED,
    (NodeState.ERRORPROCESSING, ERROR): NodeState.FINALIZED,
}


def machine_in(state: NodeState, changes: list[StateChange] | None = None) -> LifecycleMachine:
    """Return a machine that was brought to `state`; `changes` hears of what comes after."""
    heard: list[StateChange] = [] if changes is None else changes
    machine = LifecycleMachine(heard.append)
    for step in PATHS[state].split():
        if step in ("OK", "ERROR"):
            machine.finish(OK if step == "OK" else ERROR)
        else:
            machine.request(TransitionRequest(step))
    assert machine.state is state
    heard.clear()
    return machine


@pytest.mark.parametrize("state", NodeState)
@pytest.mark.parametrize("request_", TransitionRequest)
def test_every_state_takes_or_refuses_every_request_as_the_table_says(
    state: NodeState, request_: TransitionRequest
) -> None:
    machine = machine_in(state)
    goal = TAKEN.get((state, request_))
    if goal is None:
        with pytest.raises(RefusedError, match=f"^cannot {request_.value} "):
            machine.request(request_)
        assert machine.state is state
    else:
        machine.request(request_)
        assert machine.state is goal


@pytest.mark.parametrize("state", NodeState)
@pytest.mark.parametrize("outcome", CallbackOutcome)
def test_every_state_takes_or_refuses_every_outcome_as_the_table_says(
    state: NodeState, outcome: CallbackOutcome
) -> None:
    machine = machine_in(state)
    if state.steady:
        with pytest.raises(RefusedError, match="none is running"):
            machine.finish(outcome)
        assert machine.state is state
    else:
        machine.finish(outcome)
        default = NodeState.ERRORPROCESSING
        assert machine.state is FINISHED.get((state, outcome), default)


def test_a_refusal_says_what_is_allowed() -> None:
    machine = machine_in(NodeState.ACTIVE)
    with pytest.raises(RefusedError) as refused:
        machine.request(TransitionRequest.CONFIGURE)
    assert str(refused.value) == (
        "cannot configure in state 'active'; allowed here: deactivate, shutdown"
    )


def test_a_refusal_during_a_transition_says_to_wait() -> None:
    machine = machine_in(NodeState.ACTIVATING_CONNECTED)
    with pytest.raises(RefusedError) as refused:
        machine.request(TransitionRequest.SHUTDOWN)
    assert str(refused.value) == (
        "cannot shutdown while the node is 'activating/connected': "
        "one transition at a time; ask again when it has ended"
    )


def test_connect_and_disconnect_are_announced_once_and_leave_the_seen_state_inactive() -> None:
    changes: list[StateChange] = []
    machine = machine_in(NodeState.INACTIVE_DISCONNECTED, changes)
    for request in (TransitionRequest.CONNECT, TransitionRequest.DISCONNECT):
        machine.request(request)
        machine.finish(OK)
    events = [change.event for change in changes if change.event is not None]
    assert [(e.id, e.label, e.start.label, e.goal.label) for e in events] == [
        (120, "connect", "inactive", "inactive"),
        (121, "disconnect", "inactive", "inactive"),
    ]


def test_a_connect_that_fails_is_not_announced() -> None:
    changes: list[StateChange] = []
    machine = machine_in(NodeState.CONNECTING, changes)
    machine.finish(FAILURE)
    assert [change.event for change in changes] == [None]


def test_activating_from_disconnected_announces_what_rcl_announces_and_no_more() -> None:
    changes: list[StateChange] = []
    machine = machine_in(NodeState.INACTIVE_DISCONNECTED, changes)
    machine.request(TransitionRequest.ACTIVATE)
    machine.finish(OK)
    machine.finish(OK)
    events = [change.event for change in changes if change.event is not None]
    assert [(e.start.label, e.goal.label) for e in events] == [
        ("inactive", "activating"),
        ("activating", "active"),
    ]


def test_an_error_while_connecting_is_announced_from_inactive() -> None:
    changes: list[StateChange] = []
    machine = machine_in(NodeState.CONNECTING, changes)
    machine.finish(ERROR)
    event = changes[-1].event
    assert event is not None
    assert (event.start.label, event.goal.label) == ("inactive", "errorprocessing")


@pytest.mark.parametrize(
    ("state", "labels"),
    [
        (NodeState.UNCONFIGURED, ["configure", "shutdown"]),
        (NodeState.INACTIVE_DISCONNECTED, ["cleanup", "activate", "shutdown", "connect"]),
        (NodeState.INACTIVE_CONNECTED, ["cleanup", "activate", "shutdown", "disconnect"]),
        (NodeState.CONNECTING, []),
        (NodeState.ACTIVE, ["deactivate", "shutdown"]),
        (NodeState.FINALIZED, []),
        (
            NodeState.CONFIGURING,
            ["transition_success", "transition_failure", "transition_error"],
        ),
    ],
)
def test_available_transitions_are_what_can_be_asked_for_here(
    state: NodeState, labels: list[str]
) -> None:
    assert [t.label for t in machine_in(state).available_transitions()] == labels


def test_nobody_outside_may_finish_a_transition() -> None:
    machine = machine_in(NodeState.CONFIGURING)
    assert machine.resolve(10) is None
    assert machine.resolve(0, "transition_success") is None


def test_ids_in_the_transition_graph_are_unique() -> None:
    ids = [transition.id for transition in TRANSITION_GRAPH]
    assert len(ids) == len(set(ids))


class Walk(RuleBasedStateMachine):
    """Any sequence of requests and outcomes keeps the machine on its table."""

    def __init__(self) -> None:
        super().__init__()
        self.changes: list[StateChange] = []
        self.machine = LifecycleMachine(self.changes.append)

    @rule(request=st.sampled_from(TransitionRequest))
    def ask(self, request: TransitionRequest) -> None:
        before, heard = self.machine.state, len(self.changes)
        try:
            self.machine.request(request)
        except RefusedError:
            assert (before, request) not in TAKEN
            assert self.machine.state is before
            assert len(self.changes) == heard
        else:
            assert self.machine.state is TAKEN[before, request]

    @precondition(lambda self: not self.machine.state.steady)
    @rule(outcome=st.sampled_from(CallbackOutcome))
    def finish(self, outcome: CallbackOutcome) -> None:
        before = self.machine.state
        self.machine.finish(outcome)
        assert self.machine.state is FINISHED.get((before, outcome), NodeState.ERRORPROCESSING)

    @invariant()
    def changes_form_a_chain(self) -> None:
        goals = [NodeState.UNCONFIGURED, *(change.goal for change in self.changes)]
        assert [change.start for change in self.changes] == goals[:-1]
        assert goals[-1] is self.machine.state

    @invariant()
    def events_tell_the_seen_state(self) -> None:
        seen = "unconfigured"
        for change in self.changes:
            if change.event is not None:
                assert change.event.start.label == seen
                seen = change.event.goal.label
        assert seen == self.machine.state.seen.label

    @invariant()
    def only_a_connected_node_is_active(self) -> None:
        assert self.machine.state is not NodeState.ACTIVE or self.machine.state.connected

    @invariant()
    def what_is_available_is_what_is_taken(self) -> None:
        if self.machine.state.steady:
            offered = [t.label for t in self.machine.available_transitions()]
            assert sorted(offered) == sorted(r.value for r in self.machine.allowed())


TestWalk = Walk.TestCase
