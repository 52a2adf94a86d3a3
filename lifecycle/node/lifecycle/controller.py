"""Drives one node through its lifecycle transitions: steps, deadlines, and what undoes a step.

Owns: the order of things inside a transition (the framework's half and the user's callback), the
deadline of each, and one transition at a time. The state itself lives in the machine alone.
"""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Coroutine, Generator
from typing import Any, Protocol

from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import Timeouts
from lifecycle.node.lifecycle import execution
from lifecycle.node.lifecycle.execution import SUCCESS, Interruptible, Result
from lifecycle.node.lifecycle.machine import (
    CallbackOutcome,
    LifecycleMachine,
    NodeState,
    StateChange,
    TransitionRequest,
)


class ControlledNode(Protocol):
    """What the controller needs of a node: managed.Managed has it, and what tests drive."""

    @property
    def full_name(self) -> str:
        """Fully qualified name, for messages."""

    def prepare(self) -> None:
        """Declare parameters and endpoints; raises LifecycleError."""

    def unprepare(self) -> None:
        """Undo `prepare`."""

    def make_data_layer(self) -> None:
        """Make every endpoint or none; raises LifecycleError."""

    def remove_data_layer(self) -> None:
        """Remove every endpoint."""

    def callback(self, name: str) -> Callable[..., Any]:
        """Return the user's `on_…` method."""

    def callback_argument(self, state: NodeState) -> object:
        """Return the `state` that callbacks are given."""

    def wake_at_deadline(self, deadline_s: float) -> Callable[[], None]:
        """Wake the executor in `deadline_s`; returns what calls that off."""

    def wake(self) -> None:
        """Make the executor look at its waiting tasks again."""

    def report(self, result: Result) -> None:
        """Log why a step did not succeed."""


class Controller:
    """One node's transitions, run one at a time.

    Args:
        node: does what is the framework's part of each, and has the author's callbacks.
        timeouts: deadlines of the callbacks.
        on_change: called after each change of state.

    Example:
        >>> result = await controller.change(TransitionRequest.CONFIGURE)
        >>> result.outcome
        <CallbackOutcome.SUCCESS: 'transition_success'>
    """

    def __init__(
        self, node: ControlledNode, timeouts: Timeouts, on_change: Callable[[StateChange], None]
    ) -> None:
        self.machine = LifecycleMachine(on_change)
        self._node = node
        self._timeouts = timeouts
        self._lock = threading.Lock()
        self._running: Interruptible | None = None
        self._steps: dict[NodeState, Callable[[object], Coroutine[Any, Any, Result]]] = {
            NodeState.CONFIGURING: self._configure,
            NodeState.CONNECTING: self._connect,
            NodeState.ACTIVATING_DISCONNECTED: self._connect,
            NodeState.ACTIVATING_CONNECTED: self._activate,
            NodeState.DEACTIVATING: self._deactivate,
            NodeState.DISCONNECTING: self._disconnect,
            NodeState.CLEANINGUP_CONNECTED: self._disconnect,
            NodeState.CLEANINGUP_DISCONNECTED: self._clean_up,
            NodeState.SHUTTINGDOWN: self._shut_down,
            NodeState.ERRORPROCESSING: self._process_error,
        }

    async def change(self, request: TransitionRequest) -> Result:
        """Run a whole transition, with everything it takes on the way.

        Returns:
            SUCCESS, or the first step's result that was not: after an ERROR, on_error has run and
            the node is unconfigured or finalized.

        Raises:
            RefusedError: not allowed in this state, or another transition is running.
        """
        with self._lock:
            argument = self._node.callback_argument(self.machine.state)
            self.machine.request(request)
        returned = SUCCESS
        while not self.machine.state.steady:
            result = await self._step(argument)
            if result.outcome is not CallbackOutcome.SUCCESS:
                self._node.report(result)
                returned = returned if returned.error else result
            with self._lock:
                self.machine.finish(result.outcome)
        self._node.wake()
        return returned

    async def shut_down(self, reason: str) -> Result:
        """Bring the node to finalized from wherever it is, because its process must end.

        A running async callback is cancelled first; each step keeps its own deadline.
        """
        if not self.machine.state.steady:
            if self._running is not None:
                self._running.cancel(reason)
            self._node.wake()  # which resumes the callback for the last time
            await _Steady(self.machine)
        if self.machine.state is NodeState.FINALIZED:
            return SUCCESS
        return await self.change(TransitionRequest.SHUTDOWN)

    async def _step(self, argument: object) -> Result:
        """Run the step of the present state; a fault of ours is an ERROR too, not a stuck node."""
        state = self.machine.state
        try:
            return await self._steps[state](argument)
        except Exception as error:  # noqa: BLE001 - reported with its traceback, then ERROR
            return Result(
                outcome=CallbackOutcome.ERROR,
                error=f"cannot finish {state.value} of {self._node.full_name}: {error!r}",
                trace=traceback.format_exc(),
            )

    async def _configure(self, argument: object) -> Result:
        try:
            self._node.prepare()
        except LifecycleError as error:
            self._node.unprepare()
            return Result(outcome=CallbackOutcome.FAILURE, error=str(error))
        result = await self._user("on_configure", argument, self._timeouts.configure_s)
        if result.outcome is CallbackOutcome.FAILURE:
            self._node.unprepare()
        return result

    async def _connect(self, argument: object) -> Result:
        try:
            self._node.make_data_layer()
        except LifecycleError as error:
            return Result(outcome=CallbackOutcome.FAILURE, error=str(error))
        result = await self._user("on_connect", argument, self._timeouts.connect_s)
        if result.outcome is CallbackOutcome.FAILURE:
            self._node.remove_data_layer()
        return result

    async def _activate(self, argument: object) -> Result:
        return await self._user("on_activate", argument, self._timeouts.activate_s)

    async def _deactivate(self, argument: object) -> Result:
        return await self._user("on_deactivate", argument, self._timeouts.deactivate_s)

    async def _disconnect(self, argument: object) -> Result:
        result = await self._user("on_disconnect", argument, self._timeouts.connect_s)
        if result.outcome is CallbackOutcome.SUCCESS:
            self._node.remove_data_layer()
        return result

    async def _clean_up(self, argument: object) -> Result:
        result = await self._user("on_cleanup", argument, self._timeouts.cleanup_s)
        if result.outcome is CallbackOutcome.SUCCESS:
            self._node.unprepare()
        return result

    async def _shut_down(self, argument: object) -> Result:
        result = await self._user("on_shutdown", argument, self._timeouts.shutdown_s)
        if result.outcome is not CallbackOutcome.ERROR:
            self._take_down()
        return result

    async def _process_error(self, argument: object) -> Result:
        """Whatever on_error says, the node ends unconfigured or finalized: with no endpoints."""
        result = await self._user("on_error", argument, self._timeouts.cleanup_s)
        self._take_down()
        return result

    def _take_down(self) -> None:
        self._node.remove_data_layer()
        self._node.unprepare()

    async def _user(self, name: str, argument: object, deadline_s: float) -> Result:
        call_off: list[Callable[[], None]] = []

        def started(running: Interruptible) -> None:
            self._running = running
            call_off.append(self._node.wake_at_deadline(deadline_s))

        try:
            return await execution.call(
                self._node.callback(name),
                (argument,),
                what=f"{self._node.full_name}: {name}",
                deadline_s=deadline_s,
                started=started,
            )
        finally:
            self._running = None
            for each in call_off:
                each()


class _Steady:
    """Awaits the end of the running transition; looked at each time the executor wakes."""

    def __init__(self, machine: LifecycleMachine) -> None:
        self._machine = machine

    def __await__(self) -> Generator[None, None, None]:
        while not self._machine.state.steady:
            yield
