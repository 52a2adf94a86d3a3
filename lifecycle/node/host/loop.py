"""Spin the nodes of one process, shut them down within a bound, and detect hanging callbacks.

rclpy's own signal handlers are not used: they end the context while the nodes still need it.

A callback of a transition has a deadline of its own; everything else may take as long as the nodes'
`silent_s`. What notices is at the other end of the busy sign (middleware/process/busy_sign.py): it
need not be this process, whose interpreter may be locked by the very callback that hangs.
"""

from __future__ import annotations

import contextlib
import functools
import os
import select
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.executors import MultiThreadedExecutor, ShutdownException
from rclpy.node import Node
from rclpy.timer import Timer

from lifecycle.manifest.model import Executor
from lifecycle.middleware.fastdds.participant import hidden_nodes, republish_names
from lifecycle.middleware.process.busy_sign import BusySign, show_stacks_here
from lifecycle.middleware.process.control import leave_and_exit
from lifecycle.middleware.rcl.rclpy_nodes import NodeExecutor, Watching, described, run
from lifecycle.node.callbacks import hint
from lifecycle.node.managed import Managed

if TYPE_CHECKING:
    from lifecycle.node.host.adoption import Hosted


class Watchdog:
    """Keeps the busy sign of one executor; called in its thread only."""

    def __init__(self, sign: BusySign, on_overlong: Callable[[float], None]) -> None:
        self._sign = sign
        self._on_overlong = on_overlong
        self._running = False
        self._changing: set[str] = set()

    def begin(self, entity: Any) -> None:
        """Note that a callback begins, and of what it is; None for a task."""
        self._running = True
        if not self._changing:
            self._sign.begin(what=described(entity))

    def end(self) -> None:
        """Note that it has ended."""
        self._running = False
        self._idle()

    def follow(self, hosted: Hosted) -> None:
        """A transition begins or ends, inside a callback as everything does."""
        name = hosted.full_name
        if not hosted.reported.steady:
            self._changing.add(name)
            self._idle()
            return
        self._changing.discard(name)
        if self._running and not self._changing:
            self._sign.begin()

    def _idle(self) -> None:
        busy_s = self._sign.end()
        if busy_s is not None:
            self._on_overlong(busy_s)


class Heartbeat:
    """Keeps the busy sign of an `events` or `multi` executor, by a timer of each node.

    It is in the node's default callback group: it comes late by as long as another callback of that
    group takes, or as all threads are busy.
    """

    def __init__(self, sign: BusySign, on_overlong: Callable[[float], None]) -> None:
        self._sign = sign
        self._on_overlong = on_overlong
        self._period_s = sign.limit_s / _BEATS
        self._lock = threading.Lock()
        self._timers: dict[Node, Timer] = {}
        self._last_s: dict[Node, float] = {}
        self._changing: set[str] = set()
        self._runs = False

    def run(self, *, runs: bool) -> None:
        """Watch from now on, as the executor runs, or nothing any more."""
        with self._lock:
            self._runs = runs
            self._last_s = dict.fromkeys(self._timers, time.monotonic())
            self._mark()

    def spin(self, node: Node) -> None:
        """Watch a node that was added to the executor."""
        if node not in self._timers:
            clock = Clock(clock_type=ClockType.STEADY_TIME)
            beat = functools.partial(self._beat, node)
            self._timers[node] = Node.create_timer(node, self._period_s, beat, clock=clock)
            if self._runs:
                beat()

    def rest(self, node: Node) -> None:
        """Watch a node no more."""
        if (timer := self._timers.pop(node, None)) is not None:
            Node.destroy_timer(node, timer)
        with self._lock:
            self._last_s.pop(node, None)
            self._mark()

    def _beat(self, node: Node) -> None:
        now = time.monotonic()
        with self._lock:
            late_s = now - self._last_s.get(node, now) - self._period_s
            if node in self._timers:
                self._last_s[node] = now
                self._mark()
        if late_s >= self._sign.limit_s:
            self._on_overlong(late_s)

    def follow(self, hosted: Hosted) -> None:
        """A transition begins or ends: meanwhile nothing else of its group runs."""
        if hosted.is_destroyed:
            self.rest(hosted.node)
            return
        with self._lock:
            if not hosted.reported.steady:
                self._changing.add(hosted.full_name)
            else:
                self._changing.discard(hosted.full_name)
                self._last_s = dict.fromkeys(self._last_s, time.monotonic())
            self._mark()

    def _mark(self) -> None:
        if self._changing or not (self._runs and self._last_s):
            self._sign.end()
        else:
            due_s = min(self._last_s.values()) + self._period_s
            self._sign.begin(due_s - time.monotonic(), for_process=True)


_BEATS = 5
"""In a limit: a hang is noticed within six fifths of it."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_LEAVE_S = 2.0
_SPIN_S = 60.0
"""rclpy 7.1.6's EventsExecutor has its `spin()` wait until the end of time, which overflows: it
then looks at the clock without a pause, and other threads cannot wake it."""


class NodeLoop:
    """One process's executor, its nodes, and their end.

    Args:
        context: of the executor; nodes may have others.
        sign: this process's busy sign; None where nobody looks at it.
        on_overlong: called with the seconds that a callback took beyond the limit of the sign.
        executor: what runs the callbacks of nodes, if not `single` in threads of its own.
        threads: of a `multi` one; 0 is one for each processor, at least two.

    Attributes:
        watching: events that this loop waits for, whatever runs the callbacks of nodes.
    """

    def __init__(
        self,
        context: Context,
        sign: BusySign | None = None,
        on_overlong: Callable[[float], None] = lambda _: None,
        *,
        executor: Executor = Executor.SINGLE,
        threads: int = 0,
    ) -> None:
        self._context = context
        self.watching = Watching()
        self._executor = NodeExecutor(context=context)
        self._executor.add_node(self.watching)
        self._own: Any = self._executor
        self._has_events = executor is Executor.EVENTS
        self._watchdog: Watchdog | None = None
        self._heartbeat: Heartbeat | None = None
        if executor is not Executor.SINGLE:
            if self._has_events:
                from rclpy.experimental.events_executor import EventsExecutor

                self._own = EventsExecutor(context=context)
                # With a single node it crashes where a task raises: it indexes its set of nodes.
                self._own.add_node(Watching())
            else:
                count = threads or max(2, os.cpu_count() or 0)
                self._own = MultiThreadedExecutor(count, context=context)
            self._heartbeat = Heartbeat(sign, on_overlong) if sign else None
        elif sign is not None:
            self._watchdog = Watchdog(sign, on_overlong)
        self._hosted: list[Hosted] = []
        self._lock = threading.Lock()
        self._stopping = False
        self._done = False
        self._left = False
        self._leaving = threading.Lock()
        self._code = 0

    @property
    def nodes(self) -> tuple[Node, ...]:
        """Those that were added."""
        return tuple(each.node for each in self._hosted)

    def add(self, hosted: Hosted) -> None:
        """Shut a node down in the end, in reverse order of addition; a managed one is spun now."""
        self._hosted.append(hosted)
        for each in (self._watchdog, self._heartbeat):
            if each is not None:
                hosted.listeners.append(each.follow)  # transitions have deadlines of their own
        if isinstance(hosted, Managed):
            self.spin(hosted.node)

    def spin(self, node: Node) -> None:
        """Run a node's callbacks from now on, unless its own code has another executor do it."""
        if node.executor is None or node.executor is self._own:
            for each in node.waitables:
                self._take(each)
            self._own.add_node(node)
            if self._heartbeat is not None:
                self._heartbeat.spin(node)

    def rest(self, node: Node) -> None:
        """Run no callback of a node that begins from now on."""
        if node.executor is self._own:
            if self._heartbeat is not None:
                self._heartbeat.rest(node)
            self._own.remove_node(node)
            for each in node.waitables:
                self.watching.give_back(each)

    def take_waitable(self, node: Node, waitable: Any) -> None:
        """Wait for what a node is about to list in the way of the executor that runs it."""
        if node.executor is self._own:
            self._take(waitable)

    def _take(self, waitable: Any) -> None:
        if self._has_events:
            self.watching.take_waitable(waitable, self.call_soon)

    def republish_names(self) -> None:
        """Make every participant of this process publish anew which nodes and endpoints it has."""
        by_context = {id(node.context): node for node in self.nodes}
        republish_names([*by_context.values(), *hidden_nodes()])

    def call_soon(self, task: Callable[..., Any], *arguments: object) -> None:
        """Run a function, sync or async, where callbacks of nodes run; from any thread."""
        with self._leaving:
            if not self._left:
                self._own.create_task(task, *arguments)

    def call_beside(self, task: Callable[[], Any]) -> object:
        """Run a function, sync or async, in the main thread's executor; false after its end."""
        with self._leaving:
            return False if self._left else self._executor.create_task(task)

    def stop(self, reason: str, *, code: int) -> None:
        """Shut every node down and leave with `code`; from any thread, the first call counts.

        Each node has its shutdown deadline; if a callback blocks beyond all, the process just ends.
        """
        with self._lock:
            if self._stopping:
                return
            self._stopping = True
            self._code = code
        bound_s = (
            sum(each.spec.timeouts.shutdown_s for each in self._hosted if each.spec.managed)
            + _LEAVE_S
        )
        if self._heartbeat is not None:
            self._heartbeat.run(runs=False)
        guard = threading.Timer(bound_s, self._give_up, (bound_s, reason))
        guard.daemon = True
        # At the limit of threads it goes without: a supervisor ends what does not end by itself.
        with contextlib.suppress(RuntimeError):
            guard.start()
        self.call_soon(self._shut_down, reason)

    def spin_and_exit(self, last: Callable[[], object] = lambda: None) -> None:
        """Spin until stopped, call `last`, then end the process; never returns.

        An exception in a message, service or timer callback ends the process, as in rclpy: its
        traceback is printed, then all nodes are shut down.
        """
        if self._own is not self._executor:
            spin = functools.partial(self._own.spin_once, _SPIN_S)
            threading.Thread(target=self._spin, args=(spin,), name="executor", daemon=True).start()
            if self._heartbeat is not None:
                self._heartbeat.run(runs=True)
        self._spin(self.turn)
        self.close()
        contexts = dict.fromkeys([self._context, *(node.context for node in self.nodes)])
        last()
        leave_and_exit(self._code, nodes=self.nodes, contexts=contexts)

    def turn(self) -> None:
        """Run the next callback in this thread; raises what it raises.

        Raises:
            ShutdownException: the loop was closed.
            ExternalShutdownException: rclpy was shut down.
        """
        callback, entity = self._executor.next_callback()
        if self._watchdog is None:
            run(callback)
            return
        self._watchdog.begin(entity)
        try:
            run(callback)
        finally:
            self._watchdog.end()

    def close(self) -> None:
        """Run nothing any more."""
        with self._leaving:
            self._left = True
        if self._own is not self._executor:
            self._own.shutdown(_LEAVE_S)
        self._executor.shutdown()

    def _spin(self, once: Callable[[], None]) -> None:
        """Run callbacks in this thread until all is done."""
        while not self._done:
            try:
                once()
            except ShutdownException:  # noqa: PERF203
                return
            except (Exception, SystemExit) as error:  # noqa: BLE001 - the user's code
                if not _is_of_destroyed(error):
                    self._failed(error)

    def _failed(self, error: Exception | SystemExit) -> None:
        if not self._context.ok():
            if not self._done:
                sys.stderr.write("rclpy was shut down by a node's own code: its process ends\n")
            self._done = True  # no transition can be run without it
            return
        if isinstance(error, SystemExit):
            code = error.code if isinstance(error.code, int) else int(error.code is not None)
            self.stop("a callback raised SystemExit", code=code)
            return
        traceback.print_exception(error)
        if todo := hint(error):
            sys.stderr.write(f"{todo}\n")
        self.stop("a callback raised an exception", code=1)

    async def _shut_down(self, reason: str) -> None:
        for hosted in reversed([each for each in self._hosted if not each.is_destroyed]):
            try:
                await hosted.shut_down(reason)
            except Exception:  # noqa: BLE001, PERF203 - the other nodes must still be shut down
                traceback.print_exc()
        for hosted in self._hosted:
            hosted.configuration_changes.close()
        self._done = True
        if self._own is not self._executor:
            self.call_beside(lambda: None)  # what waits there looks again

    def _give_up(self, bound_s: float, reason: str) -> None:
        """End the process when a blocking callback keeps the executor from doing so."""
        names = ", ".join(node.get_fully_qualified_name() for node in self.nodes)
        sys.stderr.write(
            f"cannot shut down {names} within {bound_s:g} s after {reason}: "
            "a callback blocks; the process ends without it\n"
        )
        sys.stderr.flush()
        os._exit(self._code or 1)


_TAKING_OR_ANSWERING = {"take_data", "send_response", "_execute_goal_request"}


def _is_of_destroyed(error: BaseException) -> bool:
    """Return whether rclpy could not take or answer something, as its endpoint was destroyed since.

    An async handler may have worked on it meanwhile, and rclpy's EventsExecutor has events in a
    queue, from which none is removed.
    """
    *_, last = traceback.extract_tb(error.__traceback__)
    return isinstance(error, InvalidHandle) and last.name in _TAKING_OR_ANSWERING


@contextlib.contextmanager
def on_signal(
    handler: Callable[[signal.Signals], None],
    beside: Mapping[int, Callable[[], bool]],
) -> Iterator[None]:
    """Call `handler` in a thread of its own for each SIGINT and SIGTERM; enter it in the main one.

    A Python signal handler runs only when the main thread runs Python, and the main thread sits
    in rcl's wait. The wake-up descriptor is written by the C handler, so a thread can read it.

    Args:
        handler: takes the signal.
        beside: descriptors that this thread reads, too: the function of each is called whenever it
            is readable, until it returns False.
    """
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    before = {number: signal.signal(number, lambda *_: None) for number in _SIGNALS}
    before_descriptor = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)

    def read() -> None:
        show_stacks_here()
        poll = select.poll()
        poll.register(receiver, select.POLLIN)
        for each in beside:
            poll.register(each, select.POLLIN)
        while True:
            for descriptor, _ in poll.poll():
                if descriptor in beside:
                    if not beside[descriptor]():
                        poll.unregister(descriptor)
                    continue
                data = receiver.recv(16)
                if not data:
                    return
                for number in data:
                    if number in _SIGNALS:
                        handler(signal.Signals(number))

    reader = threading.Thread(target=read, name="signals", daemon=True)
    reader.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before_descriptor)
        for number, previous in before.items():
            signal.signal(number, previous)
        sender.close()
        reader.join()
        receiver.close()
