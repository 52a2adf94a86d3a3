"""Construct and run the nodes of a host process: carry out the supervisor's commands, report back.

A host constructs every node, says "ready", obeys, and at end of file shuts down and leaves, nodes
deactivated first if the supervisor was killed. While the user's modules are imported there is
nothing to shut down: then it ends at once, and silently.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import stat
import sys
import threading
import traceback
from collections.abc import Callable
from typing import Any, NoReturn

from rclpy.context import Context

from lifecycle import codec
from lifecycle.errors import LifecycleError
from lifecycle.measure.sample import SLOT_S
from lifecycle.middleware.fastdds.factory import initialised
from lifecycle.middleware.fastdds.profiles import ParticipantSettings
from lifecycle.middleware.fastdds.sockets import send_again_soon
from lifecycle.middleware.process.busy_sign import BusySign
from lifecycle.middleware.process.control import leave_and_exit
from lifecycle.node.callbacks import SUCCESS, CallbackOutcome, Result
from lifecycle.node.host.adoption import Adoption, Hosted, maker_of
from lifecycle.node.host.control import (
    Command,
    Event,
    HostChannel,
    HostSpec,
    Operation,
    report_failure,
)
from lifecycle.node.host.foreign import ForeignNode
from lifecycle.node.host.loop import NodeLoop, on_signal
from lifecycle.plan.model import PlannedNode
from lifecycle.verify.observation import NodeConfiguration


def process_context(spec: HostSpec) -> Context:
    """Initialise rclpy for a process and return its default context."""
    return initialised(ParticipantSettings.of(spec.nodes[0]), spec.domain_id)


_ANSWERED_WITHOUT_CONFIGURATION = frozenset(
    {Operation.ACTIVATE, Operation.DEACTIVATE, Operation.CLEANUP, Operation.SHUTDOWN}
)

_DOWNWARDS = frozenset(
    {Operation.DEACTIVATE, Operation.DISCONNECT, Operation.CLEANUP, Operation.SHUTDOWN}
)
"""What is done of a node that its own code has destroyed."""

_LEAVE_S = 0.5
"""For the participants of nodes that were constructed while another's module is imported."""


class Host:
    """The nodes of one process and the commands to them."""

    def __init__(self, spec: HostSpec, context: Context, channel: HostChannel) -> None:
        self._spec = spec
        self._context = context
        self._channel = channel
        run = spec.nodes[0].run
        sign = BusySign(*channel.descriptors) if channel.descriptors else None
        if sign is not None:
            sign.show_stacks()
        self._loop = NodeLoop(
            context,
            sign,
            lambda _: channel.write(Event(kind="beat")),
            executor=run.executor,
            threads=run.threads,
        )
        self._lock = threading.Lock()
        self._imports = False
        self._ended = False
        self._output = _Output(spec.log)
        self._is_orderly = False
        self._left = threading.Event()
        self._looks = False
        self._measures = spec.measures
        self._nodes: dict[str, Hosted] = {}
        self._adoption = Adoption(context, self._loop, supervisor=spec.system)
        self._marks: dict[str, tuple[int | None, ...]] = {}  # of whom the plan says any

    def run(self) -> NoReturn:
        """Construct, say ready, obey; never returns."""
        # Both before any constructor of the user's: whatever it does, the process can be ended.
        self._obey()
        beside = {self._channel.fileno(): self._receive}
        with on_signal(lambda number: self._end(number.name), beside):
            for index, planned in enumerate(self._spec.nodes):
                if planned.key in self._adoption.made:
                    continue  # by the same call as one before it
                failure: Exception | None = None
                try:
                    self._construct(planned, self._import(planned))
                except Exception as error:  # noqa: BLE001 - reported to the supervisor
                    failure = error
                if failure is not None:
                    # Outside the handler: what fails next is not a consequence of this.
                    self._give_up(index, failure)
            self._loop.call_soon(self._ready)
            self._loop.spin_and_exit(self._channel.drain)
        raise AssertionError("spin_and_exit returned")

    def _import(self, planned: PlannedNode) -> Callable[..., Any]:
        """Import a node's class; ending the process meanwhile need not wait for it."""
        with self._lock:
            self._imports = True
            if self._ended:
                self._leave()
        # The kernel ends a process whose import keeps the interpreter's lock.
        quiet = () if self._loop.nodes else (signal.SIGINT, signal.SIGTERM)
        before = {number: signal.signal(number, signal.SIG_DFL) for number in quiet}
        try:
            return maker_of(planned, self._spec.folders)
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
            with self._lock:
                self._imports = False

    def _give_up(self, index: int, error: Exception) -> NoReturn:
        """Report the node that failed, and whatever else cannot be imported here, and leave."""
        report_failure(self._channel, self._spec.nodes[index].full_name, error)
        for planned in self._spec.nodes[index + 1 :]:
            try:
                self._import(planned)
            except Exception as another:  # noqa: BLE001, PERF203 - reported to the supervisor
                report_failure(self._channel, planned.full_name, another)
        self._leave(1)

    def _end(self, reason: str) -> None:
        """Shut down and leave; from any thread but the main one."""
        self._left.set()
        with self._lock:
            self._ended = True
            if self._imports:
                self._leave()
        self._loop.stop(reason, code=0)

    def _leave(self, code: int = 0) -> NoReturn:
        """Leave without shutting nodes down: none of them has been configured."""
        nodes = self._loop.nodes
        self._channel.drain()
        leave_and_exit(
            code,
            nodes=nodes,
            contexts=dict.fromkeys([self._context, *(node.context for node in nodes)]),
            deadline_s=_LEAVE_S,
        )

    def _construct(self, planned: PlannedNode, maker: Callable[..., Any]) -> None:
        group = [each for each in self._spec.nodes if each.run == planned.run]
        for hosted in self._adoption.make(planned, group, maker):
            self._nodes[hosted.full_name] = hosted
            hosted.gate.measure(self._spec.apart)
            hosted.listeners.append(self._report_state)
            hosted.configuration_changes.listen(self._report_configuration)
            self._note_marks(hosted)
            self._loop.add(hosted)

    async def _ready(self) -> None:
        for hosted in self._nodes.values():
            if isinstance(hosted, ForeignNode):
                hosted.configuration_changes.touch()
        if self._spec.joins:
            self._adoption.participants.ask_others()
        self._channel.write(Event(kind="ready"))
        if self._measures or self._marks:
            self._begin_to_look()

    def _begin_to_look(self) -> None:
        """Look again and again at what no event reports; a second time is harmless."""
        if not self._looks:
            self._looks = True
            threading.Thread(target=self._look, name="looks", daemon=True).start()

    def _look(self) -> None:
        """Report other marks, and what active nodes have counted, whatever their callbacks do."""
        while not self._left.wait(SLOT_S):
            for name, hosted in tuple(self._nodes.items()):
                if self._has_other_marks(hosted):
                    self._note_marks(hosted)
                    hosted.configuration_changes.touch()
                measured = hosted.gate.measured() if self._measures else None
                if measured is not None:
                    self._channel.write(Event(kind="measured", node=name, measured=measured))

    def _report_state(self, hosted: Hosted) -> None:
        if hosted.is_destroyed:
            if not self._left.is_set():
                self._channel.write(Event(kind="destroyed", node=hosted.full_name))
        elif hosted.spec.managed:
            self._report("state", hosted, hosted.full_name)

    def _report_configuration(self, configuration: NodeConfiguration) -> None:
        hosted = self._nodes.get(configuration.name)
        self._note_marks(hosted)
        self._report("configuration", hosted, configuration.name, configuration=configuration)

    def _report(self, kind: str, hosted: Hosted | None, name: str, **more: Any) -> None:
        if hosted is not None and not hosted.is_destroyed:
            state = hosted.reported
            more.update(state=state.label, connected=state.connected)
        self._channel.write(Event(kind=kind, node=name, **more))

    def _receive(self) -> bool:
        """Take what the supervisor sends; False once it has ended the channel."""
        if not self._channel.receive():
            if self._is_orderly:
                self._end("end of the control channel")
            else:
                self._lose_supervisor()
            return False
        self._obey()
        return True

    def _obey(self) -> None:
        """Have the commands carried out that have arrived."""
        for line in self._channel.lines():
            try:
                command = codec.from_json(line, Command)
            except ValueError:
                # Both ends are ours: this is a bug, and the log is where it can be found.
                logging.getLogger(__name__).exception("cannot read command %r", line)
                continue
            if command.operation is Operation.END:
                self._is_orderly = True
            else:
                self._loop.call_soon(self._execute, command)

    def _lose_supervisor(self) -> None:
        """Deactivate what is active, and leave, bounded: the supervisor was killed."""
        self._output.take_over()
        with self._lock:
            self._ended = True
            if self._imports:
                self._leave()
        _say("nodes are deactivated, and this process ends")
        limit_s = sum(each.spec.timeouts.deactivate_s for each in self._nodes.values()) + _LEAVE_S
        late = f"nodes are not deactivated within {limit_s:g} s after the supervisor has gone"
        guard = threading.Timer(limit_s, self._loop.stop, (late,), {"code": 1})
        guard.daemon = True
        guard.start()
        self._loop.call_soon(self._deactivate)

    async def _deactivate(self) -> None:
        """Deactivate what is active, the last one first, and end this process."""
        for hosted in reversed(self._nodes.values()):
            if hosted.spec.managed and hosted.reported.label != "active":
                continue
            try:
                result = await hosted.change_for_supervisor("deactivate")
                failed = result.outcome is not CallbackOutcome.SUCCESS and result.error
            except Exception as error:  # noqa: BLE001 - the user's code
                traceback.print_exc()
                failed = str(error)
            if failed:
                _say(f"{hosted.full_name} cannot be deactivated: {failed}")
        self._loop.stop("the supervisor is gone", code=0)

    # What the supervisor asks for.

    def _note_marks(self, node: Hosted | None) -> None:
        """Take the DSCP of a node's sockets that is reported now, if the plan has any of it."""
        if node is not None and any(each.dscp is not None for each in node.spec.endpoints):
            self._marks[node.full_name] = node.connections.marks

    def _has_other_marks(self, node: Hosted) -> bool:
        before = self._marks.get(node.full_name)
        return before is not None and node.connections.marks != before

    async def _execute(self, command: Command) -> None:
        """Carry out one command and answer it, whatever happens."""
        node = self._nodes.get(command.node)
        result, error, changed = None, "", False
        configuration: NodeConfiguration | None = None
        try:
            if node is None:
                known = ", ".join(self._nodes) or "no node"
                error = f"cannot find node {command.node!r}; this process hosts {known}"
            else:
                changed = command.operation is Operation.ACTIVATE and self._has_other_marks(node)
                result = _changed(node) if changed else await self._carry_out(node, command)
                error = result.error
                if node.is_destroyed:
                    pass  # there is nothing to report
                elif command.operation not in _ANSWERED_WITHOUT_CONFIGURATION or (
                    # No event reports its sockets: what its callback did to them is read now.
                    command.operation is Operation.ACTIVATE and node.full_name in self._marks
                ):
                    self._note_marks(node)
                    configuration = node.get_configuration()
        except LifecycleError as failure:
            result, error = None, str(failure)
        except Exception as failure:  # noqa: BLE001 - each command is answered exactly once
            traceback.print_exc()
            result, error = None, f"{type(failure).__name__}: {failure}"
        self._report(
            "reply",
            node,
            command.node,
            id=command.id,
            ok=result is not None and result.outcome is CallbackOutcome.SUCCESS,
            error=error,
            configuration=configuration,
            changed=changed,
        )

    async def _carry_out(self, node: Hosted, command: Command) -> Result:
        operation = command.operation
        if node.is_destroyed:
            if operation in _DOWNWARDS:
                return SUCCESS
            raise LifecycleError(
                f"cannot {operation.value} {node.full_name}: its own code has destroyed it"
            )
        if operation is Operation.SEND_AGAIN_SOON:
            send_again_soon()
        elif operation is Operation.REPUBLISH_NAMES:
            self._loop.republish_names()
        elif operation is Operation.MEASURE:
            for hosted in self._nodes.values():
                hosted.gate.measure(command.apart)
            self._measures = True
            self._begin_to_look()
        elif operation is Operation.CONNECT_TO:
            node.data_layer.connect_to(command.connection, command.connections)
        elif operation is Operation.MAP_TO:
            await node.data_layer.map_to(command.endpoint, command.connection)
        elif operation is Operation.DISCONNECT_FROM:
            node.data_layer.disconnect(command.connection)
        elif operation is not Operation.GET_CONFIGURATION:
            return await node.change_for_supervisor(operation.value)
        return SUCCESS


def _changed(node: Hosted) -> Result:
    """Return why a node is not activated that is not any more as it was reported."""
    node.configuration_changes.touch()
    return Result(
        outcome=CallbackOutcome.FAILURE,
        error=f"cannot activate {node.full_name}: the DSCP of its sockets was changed since "
        "it was verified; look for IP_TOS or IPV6_TCLASS in its code",
    )


class _Output:
    """Standard output and error, which must not break with the supervisor that reads them."""

    def __init__(self, log: str) -> None:
        self._log = log
        # While we have them open to read, too, writing cannot fail (EPIPE).
        self._pipes = {
            number: os.open(f"/proc/self/fd/{number}", os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
            for number in (1, 2)
            if stat.S_ISFIFO(os.fstat(number).st_mode)
        }

    def take_over(self) -> None:
        """Write to the log from now on, what nobody has read first."""
        try:
            log = os.open(self._log or os.devnull, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC)
        except OSError:
            log = os.open(os.devnull, os.O_WRONLY | os.O_CLOEXEC)
        for number, pipe in self._pipes.items():
            os.dup2(log, number)
            with contextlib.suppress(BlockingIOError):
                os.write(log, os.read(pipe, _PIPE_BYTES))
            os.close(pipe)
        os.close(log)


_PIPE_BYTES = 1 << 16


def _say(what: str) -> None:
    with contextlib.suppress(OSError):
        sys.stderr.write(f"the supervisor is gone: {what}\n")
        sys.stderr.flush()
