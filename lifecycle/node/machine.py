"""The state machine of a node: one table of states and transitions, and what runs in each.

States, transitions, their ids and labels are those of lifecycle_msgs and of rcl_lifecycle's
default_state_machine.c, with connect nested inside inactive. Whatever happens to a node happens in
a row of `TABLE`, or in the author's callback between two of them. Knows no rclpy.

A transition has two halves, as in rcl: a *request* moves a primary state into a transition state
(`unconfigured` → `configuring`), and the callback's *outcome* moves it on.
"""

from __future__ import annotations

import enum
import functools
import operator
import threading
import traceback
from collections.abc import Callable, Generator, Iterable
from typing import Any

import msgspec
import transitions

from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import Timeouts
from lifecycle.node.callbacks import (
    SUCCESS,
    CallbackOutcome,
    DeadlineError,
    Result,
    Running,
    called,
    result_of,
)
from lifecycle.node.handlers import alternatives


class State(msgspec.Struct, frozen=True, kw_only=True):
    """A state as other tools see it (lifecycle_msgs/State)."""

    id: int
    label: str


AVAILABLE_STATES = (
    State(id=0, label="unknown"),
    State(id=1, label="unconfigured"),
    State(id=2, label="inactive"),
    State(id=3, label="active"),
    State(id=4, label="finalized"),
    State(id=10, label="configuring"),
    State(id=11, label="cleaningup"),
    State(id=12, label="shuttingdown"),
    State(id=13, label="activating"),
    State(id=14, label="deactivating"),
    State(id=15, label="errorprocessing"),
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
        return self not in CALLBACKS


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


REQUESTS = (
    "configure",
    "connect",
    "activate",
    "deactivate",
    "disconnect",
    "cleanup",
    "shutdown",
)
"""What may be asked of a node, by the labels that other tools use."""


class Transition(msgspec.Struct, frozen=True, kw_only=True):
    """One edge of the transition graph (lifecycle_msgs/TransitionDescription)."""

    id: int
    label: str
    start: State
    goal: State


class Row(msgspec.Struct, frozen=True):
    """One line of the table; methods are those of the node's managed half, or of a part of it.

    Attributes:
        id: of the edge that other tools see; 0 where they see none.
        trigger: a request or an outcome.
        condition: method that must be true, or raises RefusedError.
        before: method that is called before the state changes.
        after: method that is called once the state has changed.
    """

    id: int
    trigger: str
    source: NodeState
    goal: NodeState
    condition: str = ""
    before: str = ""
    after: str = ""


_S = NodeState
_OK, _FAILURE, _ERROR = (outcome.value for outcome in CallbackOutcome)

TABLE = (
    Row(1, "configure", _S.UNCONFIGURED, _S.CONFIGURING, after="prepare"),
    Row(10, _OK, _S.CONFIGURING, _S.INACTIVE_DISCONNECTED),
    Row(11, _FAILURE, _S.CONFIGURING, _S.UNCONFIGURED, before="unprepare"),
    Row(12, _ERROR, _S.CONFIGURING, _S.ERRORPROCESSING),
    Row(2, "cleanup", _S.INACTIVE_CONNECTED, _S.CLEANINGUP_CONNECTED),
    Row(0, _OK, _S.CLEANINGUP_CONNECTED, _S.CLEANINGUP_DISCONNECTED, before="data_layer.remove"),
    Row(2, "cleanup", _S.INACTIVE_DISCONNECTED, _S.CLEANINGUP_DISCONNECTED),
    Row(20, _OK, _S.CLEANINGUP_DISCONNECTED, _S.UNCONFIGURED, before="unprepare"),
    Row(21, _FAILURE, _S.CLEANINGUP_CONNECTED, _S.INACTIVE_CONNECTED),
    Row(21, _FAILURE, _S.CLEANINGUP_DISCONNECTED, _S.INACTIVE_DISCONNECTED),
    Row(22, _ERROR, _S.CLEANINGUP_CONNECTED, _S.ERRORPROCESSING),
    Row(22, _ERROR, _S.CLEANINGUP_DISCONNECTED, _S.ERRORPROCESSING),
    Row(
        3,
        "activate",
        _S.INACTIVE_DISCONNECTED,
        _S.ACTIVATING_DISCONNECTED,
        condition="may_activate",
        after="data_layer.make",
    ),
    Row(0, _OK, _S.ACTIVATING_DISCONNECTED, _S.ACTIVATING_CONNECTED),
    Row(3, "activate", _S.INACTIVE_CONNECTED, _S.ACTIVATING_CONNECTED, condition="may_activate"),
    Row(30, _OK, _S.ACTIVATING_CONNECTED, _S.ACTIVE, before="gate.open"),
    Row(
        31,
        _FAILURE,
        _S.ACTIVATING_DISCONNECTED,
        _S.INACTIVE_DISCONNECTED,
        before="data_layer.undo",
    ),
    Row(31, _FAILURE, _S.ACTIVATING_CONNECTED, _S.INACTIVE_CONNECTED),
    Row(32, _ERROR, _S.ACTIVATING_DISCONNECTED, _S.ERRORPROCESSING),
    Row(32, _ERROR, _S.ACTIVATING_CONNECTED, _S.ERRORPROCESSING),
    Row(4, "deactivate", _S.ACTIVE, _S.DEACTIVATING, before="gate.close"),
    Row(40, _OK, _S.DEACTIVATING, _S.INACTIVE_CONNECTED),
    Row(41, _FAILURE, _S.DEACTIVATING, _S.ACTIVE, before="gate.open"),
    Row(42, _ERROR, _S.DEACTIVATING, _S.ERRORPROCESSING),
    Row(5, "shutdown", _S.UNCONFIGURED, _S.SHUTTINGDOWN),
    Row(6, "shutdown", _S.INACTIVE_DISCONNECTED, _S.SHUTTINGDOWN),
    Row(6, "shutdown", _S.INACTIVE_CONNECTED, _S.SHUTTINGDOWN),
    Row(7, "shutdown", _S.ACTIVE, _S.SHUTTINGDOWN, before="gate.close"),
    Row(50, _OK, _S.SHUTTINGDOWN, _S.FINALIZED, before="take_down"),
    Row(51, _FAILURE, _S.SHUTTINGDOWN, _S.FINALIZED, before="take_down"),
    Row(52, _ERROR, _S.SHUTTINGDOWN, _S.ERRORPROCESSING),
    # Whatever on_error says, the node ends with no endpoints.
    Row(60, _OK, _S.ERRORPROCESSING, _S.UNCONFIGURED, before="take_down"),
    Row(61, _FAILURE, _S.ERRORPROCESSING, _S.FINALIZED, before="take_down"),
    Row(62, _ERROR, _S.ERRORPROCESSING, _S.FINALIZED, before="take_down"),
    # Ours: seen from outside the node stays inactive. The ids are free in lifecycle_msgs.
    Row(120, "connect", _S.INACTIVE_DISCONNECTED, _S.CONNECTING, after="data_layer.make"),
    Row(120, _OK, _S.CONNECTING, _S.INACTIVE_CONNECTED),
    Row(0, _FAILURE, _S.CONNECTING, _S.INACTIVE_DISCONNECTED, before="data_layer.undo"),
    Row(0, _ERROR, _S.CONNECTING, _S.ERRORPROCESSING),
    Row(121, "disconnect", _S.INACTIVE_CONNECTED, _S.DISCONNECTING),
    Row(121, _OK, _S.DISCONNECTING, _S.INACTIVE_DISCONNECTED, before="data_layer.remove"),
    Row(0, _FAILURE, _S.DISCONNECTING, _S.INACTIVE_CONNECTED),
    Row(0, _ERROR, _S.DISCONNECTING, _S.ERRORPROCESSING),
)
"""Every transition of a node, in the order of rcl_lifecycle's map (default_state_machine.c).

To activate from disconnected, or to clean up from connected, takes the callback of connect or
disconnect first; others see one transition.
"""

CALLBACKS = {
    _S.CONFIGURING: ("on_configure", "configure_s"),
    _S.CONNECTING: ("on_connect", "connect_s"),
    _S.ACTIVATING_DISCONNECTED: ("on_connect", "connect_s"),
    _S.ACTIVATING_CONNECTED: ("on_activate", "activate_s"),
    _S.DEACTIVATING: ("on_deactivate", "deactivate_s"),
    _S.DISCONNECTING: ("on_disconnect", "connect_s"),
    _S.CLEANINGUP_CONNECTED: ("on_disconnect", "connect_s"),
    _S.CLEANINGUP_DISCONNECTED: ("on_cleanup", "cleanup_s"),
    _S.SHUTTINGDOWN: ("on_shutdown", "shutdown_s"),
    _S.ERRORPROCESSING: ("on_error", "cleanup_s"),
}
"""The author's method that each transition state runs, and its deadline."""

_BY_ID = {
    row.id: Transition(id=row.id, label=row.trigger, start=row.source.seen, goal=row.goal.seen)
    for row in reversed(TABLE)  # of several rows the first one names the edge
    if row.id
}
TRANSITION_GRAPH = tuple(_BY_ID[each] for each in dict.fromkeys(row.id for row in TABLE) if each)
"""In the order in which rcl_lifecycle answers get_transition_graph; connect and disconnect last."""


class RefusedError(LifecycleError):
    """A request that is not allowed in this state; the node lives on unchanged."""


class Machine:
    """The state of one node, and its transitions, run one at a time.

    Args:
        node: has the methods that the table names, and what the author's callbacks need:
            managed.Managed.
        table: TABLE; tests take lines out.

    Attributes:
        state: the current state, written by `transitions` alone.
        is_permitted: the request that is looked at comes through the supervisor's gate.
    """

    def __init__(self, node: Any, timeouts: Timeouts, table: Iterable[Row] = TABLE) -> None:
        self.state = NodeState.UNCONFIGURED
        self.is_permitted = False
        self._node = node
        self._timeouts = timeouts
        self._lock = threading.Lock()
        self._running: Running | None = None
        self._what = ""
        self._machine = transitions.Machine(
            model=None, states=NodeState, initial=self.state, auto_transitions=False
        )

        def methods(name: str) -> list[str | Callable[..., bool | None]]:
            return [operator.attrgetter(name)(node)] if name else []

        for row in table:
            self._machine.add_transition(
                row.trigger,
                row.source,
                row.goal,
                conditions=methods(row.condition),
                before=methods(row.before),
                after=[functools.partial(self._announce, row), *methods(row.after)],
            )

    def allowed(self) -> str:
        """Say which requests are taken now."""
        triggers = self._machine.get_triggers(self.state.name)
        return ", ".join(each for each in REQUESTS if each in triggers) or "nothing"

    def available_transitions(self) -> tuple[Transition, ...]:
        """What get_available_transitions answers: rcl's edges from the state that others see.

        From connected, disconnect is offered, and from disconnected, connect.
        """
        if self.state in {NodeState.CONNECTING, NodeState.DISCONNECTING}:
            return ()
        hidden = "connect" if self.state.connected else "disconnect"
        seen = self.state.seen
        return tuple(t for t in TRANSITION_GRAPH if t.start == seen and t.label != hidden)

    def resolve(self, transition_id: int, label: str = "") -> str | None:
        """Return what a ChangeState request means here; None if this state does not offer it.

        A label wins over the id, as in rcl_lifecycle.
        """
        for transition in self.available_transitions():
            if transition.label == label if label else transition.id == transition_id:
                # Outcomes are edges too, but only the node itself may take them.
                return transition.label if transition.label in REQUESTS else None
        return None

    async def change(self, request: str, *, permitted: bool = False) -> Result:
        """Run a whole transition, `permitted` by the supervisor or not.

        Returns:
            SUCCESS, or the first step's result that was not: after an ERROR, on_error has run and
            the node is unconfigured or finalized.

        Raises:
            RefusedError: not allowed in this state, or another transition is running.
            LifecycleError: no such transition.
        """
        if request not in REQUESTS:
            raise LifecycleError(
                f"cannot take transition {request!r}", hint=alternatives(request, REQUESTS)
            )
        with self._lock:
            argument = self._node.callback_argument(self.state)
            self.is_permitted = permitted
            try:
                result = self._take(request)
            except transitions.MachineError as error:
                raise RefusedError(self._refusal(request)) from error
        returned = self._reported(result, SUCCESS)
        while not self.state.steady:
            if result.outcome is CallbackOutcome.SUCCESS:
                result = await self._callback(argument)
                returned = self._reported(result, returned)
            with self._lock:
                result = self._take(result.outcome.value)
            returned = self._reported(result, returned)
        self._node.turns.wake()
        return returned

    async def shut_down(self, reason: str) -> Result:
        """Bring the node to finalized from any state; a running async callback is cancelled."""
        if not self.state.steady:
            self._interrupt(LifecycleError(f"cannot go on with {self._what}: {reason}"))
            while not self.state.steady:
                await _NextTurn()
        if self.state is NodeState.FINALIZED:
            return SUCCESS
        return await self.change("shutdown")

    def _take(self, trigger: str) -> Result:
        """Change the state by a row of the table, with what the row runs.

        What the row of a request cannot do is a failure, as if the callback said so.
        """
        state = self.state
        try:
            self._machine.events[trigger].trigger(self)
        except (transitions.MachineError, RefusedError):
            raise
        except Exception as error:  # noqa: BLE001 - reported with its traceback, then ERROR
            if state.steady and isinstance(error, LifecycleError):
                return Result(outcome=CallbackOutcome.FAILURE, error=str(error))
            name = self._node.full_name
            return Result(
                outcome=CallbackOutcome.ERROR,
                error=f"cannot finish {self.state.value} of {name}: {error!r}",
                trace=traceback.format_exc(),
            )
        return SUCCESS

    def _reported(self, result: Result, returned: Result) -> Result:
        """Log what did not succeed; return the first that did not."""
        if result.outcome is CallbackOutcome.SUCCESS:
            return returned
        self._node.report(result)
        return returned if returned.error else result

    async def _callback(self, argument: object) -> Result:
        """Run the author's callback of the present state."""
        name, limit = CALLBACKS[self.state]
        deadline_s: float = getattr(self._timeouts, limit)
        what = f"{self._node.full_name}: {name}"
        late = DeadlineError(f"cannot finish {what} within its deadline of {deadline_s:g} s")
        running = Running(called(self._node.callback(name), argument))
        self._running, self._what = running, what
        call_off = self._node.turns.call_after(deadline_s, lambda: self._interrupt(late))
        try:
            return await result_of(running, what=what, deadline_s=deadline_s)
        finally:
            self._running = None
            call_off()

    def _interrupt(self, error: LifecycleError) -> None:
        """Stop the author's callback that runs; its task is resumed for the last time."""
        if self._running is not None:
            self._running.interrupt(error)
        self._node.turns.wake()

    def _refusal(self, request: str) -> str:
        if not self.state.steady:
            return (
                f"cannot {request} while the node is {self.state.value!r}: "
                "one transition at a time; ask again when it has ended"
            )
        return f"cannot {request} in state {self.state.value!r}; allowed here: {self.allowed()}"

    def _announce(self, row: Row) -> None:
        """Say what was changed; connect and disconnect are seen once they have succeeded."""
        start, goal = row.source.seen, row.goal.seen
        event = None
        if start != goal or (row.id and row.trigger == _OK):
            # An error inside connect leaves inactive by no edge of rcl's.
            event = _BY_ID.get(row.id, Transition(id=0, label="", start=start, goal=goal))
        self._node.changed(row.goal, event)


class _NextTurn:
    """Awaits that the executor wakes again."""

    def __await__(self) -> Generator[None, None, None]:
        yield
