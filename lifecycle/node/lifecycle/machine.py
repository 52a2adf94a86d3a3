"""The one state machine of a node: rcl_lifecycle's states, with connect nested inside inactive.

Owns: states, transitions, their ids and labels (lifecycle_msgs/State, lifecycle_msgs/Transition,
rcl_lifecycle's default_state_machine.c), what is allowed when, and the `transitions` machine
behind typed methods. Pure: knows no rclpy, runs no callback, keeps no time.

A transition has two halves, as in rcl: a *request* moves a primary state into a transition state
(`unconfigured` → `configuring`), and the callback's *outcome* moves it on. The data layer
(connected or not) is part of the state, so nothing else needs to remember it.
"""

from __future__ import annotations

import enum
from collections.abc import Callable

import msgspec
import transitions

from lifecycle.errors import LifecycleError


class State(msgspec.Struct, frozen=True, kw_only=True):
    """A state as other tools see it (lifecycle_msgs/State)."""

    id: int
    label: str


UNKNOWN = State(id=0, label="unknown")
UNCONFIGURED = State(id=1, label="unconfigured")
INACTIVE = State(id=2, label="inactive")
ACTIVE = State(id=3, label="active")
FINALIZED = State(id=4, label="finalized")
CONFIGURING = State(id=10, label="configuring")
CLEANINGUP = State(id=11, label="cleaningup")
SHUTTINGDOWN = State(id=12, label="shuttingdown")
ACTIVATING = State(id=13, label="activating")
DEACTIVATING = State(id=14, label="deactivating")
ERRORPROCESSING = State(id=15, label="errorprocessing")

AVAILABLE_STATES = (
    UNKNOWN,
    UNCONFIGURED,
    INACTIVE,
    ACTIVE,
    FINALIZED,
    CONFIGURING,
    CLEANINGUP,
    SHUTTINGDOWN,
    ACTIVATING,
    DEACTIVATING,
    ERRORPROCESSING,
)
"""In the order in which rcl_lifecycle answers get_available_states."""


class NodeState(enum.Enum):
    """Every state of a node: rcl's, split by whether the data layer is made where both happen."""

    UNCONFIGURED = "unconfigured"
    CONFIGURING = "configuring"
    INACTIVE_DISCONNECTED = "inactive/disconnected"
    CONNECTING = "inactive/connecting"
    INACTIVE_CONNECTED = "inactive/connected"
    DISCONNECTING = "inactive/disconnecting"
    ACTIVATING_DISCONNECTED = "activating/disconnected"
    ACTIVATING_CONNECTED = "activating/connected"
    ACTIVE = "active"
    DEACTIVATING = "deactivating"
    CLEANINGUP_DISCONNECTED = "cleaningup/disconnected"
    CLEANINGUP_CONNECTED = "cleaningup/connected"
    SHUTTINGDOWN = "shuttingdown"
    ERRORPROCESSING = "errorprocessing"
    FINALIZED = "finalized"

    @property
    def seen(self) -> State:
        """The state as every other tool sees it."""
        return _SEEN[self.value.partition("/")[0]]

    @property
    def connected(self) -> bool:
        """The data layer is made: endpoints exist."""
        return self in _CONNECTED

    @property
    def steady(self) -> bool:
        """A state that a node may stay in, where requests are taken."""
        return self in _STEADY


_SEEN = {state.label: state for state in AVAILABLE_STATES}
_CONNECTED = frozenset(
    {
        NodeState.INACTIVE_CONNECTED,
        NodeState.DISCONNECTING,
        NodeState.ACTIVATING_CONNECTED,
        NodeState.ACTIVE,
        NodeState.DEACTIVATING,
        NodeState.CLEANINGUP_CONNECTED,
    }
)
_STEADY = frozenset(
    {
        NodeState.UNCONFIGURED,
        NodeState.INACTIVE_DISCONNECTED,
        NodeState.INACTIVE_CONNECTED,
        NodeState.ACTIVE,
        NodeState.FINALIZED,
    }
)


class CallbackOutcome(enum.Enum):
    """The outcome of a transition callback; values are rcl_lifecycle's transition labels."""

    SUCCESS = "transition_success"
    FAILURE = "transition_failure"
    ERROR = "transition_error"


class TransitionRequest(enum.Enum):
    """What may be asked of a node; values are the labels that other tools use."""

    CONFIGURE = "configure"
    CONNECT = "connect"
    ACTIVATE = "activate"
    DEACTIVATE = "deactivate"
    DISCONNECT = "disconnect"
    CLEANUP = "cleanup"
    SHUTDOWN = "shutdown"


class Transition(msgspec.Struct, frozen=True, kw_only=True):
    """One edge of the transition graph (lifecycle_msgs/TransitionDescription)."""

    id: int
    label: str
    start: State
    goal: State


def _edges() -> tuple[Transition, ...]:
    """Return rcl_lifecycle's transition map in its order, then connect and disconnect."""
    ok, failure, error = (outcome.value for outcome in CallbackOutcome)
    rows: tuple[tuple[int, str, State, State], ...] = (
        (1, "configure", UNCONFIGURED, CONFIGURING),
        (10, ok, CONFIGURING, INACTIVE),
        (11, failure, CONFIGURING, UNCONFIGURED),
        (12, error, CONFIGURING, ERRORPROCESSING),
        (2, "cleanup", INACTIVE, CLEANINGUP),
        (20, ok, CLEANINGUP, UNCONFIGURED),
        (21, failure, CLEANINGUP, INACTIVE),
        (22, error, CLEANINGUP, ERRORPROCESSING),
        (3, "activate", INACTIVE, ACTIVATING),
        (30, ok, ACTIVATING, ACTIVE),
        (31, failure, ACTIVATING, INACTIVE),
        (32, error, ACTIVATING, ERRORPROCESSING),
        (4, "deactivate", ACTIVE, DEACTIVATING),
        (40, ok, DEACTIVATING, INACTIVE),
        (41, failure, DEACTIVATING, ACTIVE),
        (42, error, DEACTIVATING, ERRORPROCESSING),
        (5, "shutdown", UNCONFIGURED, SHUTTINGDOWN),
        (6, "shutdown", INACTIVE, SHUTTINGDOWN),
        (7, "shutdown", ACTIVE, SHUTTINGDOWN),
        (50, ok, SHUTTINGDOWN, FINALIZED),
        (51, failure, SHUTTINGDOWN, FINALIZED),
        (52, error, SHUTTINGDOWN, ERRORPROCESSING),
        (60, ok, ERRORPROCESSING, UNCONFIGURED),
        (61, failure, ERRORPROCESSING, FINALIZED),
        (62, error, ERRORPROCESSING, FINALIZED),
        # Ours: seen from outside the node stays inactive. The ids are free in lifecycle_msgs.
        (120, "connect", INACTIVE, INACTIVE),
        (121, "disconnect", INACTIVE, INACTIVE),
    )
    return tuple(Transition(id=i, label=label, start=s, goal=g) for i, label, s, g in rows)


TRANSITION_GRAPH = _edges()
"""In the order in which rcl_lifecycle answers get_transition_graph; connect and disconnect last."""

_S = NodeState
_REQUESTS: tuple[tuple[TransitionRequest, NodeState, NodeState], ...] = (
    (TransitionRequest.CONFIGURE, _S.UNCONFIGURED, _S.CONFIGURING),
    (TransitionRequest.CONNECT, _S.INACTIVE_DISCONNECTED, _S.CONNECTING),
    (TransitionRequest.DISCONNECT, _S.INACTIVE_CONNECTED, _S.DISCONNECTING),
    (TransitionRequest.ACTIVATE, _S.INACTIVE_DISCONNECTED, _S.ACTIVATING_DISCONNECTED),
    (TransitionRequest.ACTIVATE, _S.INACTIVE_CONNECTED, _S.ACTIVATING_CONNECTED),
    (TransitionRequest.DEACTIVATE, _S.ACTIVE, _S.DEACTIVATING),
    (TransitionRequest.CLEANUP, _S.INACTIVE_DISCONNECTED, _S.CLEANINGUP_DISCONNECTED),
    (TransitionRequest.CLEANUP, _S.INACTIVE_CONNECTED, _S.CLEANINGUP_CONNECTED),
    (TransitionRequest.SHUTDOWN, _S.UNCONFIGURED, _S.SHUTTINGDOWN),
    (TransitionRequest.SHUTDOWN, _S.INACTIVE_DISCONNECTED, _S.SHUTTINGDOWN),
    (TransitionRequest.SHUTDOWN, _S.INACTIVE_CONNECTED, _S.SHUTTINGDOWN),
    (TransitionRequest.SHUTDOWN, _S.ACTIVE, _S.SHUTTINGDOWN),
)
_OUTCOMES: tuple[tuple[NodeState, NodeState, NodeState, NodeState], ...] = (
    # in this state, goes on SUCCESS to, on FAILURE to, on ERROR to
    (_S.CONFIGURING, _S.INACTIVE_DISCONNECTED, _S.UNCONFIGURED, _S.ERRORPROCESSING),
    (_S.CONNECTING, _S.INACTIVE_CONNECTED, _S.INACTIVE_DISCONNECTED, _S.ERRORPROCESSING),
    (_S.DISCONNECTING, _S.INACTIVE_DISCONNECTED, _S.INACTIVE_CONNECTED, _S.ERRORPROCESSING),
    # SUCCESS while still disconnected has only made the data layer: the callback is yet to run.
    (
        _S.ACTIVATING_DISCONNECTED,
        _S.ACTIVATING_CONNECTED,
        _S.INACTIVE_DISCONNECTED,
        _S.ERRORPROCESSING,
    ),
    (_S.ACTIVATING_CONNECTED, _S.ACTIVE, _S.INACTIVE_CONNECTED, _S.ERRORPROCESSING),
    (_S.DEACTIVATING, _S.INACTIVE_CONNECTED, _S.ACTIVE, _S.ERRORPROCESSING),
    # SUCCESS while still connected has only taken the data layer away, likewise.
    (
        _S.CLEANINGUP_CONNECTED,
        _S.CLEANINGUP_DISCONNECTED,
        _S.INACTIVE_CONNECTED,
        _S.ERRORPROCESSING,
    ),
    (
        _S.CLEANINGUP_DISCONNECTED,
        _S.UNCONFIGURED,
        _S.INACTIVE_DISCONNECTED,
        _S.ERRORPROCESSING,
    ),
    (_S.SHUTTINGDOWN, _S.FINALIZED, _S.FINALIZED, _S.ERRORPROCESSING),
    (_S.ERRORPROCESSING, _S.UNCONFIGURED, _S.FINALIZED, _S.FINALIZED),
)


class StateChange(msgspec.Struct, frozen=True, kw_only=True):
    """One change of the machine.

    Attributes:
        event: the edge that other tools must receive as a lifecycle_msgs/TransitionEvent; None
            for a change inside one of their states.
    """

    start: NodeState
    goal: NodeState
    event: Transition | None


class RefusedError(LifecycleError):
    """A request that is not allowed in this state; the node lives on unchanged."""


def _make_machine() -> transitions.Machine:
    # Not queued: nothing runs inside a transition, so none can begin in another.
    machine = transitions.Machine(
        model=None, states=NodeState, initial=NodeState.UNCONFIGURED, auto_transitions=False
    )
    for request, start, goal in _REQUESTS:
        machine.add_transition(request.value, start, goal)
    for start, *goals in _OUTCOMES:
        for outcome, goal in zip(CallbackOutcome, goals, strict=True):
            machine.add_transition(outcome.value, start, goal)
    return machine


_MACHINE = _make_machine()
"""The one of all nodes, each of which is a model of it: 0.3 MiB that forked processes share."""


class _Model:
    """What `transitions` writes the state into."""

    state = NodeState.UNCONFIGURED


class LifecycleMachine:
    """The state of one node.

    Not thread-safe: the caller serialises. `on_change` is called after each change, in order.

    Example:
        >>> machine = LifecycleMachine()
        >>> machine.request(TransitionRequest.CONFIGURE)
        >>> machine.finish(CallbackOutcome.SUCCESS)
        >>> machine.state.value
        'inactive/disconnected'
    """

    def __init__(self, on_change: Callable[[StateChange], None] | None = None) -> None:
        self._on_change = on_change
        self._model = _Model()

    @property
    def state(self) -> NodeState:
        """The current state."""
        return self._model.state

    def allowed(self) -> tuple[TransitionRequest, ...]:
        """Requests that are taken now, in the order of `TransitionRequest`."""
        return tuple(
            request
            for request in TransitionRequest
            if any(r is request and start is self.state for r, start, _ in _REQUESTS)
        )

    def available_transitions(self) -> tuple[Transition, ...]:
        """What get_available_transitions answers: rcl's edges from the state that others see.

        From connected, disconnect is offered, and from disconnected, connect. While connecting or
        disconnecting nothing can be asked for, so nothing is offered.
        """
        if self.state in {NodeState.CONNECTING, NodeState.DISCONNECTING}:
            return ()
        hidden = "connect" if self.state.connected else "disconnect"
        seen = self.state.seen
        return tuple(t for t in TRANSITION_GRAPH if t.start == seen and t.label != hidden)

    def resolve(self, transition_id: int, label: str = "") -> TransitionRequest | None:
        """Return what a ChangeState request means here; None if this state does not offer it.

        A label wins over the id, as in rcl_lifecycle.
        """
        for transition in self.available_transitions():
            if transition.label == label if label else transition.id == transition_id:
                # Outcomes are edges too, but only the node itself may take them.
                return next((r for r in TransitionRequest if r.value == transition.label), None)
        return None

    def request(self, request: TransitionRequest) -> None:
        """Begin a transition.

        Raises:
            RefusedError: this state does not allow it, or a transition is running.
        """
        if request not in self.allowed():
            raise RefusedError(self._refusal(request))
        before = self.state
        _MACHINE.events[request.value].trigger(self._model)
        connecting = request in {TransitionRequest.CONNECT, TransitionRequest.DISCONNECT}
        self._announce(before, None if connecting else request.value)

    def finish(self, outcome: CallbackOutcome) -> None:
        """End the running step of a transition with the outcome of its callback.

        Raises:
            RefusedError: no transition is running.
        """
        before = self.state
        if before.steady:
            raise RefusedError(
                f"cannot finish a transition with {outcome.name}: none is running in state "
                f"{before.value!r}"
            )
        _MACHINE.events[outcome.value].trigger(self._model)
        label: str | None = outcome.value
        if before.seen == self.state.seen:
            label = None
            if outcome is CallbackOutcome.SUCCESS and before is NodeState.CONNECTING:
                label = TransitionRequest.CONNECT.value
            elif outcome is CallbackOutcome.SUCCESS and before is NodeState.DISCONNECTING:
                label = TransitionRequest.DISCONNECT.value
        self._announce(before, label)

    def _refusal(self, request: TransitionRequest) -> str:
        if not self.state.steady:
            return (
                f"cannot {request.value} while the node is {self.state.value!r}: "
                "one transition at a time; ask again when it has ended"
            )
        allowed = ", ".join(each.value for each in self.allowed()) or "nothing"
        return f"cannot {request.value} in state {self.state.value!r}; allowed here: {allowed}"

    def _announce(self, before: NodeState, label: str | None) -> None:
        event = None
        if label is not None:
            start, goal = before.seen, self.state.seen
            event = next(
                (t for t in TRANSITION_GRAPH if t.label == label and t.start == start), None
            )
            if event is None:  # an error inside connect leaves inactive by no edge of rcl's
                event = Transition(id=0, label="", start=start, goal=goal)
        if self._on_change is not None:
            self._on_change(StateChange(start=before, goal=self.state, event=event))
