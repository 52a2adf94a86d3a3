"""Spin the nodes of one process, shut them down within a bound, and detect hanging callbacks.

Owns: the executor's thread, signals, and the bounded way down (shutdown transitions, then leaving
DDS), in a host and in a terminal alike; and what counts as hanging.

rclpy's own signal handlers are not used: they end the context while the nodes still need it, and
nothing could be reported or done after that.

An executor that waits is idle, whatever it waits for; a callback of a transition has a deadline of
its own; everything else may take as long as the nodes' `silent_s`. What notices is at the other end
of the busy sign (middleware/process/busy_timer.py): it need not be this process, whose interpreter
may be locked by the very callback that hangs.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import sys
import threading
import traceback
from collections.abc import Callable, Coroutine, Iterator
from typing import Any

from rclpy.context import Context
from rclpy.executors import ShutdownException
from rclpy.node import Node

from lifecycle.middleware import BusySign, NodeExecutor, hidden_nodes, leave_and_exit, tell_names
from lifecycle.node.author.node import LifecycleNode
from lifecycle.node.lifecycle.execution import hint


class Watchdog:
    """Keeps the busy sign of one executor; called in its thread only.

    Args:
        sign: this process's side.
        on_overlong: called with the seconds that a callback took which returned after all.
    """

    def __init__(self, sign: BusySign, on_overlong: Callable[[float], None]) -> None:
        self._sign = sign
        self._on_overlong = on_overlong
        self._running = False
        self._changing: set[str] = set()

    def add(self, node: LifecycleNode) -> None:
        """Leave the transitions of `node` to their own deadlines."""
        node.lifecycle.add_listener(self._follow)

    def begin(self) -> None:
        """Note that a callback begins."""
        self._running = True
        if not self._changing:
            self._sign.begin()

    def end(self) -> None:
        """Note that it has ended."""
        self._running = False
        self._idle()

    def _follow(self, node: LifecycleNode) -> None:
        """A transition begins or ends, inside a callback as everything does."""
        name = node.lifecycle.full_name
        if not node.lifecycle.state.steady:
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


_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_LEAVE_S = 2.0


class NodeLoop:
    """One process's executor, its nodes, and their end.

    Args:
        context: of the executor; nodes may have others.
        watchdog: notified when a callback begins and ends.

    Example:
        >>> loop = NodeLoop(context)
        >>> loop.add(Camera())
        >>> with on_signal(lambda number: loop.stop(f"signal {number}", code=0)):
        ...     loop.spin_and_exit()
    """

    def __init__(self, context: Context, watchdog: Watchdog | None = None) -> None:
        self._context = context
        self._watchdog = watchdog
        self._executor = NodeExecutor(context=context)
        self._nodes: list[Node] = []
        self._lock = threading.Lock()
        self._stopping = False
        self._done = False
        self._code = 0

    @property
    def nodes(self) -> tuple[Node, ...]:
        """Those that were added."""
        return tuple(self._nodes)

    def add(self, node: Node) -> None:
        """Spin a node from now on; shut down in reverse order of addition."""
        self._nodes.append(node)
        if self._watchdog is not None and isinstance(node, LifecycleNode):
            self._watchdog.add(node)
        self._executor.add_node(node)

    def tell_names(self) -> None:
        """Make every participant of this process publish anew which nodes and endpoints it has."""
        by_context = {id(node.context): node for node in self._nodes}
        tell_names((*by_context.values(), *hidden_nodes()))

    def call_soon(self, task: Callable[..., Coroutine[Any, Any, None]], *arguments: object) -> None:
        """Run an `async def` in the executor's thread; from any thread. It must not raise."""
        self._executor.create_task(task, *arguments)

    def stop(self, reason: str, *, code: int) -> None:
        """Shut every node down and leave with `code`; from any thread, the first call counts.

        Bounded: each node has its shutdown deadline. When a callback blocks the executor beyond
        all of them, the process ends without it.
        """
        with self._lock:
            if self._stopping:
                return
            self._stopping = True
            self._code = code
        managed = [node for node in self._nodes if isinstance(node, LifecycleNode)]
        bound_s = sum(node.lifecycle.spec.timeouts.shutdown_s for node in managed) + _LEAVE_S
        guard = threading.Thread(
            target=self._give_up, args=(bound_s, reason), name="give-up", daemon=True
        )
        # At the limit of threads it goes without: a supervisor ends what does not end by itself.
        with contextlib.suppress(RuntimeError):
            guard.start()
        self.call_soon(self._shut_down, reason)

    def spin_and_exit(self) -> None:
        """Spin until stopped, then end the process; never returns.

        An exception in a message, service or timer callback ends the process, as in rclpy: its
        traceback is printed, then all nodes are shut down.
        """
        while not self._done:
            try:
                self._turn()
            except Exception as error:  # noqa: BLE001, PERF203 - the user's code: reported
                traceback.print_exc()
                if todo := hint(error):
                    sys.stderr.write(f"{todo}\n")
                self.stop("a callback raised an exception", code=1)
        self._executor.shutdown()
        contexts = dict.fromkeys([self._context, *(node.context for node in self._nodes)])
        leave_and_exit(self._code, nodes=self._nodes, contexts=contexts)

    def _turn(self) -> None:
        """Run the next callback under the watchdog."""
        try:
            callback = self._executor.next_callback()
        except ShutdownException:
            return
        if self._watchdog is None:
            callback()
            return
        self._watchdog.begin()
        try:
            callback()
        finally:
            self._watchdog.end()

    async def _shut_down(self, reason: str) -> None:
        for node in reversed(self._nodes):
            if isinstance(node, LifecycleNode):
                try:
                    await node.lifecycle.shut_down(reason)
                except Exception:  # noqa: BLE001 - the other nodes must still be shut down
                    traceback.print_exc()
        self._done = True

    def _give_up(self, bound_s: float, reason: str) -> None:
        """End the process when a blocking callback keeps the executor from doing so."""
        threading.Event().wait(bound_s)
        names = ", ".join(node.get_fully_qualified_name() for node in self._nodes)
        sys.stderr.write(
            f"cannot shut down {names} within {bound_s:g} s after {reason}: "
            "a callback blocks; the process ends without it\n"
        )
        sys.stderr.flush()
        os._exit(self._code or 1)


@contextlib.contextmanager
def on_signal(
    handler: Callable[[signal.Signals], None],
    *,
    beside: tuple[int, Callable[[], bool]] | None = None,
) -> Iterator[None]:
    """Call `handler` in a thread of its own for each SIGINT and SIGTERM.

    Args:
        handler: takes the signal.
        beside: a descriptor that this thread reads, too: the function is called whenever it is
            readable, until it returns False.

    A Python signal handler runs only when the main thread runs Python, and the main thread sits
    in rcl's wait. The wake-up descriptor is written by the C handler, so a thread can read it.
    Must be entered in the main thread.
    """
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    before = {number: signal.signal(number, _arrived) for number in _SIGNALS}
    before_descriptor = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)

    def read() -> None:
        poll = select.poll()
        poll.register(receiver, select.POLLIN)
        if beside is not None:
            poll.register(beside[0], select.POLLIN)
        while True:
            for descriptor, _ in poll.poll():
                if beside is not None and descriptor == beside[0]:
                    if not beside[1]():
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


def _arrived(number: int, frame: object) -> None:
    """Replace the default action; the reading thread acts."""
