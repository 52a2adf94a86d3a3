"""Asks nodes for steps, and gives them parameters: Ask and Give.

Owns: how each step is carried out on each kind of node (in a host of ours, through its services,
loaded into a container, only seen in the graph), and the inputs about them, `Replied`, `Given`.
Which step is due, and for how long, is the core's alone.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
from collections.abc import Awaitable
from typing import TYPE_CHECKING

from msgspec.structs import replace

from lifecycle.errors import BringUpError, MiddlewareError
from lifecycle.graph.loop import set_within
from lifecycle.manifest.model import RunKind
from lifecycle.node.host.control import Operation
from lifecycle.plan.parameters import GIVEN
from lifecycle.run_directory import start_ticks
from lifecycle.supervisor.core import messages
from lifecycle.supervisor.core.advance import late_at_s
from lifecycle.supervisor.core.gate import ACTIVATES_ITSELF, BY_ITSELF, GUARD_TRIES
from lifecycle.supervisor.core.state import REACHES, Level, Step
from lifecycle.supervisor.nodes.driver import (
    ACTIVE,
    INACTIVE,
    UNCONFIGURED,
    ActiveError,
    ChangedError,
    ControlDriver,
    NodeCondition,
    Permit,
    ServiceDriver,
    where_it_runs,
)
from lifecycle.supervisor.nodes.system import level_of
from lifecycle.supervisor.processes.control_channel import ChannelClosedError, HostFailedError
from lifecycle.supervisor.run.events import Notice, RequestSent
from lifecycle.verify.judge import with_findings
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.nodes import DUPLICATE_NODE
from lifecycle.verify.verdict import NOT_JUDGED

if TYPE_CHECKING:
    from lifecycle.supervisor.nodes.system import NodeRun
    from lifecycle.supervisor.shell.supervisor import Supervisor

_DEATH_S = 0.5
"""A closed channel usually means a dying process; its end says more than the channel did."""

_REOPENS_S = 1.0
"""What changes as others are activated is judged within milliseconds, on a loaded machine later."""


class Requests:
    """What is asked of the nodes of one supervisor; one request to a node at a time.

    Args:
        shell: gets the inputs.
    """

    def __init__(self, shell: Supervisor) -> None:
        self._shell = shell
        self._system = shell.system
        self._means = shell.means
        self._tasks: dict[str, tuple[int, asyncio.Task[None]]] = {}
        self._delayed_s: dict[str, float] = {}  # run delay of a node as its request began
        self._found: set[str] = set()

    def ask(self, effect: messages.Ask) -> None:
        """Ask a node for a step."""
        node = self._system.nodes[effect.node]
        task = self._shell.start(self._carry_out(node, effect))
        self._tasks[effect.node] = effect.number, task
        self._delayed_s[effect.node] = node.run_delay_s()

    def tick(self, at_s: float) -> messages.Tick:
        """Return a tick with what is known of late requests: time without a CPU does not count."""
        waited_s: dict[str, float] = {}
        where: dict[str, str] = {}
        for key, each in self._system.run.nodes.items():
            request, node = each.request, self._system.nodes[key]
            if request is None or at_s < late_at_s(request):
                continue
            # Of us and of it: both at once no longer than there is time.
            delay_s = node.run_delay_s() - self._delayed_s[key]
            delay_s = max(0.0, min(delay_s, at_s - request.since_s))
            left_s = late_at_s(replace(request, waited_s=delay_s)) - at_s
            if left_s >= min(1.0, request.limit_s / 10):
                waited_s[key] = delay_s
            else:
                where[key] = node.where()
        return messages.Tick(at_s=at_s, waited_s=waited_s, where=where)

    def drop(self) -> None:
        """End what is done for requests that the core has given up."""
        nodes = self._system.run.nodes
        for key, (number, task) in tuple(self._tasks.items()):
            node = nodes.get(key)
            request = None if node is None else node.request
            if request is None or request.number != number:
                del self._tasks[key]
                if task is not asyncio.current_task():
                    task.cancel()

    async def _carry_out(self, node: NodeRun, effect: messages.Ask) -> None:
        reply = messages.Replied(node=effect.node, number=effect.number, level=node.core.level)
        try:
            reply = replace(reply, **await self._step(node, effect.step))
        except ChangedError:
            reply = replace(reply, level=node.core.level, changed=True)
        except ActiveError as error:  # it is left as it was found
            reply = replace(reply, level=node.core.level, error=error.message)
        except BringUpError as error:
            process = node.process
            if process is not None and isinstance(error, ChannelClosedError | HostFailedError):
                await asyncio.wait({process.ended}, timeout=_DEATH_S)
                if process.ended.done():
                    return  # its end says it
            reply = replace(reply, level=level_of(node), error=error.message)
        except MiddlewareError as error:
            text = f"{error.message}; {error.hint}" if error.hint else error.message
            reply = replace(reply, level=node.core.level, error=text)
        self._shell.give(reply)

    async def _step(self, node: NodeRun, step: Step) -> dict[str, object]:
        """Carry out a step; return what is to be said of it."""
        if step is Step.START:
            return {"level": await self._start(node)}
        if step is Step.WIRE:
            assert self._shell.authority is not None
            await self._shell.authority.wire(node)
            return {"level": Level.CONFIGURED}
        if step is Step.UNLOAD:
            if node.unload is not None:
                await node.unload()
            node.begin()
            return {"level": Level.DOWN}
        if step in (Step.CONFIGURE, Step.CONNECT, Step.ACTIVATE):
            condition = await self._upwards(node, step)
            return {"level": REACHES[step], "already": condition.already}
        return {"level": await self._downwards(node, step)}

    # Upwards

    async def _upwards(self, node: NodeRun, step: Step) -> NodeCondition:
        permit = None
        if step is Step.CONFIGURE:
            condition = await self._configure(node)
        else:
            if step is Step.ACTIVATE:
                permit = functools.partial(self._permit, node.core.key)
                await permit()
            condition = await self._perform(node, Operation(step.value), permit)
        node.report(condition.state, connected=condition.connected)
        if step is Step.CONFIGURE:
            await self._give_what_is_missing(node)
        return condition

    async def _permit(self, key: str) -> None:
        """Return once a node's activate request may leave; nothing may be awaited after it.

        Raises:
            ChangedError: what changed keeps the gate closed; the node is to be asked again later.
        """
        loop = asyncio.get_running_loop()
        until_s = loop.time() + _REOPENS_S
        while not self._shell.may_activate(key):
            left_s = until_s - loop.time()
            if left_s <= 0 or not await set_within(self._shell.moved, left_s):
                raise ChangedError(f"cannot activate {key!r}: the gate closed again")

    async def _perform(
        self, node: NodeRun, operation: Operation, permit: Permit | None = None
    ) -> NodeCondition:
        if node.driver is None:
            raise BringUpError(f"cannot {operation.value} {node.name!r}: it is not there")
        self._system.emit(RequestSent(node=node.name, operation=operation))
        return await node.driver.perform(operation, permit)

    async def _configure(self, node: NodeRun) -> NodeCondition:
        """Configure a node; one that this run started and that is active is deactivated first.

        Nobody but its own code has had it activate, so nothing depends on that; one that others
        started may be at work.
        """
        for _ in range(GUARD_TRIES):
            try:
                return await self._perform(node, Operation.CONFIGURE)
            except ActiveError:
                if node.planned.run.kind is RunKind.ATTACH:
                    raise
            self._system.emit(Notice(message=f"{node.name!r} {BY_ITSELF}: it is deactivated"))
            with contextlib.suppress(ActiveError):  # it may have been activated again: see above
                await self._perform(node, Operation.DEACTIVATE)
        raise BringUpError(
            f"cannot configure {node.name!r}: it was activated again each of the {GUARD_TRIES} "
            f"times that it was deactivated; {ACTIVATES_ITSELF}"
        )

    async def _start(self, node: NodeRun) -> Level:
        """Wait until a node is there, and know by what it is driven."""
        planned, process = node.planned, node.process
        if planned.run.component:
            name = planned.run.container
            container = self._system.nodes.get(name)
            node.unload = await self._means.participant.clients.load_component(
                planned,
                name if container is None else container.name,
                timeout_s=planned.timeouts.start_s,
            )
        if process is not None and process.channel is not None:
            await process.channel.ready()
            if planned.holds:
                node.driver = ControlDriver(process.channel, node.name)
            if planned.managed:
                node.state = UNCONFIGURED
            return Level.STARTED
        declared = {each.full_name for each in self._system.plan.nodes}
        changed = self._shell.changed
        while node.name not in (seen := await self._shell.seen()):  # the core sets the limit
            undeclared = frozenset(each for each in seen - declared if "/_" not in each)
            if undeclared != self._system.run.undeclared:
                self._shell.give(messages.Saw(undeclared=undeclared))
            await set_within(changed, None)
            changed = self._shell.changed
        self._shell.give(messages.Saw(appeared=frozenset({node.core.key})))
        if planned.managed or node.is_to_be_given:
            self._check_alone(node)
        if not planned.managed:
            if node.is_to_be_given and not planned.may_end:
                await self._give_what_is_missing(node)
            self._say_found(node, "running")
            return Level.STARTED
        driver = node.driver = ServiceDriver(self._means.participant.clients, planned)
        condition = await driver.start()
        self._say_found(node, condition.state)
        node.report(condition.state, connected=condition.connected)
        if condition.state == ACTIVE and self._system.is_adopted(node):
            return Level.ACTIVE  # it is verified as it is: no gate has to let it in
        await self._give_what_is_missing(node)
        return Level.STARTED

    def _say_found(self, node: NodeRun, state: str) -> None:
        if self._system.is_adopted(node) and node.name not in self._found:
            self._found.add(node.name)
            where = (self._system.adopted or {}).get(node.name, "")
            text = f"{node.name!r} is adopted, found {state}{where and f': {where}'}"
            self._system.emit(Notice(message=text))

    def _check_alone(self, node: NodeRun) -> None:
        """Make sure that no node of its name runs in a process that is older than ours.

        Requests to services would reach both, and both would obey.
        """
        process = node.process
        if process is None or process.is_restarted or (began := start_ticks(process.pid)) is None:
            return
        family = self._means.fork_server.family()  # one may run it that is older: a container
        older = {
            pid: command
            for pid, command in self._means.participant.processes().get(node.name, {}).items()
            if pid not in family and (start_ticks(pid) or began) < began
        }
        if not older:
            return
        it = where_it_runs(older)
        found = DUPLICATE_NODE.on(
            node.planned,
            outcome=Outcome.VIOLATED,
            expected="1 node of this name",
            observed=f"one more in {it}",
            message=f"cannot drive {node.name}: a node of this name ran before ({it}), and would "
            "obey, too",
            hint="have it adopted: lifecycle up MANIFEST --adopt; or end it",
        )
        verdict = with_findings(NOT_JUDGED, (found,), self._system.expected.policy)
        self._shell.give(messages.Refused(verdict=verdict))

    # Downwards

    async def _downwards(self, node: NodeRun, step: Step) -> Level:
        """Undo a step, unless the node is not as far any more; return where it is then."""
        if step is Step.DISCONNECT and self._shell.authority is not None:
            await self._shell.authority.unwire(node)
        done = REACHES[step]
        reports = isinstance(node.driver, ControlDriver)  # others may have moved any other
        if reports and node.planned.managed and not _applies(step, node):
            return min(done, level_of(node))
        condition = await self._perform(node, Operation(step.value))
        node.report(condition.state, connected=condition.connected)
        if step is Step.DEACTIVATE and not node.planned.managed:
            return Level.STARTED
        return done

    # Parameters

    async def give(self, effect: messages.Give) -> None:
        """Set parameters of a running node."""
        node, clients = self._system.nodes[effect.node], self._means.participant.clients
        giving: Awaitable[None]
        if effect.values is None:
            planned = node.planned
            # All of them, also those that it has by default.
            given = planned.mode_parameters.get(self._system.run.mode, ())
            all_ = tuple(replace(each, source=GIVEN) for each in given)
            giving = clients.give_parameters(replace(planned, expected_parameters=all_))
        else:
            giving = clients.set_parameters(node.name, effect.values.now, effect.values.types)
        error = ""
        try:
            await giving
        except MiddlewareError as refused:
            error = refused.message
        self._shell.give(messages.Given(node=effect.node, error=error))

    async def _give_what_is_missing(self, node: NodeRun) -> None:
        """Set parameters where no command line can; what it has not yet, it may have later."""
        if not node.is_to_be_given:
            return
        try:
            await self._means.participant.clients.give_parameters(node.planned)
        except MiddlewareError as error:
            # Judged by what it has then, which names the parameter.
            self._system.emit(Notice(message=error.message))
        self._system.touch()


def _applies(step: Step, node: NodeRun) -> bool:
    """Whether there is something to undo in the state that the node is in; it may have failed."""
    return {
        Step.DEACTIVATE: node.state == ACTIVE,
        Step.DISCONNECT: node.state == INACTIVE and node.connected,
        Step.CLEANUP: node.state == INACTIVE,
        Step.SHUTDOWN: node.state != "finalized",
    }[step]
