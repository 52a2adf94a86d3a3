"""One run of one system, from the first process to the last: the loop that owns its state.

Owns: `Supervisor`: it takes inputs one after the other (`core.reduce.take`), says what is said of
them, and has ports carry out what the core wants done then (`core.advance`). What is done, and
when, is the core's alone. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import signal
from collections import deque
from collections.abc import Callable, Coroutine, Iterator
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec.structs import replace

from lifecycle.errors import BringUpError, ExitCode, LifecycleError
from lifecycle.graph.loop import ended
from lifecycle.plan.model import Plan
from lifecycle.run_directory import RunDirectory
from lifecycle.supervisor.connections import discovery_server
from lifecycle.supervisor.connections.authority import ConnectionAuthority
from lifecycle.supervisor.connections.networks import Networks
from lifecycle.supervisor.control.protocol import Answer, ControlRequest, SystemStatus
from lifecycle.supervisor.control.ros_interface import RosInterface
from lifecycle.supervisor.control.server import ControlServer, SupervisorSnapshot, check
from lifecycle.supervisor.control.status import process_state, result_of, system_status
from lifecycle.supervisor.core import advance, gate, messages
from lifecycle.supervisor.core import state as core
from lifecycle.supervisor.core.change import change_to, changed_nodes
from lifecycle.supervisor.core.orders import refused_at_once
from lifecycle.supervisor.core.reduce import take
from lifecycle.supervisor.nodes.liveliness import Answering, Cause
from lifecycle.supervisor.nodes.peers import FAILED, Peers
from lifecycle.supervisor.nodes.system import NodeRun, System
from lifecycle.supervisor.processes.fork_server import reap_adopted
from lifecycle.supervisor.run.events import (
    Failure,
    Notice,
    ProcessChanged,
    Stopped,
)
from lifecycle.supervisor.run.options import UpResult
from lifecycle.supervisor.run.signals import ENDED_BY, Ending
from lifecycle.supervisor.shell.looks import Looks
from lifecycle.supervisor.shell.processes import Processes
from lifecycle.supervisor.shell.requests import Requests
from lifecycle.verify.rules.catalogue import PROCESS_DIED
from lifecycle.verify.verdict import NOT_JUDGED, Verdict

if TYPE_CHECKING:
    from lifecycle.supervisor.nodes.observer_participant import ObserverParticipant
    from lifecycle.supervisor.processes.fork_server import ForkServer


_BROKEN_S = 20.0
"""For a system to be taken down by a supervisor that has an error itself."""

_TURNS = 8
"""An answer takes up to five turns of the loop from the socket to the core."""


class Means(msgspec.Struct, frozen=True, kw_only=True):
    """What a supervisor acts by.

    Attributes:
        directory: acquired for this run.
        fork_server: starts processes.
        participant: sees the graph and reaches foreign nodes; made before any process.
        networks: programmed while the system is active.
        ending: knows of signals that came before.
    """

    directory: RunDirectory
    fork_server: ForkServer
    participant: ObserverParticipant
    networks: Networks
    ending: Ending


class Supervisor:
    """A supervisor of one system; `run` it once.

    Args:
        system: the part of a plan that this supervisor is responsible for.
        means: what it acts by.

    Attributes:
        authority: connects nodes; None where they connect themselves.
        peers: the supervisors of other hosts.
        looks: looks at the system, and judges it.
        moved: set, and replaced, at each input.
        changed: set, and replaced, whenever what a verdict looks at may be another.
        again: names of nodes that are started again, since the plan was last given to who connects.
    """

    def __init__(self, system: System, means: Means) -> None:
        self.system = system
        self.means = means
        self._emit = system.emit
        self._loop = asyncio.get_running_loop()
        self._inbox: deque[messages.Input] = deque()
        self._is_taking = False
        self._touched = False
        self._graph_changes = means.participant.graph.changes
        self._tasks: set[asyncio.Task[Any]] = set()
        self._wake: asyncio.Handle | None = None
        self._turns = 0
        self._said: dict[str, object] = {}
        self._answers: dict[int, asyncio.Future[Answer]] = {}
        self._plans: tuple[Plan, Plan] = (system.plan, system.first)
        self._closing: asyncio.Task[None] | None = None
        self._last: Verdict | None = None
        self._programming: asyncio.Task[None] | None = None
        self._over = asyncio.Event()
        self._hurry = asyncio.Event()
        self._error: BaseException | None = None
        self._silent: dict[str, str] = {}
        self.moved = asyncio.Event()
        self.changed = asyncio.Event()
        self.again: set[str] = set()
        self.authority = ConnectionAuthority(self) if system.run.wires else None
        self.peers = Peers(system, means.participant)
        self.answering = Answering(system, means.participant.clients)
        self._processes = Processes(self)
        self._requests = Requests(self)
        self.looks = Looks(self)
        self._ros_interface = RosInterface(self)
        self._server = ControlServer(means.directory.socket_path, self)
        self._ports: dict[type, Callable[[Any], Coroutine[Any, Any, None] | None]] = {
            messages.Ask: self._requests.ask,
            messages.Give: self._requests.give,
            messages.Spawn: self._processes.spawn,
            messages.Signal: self._processes.signal,
            messages.Sweep: self._processes.sweep,
            messages.Look: self.looks.look,
            messages.Program: self._program,
            messages.Answer: self._answer,
            messages.Wake: self._wake_at,
        }
        system.touch = self._touch
        system.on_health = self._health
        system.liveliness.listen(self._touch)
        system.liveliness.listen(self._silence)

    # What others ask

    def status(self) -> SystemStatus:
        """Return what is known now."""
        return system_status(self.system)

    def look(self) -> SupervisorSnapshot:
        """Return all that is known now."""
        return SupervisorSnapshot(
            plan=self.system.expected,
            status=self.status(),
            observation=self.looks.seen,
            verdict=self.system.run.judged.verdict,
        )

    def stop(self, reason: str, exit_code: ExitCode) -> None:
        """Ask the run to end; once it ends, an interrupt asks it to hurry."""
        self.give(messages.Stop(reason=reason, code=exit_code))

    async def order(self, order: core.Order) -> Answer:
        """Take an order from outside, if it fits what the system is doing; return its outcome."""
        try:
            check(order, self.system)
        except LifecycleError as error:
            return Answer(exit_code=error.exit_code, error=str(error))
        run, change = self.system.run, None
        if order.ask is ControlRequest.APPLY and order.plan is not None:
            what = change_to(run, order.plan)
            change = changed_nodes(what, run.first, order.plan, run.revision)
        code, why = refused_at_once(run, order)
        if change is not None and order.dry_run:
            differs = ExitCode.VIOLATED if change.differences else ExitCode.OK
            return Answer(exit_code=code if why else differs, error=why, change=change)
        order = replace(order, id=len(self._answers))
        answer = self._answers[order.id] = self._loop.create_future()
        self.give(messages.Ordered(order=order))
        done: Answer = await asyncio.shield(answer)
        if change is not None and done.exit_code == ExitCode.OK:
            return replace(done, change=replace(change, revision=run.revision))
        return done

    # The loop

    def now_s(self) -> float:
        """Return the run's time, in seconds."""
        return self._emit.elapsed_s

    def give(self, given: messages.Input) -> None:
        """Take an input; one that comes while another is taken is taken after it."""
        self._inbox.append(given)
        if self._is_taking:
            return
        self._is_taking = True
        try:
            while self._inbox:
                self._take(self._inbox.popleft())
        except Exception as error:  # noqa: BLE001 - nothing may be left running for it
            self._is_taking = False
            self.broke(error)
        finally:
            self._is_taking = False

    def _take(self, given: messages.Input) -> None:
        run = self.system.run
        events = take(run, self.now_s(), given)
        self.system.follow()
        self._say_states()
        for event in events:
            self._emit(event)
        self._requests.drop()
        wanted = advance.advance(run)
        self._say_states()
        for effect in wanted:
            if (work := self._ports[type(effect)](effect)) is not None:
                self.start(work)
        self.moved.set()
        self.moved = asyncio.Event()
        self._follow_plan()
        if run.hurry:
            self._hurry.set()
        if run.ending is not None:
            self._end(run.ending)
            if run.is_over:
                self._over.set()
        elif self.system.remote and (left := self.peers.left()) != run.left:
            self.give(messages.Saw(left=left))

    def _answer(self, effect: messages.Answer) -> None:
        answer = self._answers[effect.order]
        if not answer.done():
            answer.set_result(Answer(exit_code=effect.code, error=effect.error))

    def _wake_at(self, effect: messages.Wake) -> None:
        if self._turns:
            return  # a tick is about to come, and says when the next one is due
        if self._wake is not None:
            self._wake.cancel()
        wait_s = max(0.0, effect.at_s - self.now_s())
        self._wake = self._loop.call_later(wait_s, self._tick)

    def _tick(self) -> None:
        """Say what time it is once all was taken that has arrived by now: none of it is late."""
        if self._turns < _TURNS:
            self._turns += 1
            self._wake = self._loop.call_soon(self._tick)
            return
        self._turns = 0
        self.give(self._requests.tick(self.now_s()))

    def start(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Carry something out beside the loop; it is over before the run is."""
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._done)
        return task

    def _done(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            self.broke(error)

    def broke(self, error: BaseException) -> None:
        """Take the system down for an error of our own, which is raised in the end, bounded."""
        if self._error is None:
            self._error = error
            self._loop.call_later(_BROKEN_S, self._give_up)
            self.stop("an error of the supervisor", ExitCode.INTERNAL)
        elif not self._over.is_set():
            self._give_up()

    def _give_up(self) -> None:
        """End everything that runs: it cannot be taken down in order."""
        for process in self.system.living:
            process.signal(signal.SIGKILL)
        self._over.set()

    # What changes

    def catch_up(self) -> None:
        """Take every change that has been noticed, and not been taken yet."""
        graph = self.means.participant.graph
        if self._touched or graph.changes != self._graph_changes or self.looks.is_behind:
            self._touched, self._graph_changes = False, graph.changes
            self.give(messages.Changed())
            self._wake_looks()

    def _wake_looks(self) -> None:
        self.changed.set()
        self.changed = asyncio.Event()

    def _touch(self) -> None:
        """Note a change; changes come in bursts, and are taken once for all that come at once."""
        if not self._touched:
            self._touched = True
            self._loop.call_soon(self.catch_up)

    async def _follow_graph(self) -> None:
        while True:
            await self.means.participant.graph.wait_change()
            self.catch_up()

    def _health(self, node: NodeRun) -> None:
        if node.core.healthy != node.is_healthy:
            self.give(messages.Saw(health={node.core.key: node.is_healthy}))

    def _silence(self) -> None:
        liveliness = self.system.liveliness
        hangs = {**liveliness.causes(Cause.HUNG), **liveliness.causes(Cause.STOPPED)}
        known, self._silent = self._silent, dict(liveliness.silent)
        for name in known.keys() | self._silent.keys():
            node, why = self.system.node_named(name), self._silent.get(name, "")
            if node is not None and why != known.get(name, ""):
                away, hung = liveliness.is_out_of_reach(name), name in hangs
                self.give(messages.Silent(node=node.core.key, why=why, away=away, hangs=hung))

    async def seen(self) -> frozenset[str]:
        """Return the full names of the nodes that discovery shows."""
        observation = await self.means.participant.graph.observe(
            self.system.plan, machines=self.system.machines
        )
        return frozenset(each.full_name for each in observation.nodes)

    def may_activate(self, key: str) -> bool:
        """Return whether the gate is open for a node in this very moment."""
        self.catch_up()
        run = self.system.run
        node, passage = run.nodes.get(key), run.passage
        if node is None or passage is None or run.ending is not None or run.failures:
            return False
        passes = passage.opened and key in passage.waiting
        return passes and gate.is_open(run) and advance.wanted(run, node) is core.Level.ACTIVE

    def _follow_plan(self) -> None:
        """Give a plan that differs, or has nodes that come again, to who connects them."""
        run = self.system.run
        if not self.again and (run.plan, run.first) == self._plans:
            return
        plan, first = self._plans
        if run.first is not first:
            keys = {each.key for each in first.nodes} ^ run.nodes.keys()
            names = {each.key: each.full_name for each in (*first.nodes, *run.plan.nodes)}
            self.again |= {names[key] for key in keys}
        self._plans, again, self.again = (run.plan, run.first), frozenset(self.again), set()
        if run.plan is not plan:
            self.system.expected = run.plan
            if (run.plan.bounds, run.plan.flows) != (plan.bounds, plan.flows):
                self._processes.measure()
            self._wake_looks()  # others may be waited for, or for something else
        if self.authority is not None:
            self.authority.replan(run.plan, again)
        self.means.networks.replan(run.plan)
        if run.first is not first:
            self.peers.announce()

    # What is said

    def _say_states(self) -> None:
        run = self.system.run
        for process in run.processes.values():
            state = process_state(run, process)
            if process.state is None and process.end is None:
                continue
            if self._said.get(process.name) != state:
                self._said[process.name] = state
                detail = "" if process.end is None else process.end.text
                pid = max(process.pid, 0)
                self._emit(
                    ProcessChanged(process=process.name, state=state, pid=pid, detail=detail)
                )
        for node in self.system.nodes.values():
            node.say()

    # What is done

    def _program(self, effect: messages.Program) -> None:
        if self._programming is not None:
            self._programming.cancel()  # for a passage that was given up
        self._programming = self.start(self._programmed(effect))

    async def _programmed(self, effect: messages.Program) -> None:
        passage = self.system.run.passage
        until_s = self.now_s() if passage is None else passage.until_s
        error = ""
        try:
            left_s = max(gate.LEAST_S, until_s - self.now_s())
            await self.means.networks.begin(effect.verdict, left_s)
        except BringUpError as failed:
            error = failed.message
        self.give(messages.Programmed(number=effect.number, error=error))

    async def _watch_fork_server(self) -> None:
        text = await asyncio.shield(self.means.fork_server.died)
        text = f"cannot go on: {text}"
        failed = Failure(rule=PROCESS_DIED.id, subject="fork server", message=text)
        self.give(messages.Broken(failure=failed))

    async def _watch_discovery_server(self) -> None:
        if (server := self.system.server) is not None:
            found = discovery_server.death(server, await asyncio.shield(server.ended))
            self.give(messages.Broken(failure=found))

    # From begin to end

    async def run(self) -> UpResult:
        """Bring the system up, hold it, and take it down; never leaves anything running."""
        await self._server.open()
        self.peers.open()

        self._emit.listen(self._ros_interface.on_event)
        self.start(self._ros_interface.follow())
        result = UpResult(exit_code=ExitCode.INTERNAL, verdict=NOT_JUDGED)
        beside = [
            asyncio.ensure_future(each)
            for each in (
                self._follow_graph(),
                self.looks.follow(),
                self.answering.follow(),
                self._watch_fork_server(),
                self._watch_discovery_server(),
            )
        ]
        for each in beside:
            each.add_done_callback(self._done)
        try:
            with self._signals():
                self.give(messages.Tick())
                try:
                    await self._over.wait()
                except BaseException:
                    self.stop("interrupted", ExitCode.INTERRUPTED)
                    await self._over.wait()
                    raise
                await ended(*beside)
                await self._leave_nothing()
            result = result_of(self.system, self._last or NOT_JUDGED)
        finally:
            await ended(*beside, *self._tasks)
            if self._wake is not None:
                self._wake.cancel()
            self.looks.close()
            self._ros_interface.close()
            run = result.verdict.run
            self._emit(
                Stopped(
                    exit_code=result.exit_code,
                    elapsed_s=self._emit.elapsed_s,
                    reason="" if run is None else run.reason,
                )
            )
            await self._server.close(result.exit_code)
        if self._error is not None:
            raise self._error
        return result

    def _end(self, ending: core.Ending) -> None:
        if self._last is not None:
            return
        latest = self.system.run.judged.verdict or NOT_JUDGED
        self._last = self.system.liveliness.by_now(latest)
        how = FAILED if ending.failed else ""
        self.peers.leave(f"{how}{ending.stopping}")
        self.means.participant.prepare_to_leave()
        if self._programming is not None:
            self._programming.cancel()  # nothing is programmed once all is removed
        if self.authority is not None:
            self._closing = self.start(self.authority.close())

    async def _leave_nothing(self) -> None:
        """Undo what is no process's: after the last message has left, and before strays end."""
        await asyncio.gather(*self._processes.ends)
        await ended(*filter(None, (self._programming,)))
        if self._closing is not None:
            await asyncio.wait({self._closing})
        try:
            await self.means.networks.close(self._hurry)
        finally:
            await discovery_server.end(self.system, self._hurry)
        if left := await self.means.fork_server.end_strays():
            pids = ", ".join(map(str, left))
            self._emit(Notice(message=f"ended processes that were left behind: {pids}"))
        self.system.logs.report_lost()

    async def leave(self) -> None:
        """Leave the exchange with other supervisors, after `run`; Fast DDS can hang in it."""
        self.means.participant.prepare_to_leave()
        await self.peers.close()

    @contextlib.contextmanager
    def _signals(self) -> Iterator[None]:
        fork_server, ending = self.means.fork_server, self.means.ending
        ends = ending.numbers
        for number in ends:
            self._loop.add_signal_handler(number, self._ended_by, number)
        self._loop.add_signal_handler(signal.SIGCHLD, lambda: reap_adopted(fork_server.waited_for))
        if ending.number is not None:
            self._loop.call_soon(self._ended_by, ending.number)
        try:
            yield
        finally:
            for number in (*ends, signal.SIGCHLD):
                self._loop.remove_signal_handler(number)
            ending.resume()

    def _ended_by(self, number: int) -> None:
        self.stop(*ENDED_BY[number])
