"""The supervisor's side of a fork server: processes are started over a socket.

Owns: asking it to fork, following its children by pidfd, so that an end is noticed at once, and
what they have started. A run whose fork server dies fails: its children become this process's own,
and are ended. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import sys
from collections.abc import Callable, Collection, Mapping, Sequence

from lifecycle.codec import from_json, to_json
from lifecycle.errors import BringUpError
from lifecycle.graph.loop import set_within
from lifecycle.run_directory import PROCESS_VARIABLE, groups_of
from lifecycle.supervisor.processes.fork_server_main import (
    LARGEST_MESSAGE,
    MSG_CMSG_CLOEXEC,
    SERVES,
    ChildReport,
    ForkRequest,
)
from lifecycle.supervisor.processes.fork_server_process import ForkServerProcess
from lifecycle.supervisor.processes.orphans import (
    Lineage,
    end,
    marked,
    reap_adopted,
)
from lifecycle.supervisor.processes.process import ManagedProcess, ProcessExit, run_delay_s
from lifecycle.supervisor.processes.scope import scope

_STATUS_WAIT_S = 1.0
"""The fork server reaps within microseconds; after this long its report does not come any more."""

_LEFT_S = 0.5
"""Between asking what a process left to end and killing it: another waits to start in its place."""

_ROUNDS = 3
"""How often what was started while others were ended is looked for."""

_READY_S = 10.0
"""A fork server serves after 0.2 s; a loaded machine takes longer."""

_HOST = "lifecycle.node.host.host"

_FRESH_INTERPRETER = ("PYTHON", "LD_", "RMW_IMPLEMENTATION", "VIRTUAL_ENV")
"""Variables that act while an interpreter starts; a fork of a running one would ignore them."""


class ForkServerChild:
    """A process forked by the fork server.

    Args:
        process: what it is.
        lineage: which processes descend from it.
    """

    def __init__(self, process: ManagedProcess, pid: int, pidfd: int, lineage: Lineage) -> None:
        self.process = process
        self.pid = pid
        self._lineage = lineage
        self._loop = asyncio.get_running_loop()
        self.exited: asyncio.Future[ProcessExit] = self._loop.create_future()
        self._pidfd = pidfd
        self._loop.add_reader(pidfd, self._ended, _STATUS_WAIT_S)

    def signal(self, number: int) -> None:
        """Send a signal to the child's group; harmless once it ended."""
        if self.exited.done():
            return
        try:
            os.killpg(self.pid, number)
        except ProcessLookupError:
            # It has not reached setsid yet, or only its pidfd is left of it.
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, number)

    def run_delay_s(self) -> float:
        """Return how long its threads, and those of its descendants, waited for a processor."""
        return sum(map(run_delay_s, self._lineage.of(self.pid)))

    def _ended(self, patience_s: float) -> None:
        """The pidfd is readable: it ended. The fork server reports how, unless it is gone."""
        if self.exited.done():
            return
        self._loop.remove_reader(self._pidfd)
        found = None
        with contextlib.suppress(ChildProcessError):  # else the fork server has left it to us
            found = os.waitid(os.P_PIDFD, self._pidfd, os.WEXITED | os.WNOHANG)
        if found is not None:
            is_exit = found.si_code == os.CLD_EXITED
            kind = {"status" if is_exit else "signal": found.si_status}
            self.settle(ProcessExit(**kind))
        elif patience_s > 0:
            self._loop.call_later(patience_s, self._ended, 0.0)
        else:
            self.settle(ProcessExit())

    def settle(self, how: ProcessExit) -> None:
        """Take how it ended."""
        if not self.exited.done():
            self._loop.remove_reader(self._pidfd)
            os.close(self._pidfd)
            self.exited.set_result(how)


class ForkServer:
    """Starts processes: asks another one to fork.

    Args:
        process: that process; ended by `close`.

    Attributes:
        died: resolves with how, if it ends unasked; nothing can be started any more.
    """

    def __init__(self, process: ForkServerProcess) -> None:
        self._process = process
        self._loop = asyncio.get_running_loop()
        self._pending: dict[int, tuple[asyncio.Future[ForkServerChild], ManagedProcess]] = {}
        self._children: dict[int, ForkServerChild] = {}
        self._next = 0
        # Of a shell that became this process by exec: no part of the run.
        self._foreign = Lineage().children(os.getpid())
        self._lineage = Lineage()
        self.died: asyncio.Future[str] = self._loop.create_future()
        self._serves = asyncio.Event()
        self._pidfd = os.pidfd_open(process.popen.pid)
        process.socket.setblocking(False)
        self._loop.add_reader(process.socket, self._reports)
        self._loop.add_reader(self._pidfd, self._ended)

    @property
    def pid(self) -> int:
        """Process id of the fork server itself."""
        return self._process.popen.pid

    @property
    def waited_for(self) -> tuple[int, ...]:
        """Processes whose ends are learned here: no other code may reap them."""
        return (self.pid, *(each.pid for each in self._children.values()))

    def family(self) -> frozenset[int]:
        """Return the pids of all that descends from what was started, but for the fork server."""
        lineage, roots = Lineage(), {self.pid}
        if self.died.done():
            # What it had adopted, and what it had started, is ours now.
            roots |= lineage.children(os.getpid()) - self._foreign
        return frozenset().union(*map(lineage.of, roots)) - {self.pid}

    async def ready(self) -> None:
        """Have the fork server answer, bounded.

        Raises:
            BringUpError: it does not, or has died.
        """
        self._serves.clear()
        self._ask(SERVES.encode())
        if not await set_within(self._serves, _READY_S):
            raise BringUpError(f"the fork server does not answer within {_READY_S:g} s")
        if self.died.done():
            raise BringUpError(self.died.result())

    def _ask(self, message: bytes, descriptors: Sequence[int] = ()) -> None:
        """Send a message; raises BringUpError if it has died, or cannot be asked."""
        if self.died.done():
            raise BringUpError(self.died.result())
        try:
            socket.send_fds(self._process.socket, [message], descriptors)
        except ConnectionError as error:  # it is dying: nothing was forked
            raise BringUpError("the fork server has died") from error
        except OSError as error:
            raise BringUpError(f"cannot ask the fork server: {error.strerror}") from error

    async def spawn(
        self, process: ManagedProcess, streams: Sequence[int], control: int | None
    ) -> ForkServerChild:
        """Fork one process, in a session of its own.

        Args:
            process: what to start.
            streams: descriptors for its standard output and error; not closed here.
            control: descriptor of the host's end of the control channel; None for a foreign
                command.

        Raises:
            BringUpError: the fork server is gone, or the system is out of processes.
        """
        planned, run = process.planned, process.planned.run
        descriptors = [*streams]
        scoped = scope(run.resources)
        argv = (*scoped, *planned.argv)
        if control is not None:
            descriptors.append(control)
            fresh = any(name.startswith(_FRESH_INTERPRETER) for name, _ in process.environment)
            if fresh or run.prefix or scoped:
                host = (sys.executable, "-m", _HOST, "{control}")
                argv = (*scoped, *run.prefix, *host)
        self._next += 1
        message = ForkRequest(
            id=self._next,
            argv=argv,
            environment=(*process.environment, (PROCESS_VARIABLE, planned.name)),
            working_directory=run.working_directory,
            control=control is not None,
            limits=() if run.limits is None else run.limits.resources(),
            no_new_privileges=run.no_new_privileges,
            grace_s=process.grace_s,
        )
        born: asyncio.Future[ForkServerChild] = self._loop.create_future()
        try:
            self._ask(to_json(message), descriptors)
            self._pending[message.id] = (born, process)
            return await born
        except BringUpError as error:
            raise BringUpError(f"cannot start process {process.name!r}: {error.message}") from error

    def belonging(self, processes: Mapping[int, str]) -> set[int]:
        """Return the pids of all that processes have started, whether they live or not.

        It belongs to one if it descends from it, is in its session or group, carries its name in
        its environment, or descends from one of these.

        Args:
            processes: names of planned processes by pid.
        """
        lineage = Lineage()
        others = self._living() - processes.keys()
        spared = {each for pid in others for each in lineage.of(pid)}
        names = set(processes.values())
        found = {pid for pid, name in marked(self._process.run_id).items() if name in names}
        for pid in self.family():
            groups = groups_of(pid)
            if not processes.keys().isdisjoint(groups) and spared.isdisjoint(groups):
                found.add(pid)
        for pid in (*(found - spared), *processes):
            found |= lineage.of(pid)
        return found - spared - processes.keys() - {os.getpid(), self.pid}

    async def end_left(
        self, ended: Mapping[int, str], known: Collection[int] = ()
    ) -> tuple[int, ...]:
        """End, bounded, what processes have left that have ended; return the pids.

        Args:
            ended: their names by pid.
            known: pids of what belonged to them before.
        """
        return await _until_none(lambda: self.belonging(ended) | (set(known) & self.family()))

    async def end_strays(self) -> tuple[int, ...]:
        """End, bounded, all that is left of the run but the fork server; return the pids."""
        ours = {os.getpid(), self.pid}
        ended = await _until_none(
            lambda: (marked(self._process.run_id).keys() | self.family()) - ours
        )
        reap_adopted((self.pid,))
        return ended

    def _living(self) -> set[int]:
        return {each.pid for each in self._children.values() if not each.exited.done()}

    def _reports(self) -> None:
        """Take the reports that have come."""
        while True:
            try:
                data, descriptors, _, _ = socket.recv_fds(
                    self._process.socket, LARGEST_MESSAGE, 1, MSG_CMSG_CLOEXEC
                )
            except BlockingIOError:
                return
            except ConnectionError:
                continue  # it died with requests unread; what it had sent before still comes
            if not data:  # it is about to end
                self._loop.remove_reader(self._process.socket)
                return
            self._take(from_json(data, ChildReport), descriptors)

    def _take(self, report: ChildReport, descriptors: list[int]) -> None:
        child = self._children.get(report.id)
        if report.id == 0:
            self._serves.set()
        elif report.id in self._pending:
            self._born(report, descriptors)
        elif child is not None and report.stopped is not None:
            child.process.on_stop(report.stopped)
        elif child is not None and report.status is not None:
            child.settle(ProcessExit.from_wait(report.status))

    def _born(self, report: ChildReport, descriptors: list[int]) -> None:
        born, process = self._pending.pop(report.id)
        if report.error:
            if not born.done():
                born.set_exception(BringUpError(report.error))
            return
        child = ForkServerChild(process, report.pid, descriptors[0], self._lineage)
        self._children[report.id] = child
        child.exited.add_done_callback(lambda _: self._children.pop(report.id, None))
        if born.cancelled():
            # The caller has given up; a process that no caller knows must not live.
            child.signal(signal.SIGKILL)
        else:
            born.set_result(child)

    def _ended(self) -> None:
        """The fork server itself has ended: by now its children are ours."""
        self._loop.remove_reader(self._pidfd)
        os.close(self._pidfd)
        status = self._process.popen.wait()
        self._reports()
        exit_ = ProcessExit(status=status) if status >= 0 else ProcessExit(signal=-status)
        self.died.set_result(f"the fork server (pid {self.pid}) ended unasked: {exit_}")
        self._serves.set()
        for born, _ in self._pending.values():
            if not born.done():
                born.set_exception(BringUpError(self.died.result()))
        self._pending.clear()

    def close(self) -> None:
        """End the fork server; its children must have ended."""
        self._loop.remove_reader(self._process.socket)
        if not self.died.done():
            self._loop.remove_reader(self._pidfd)
            os.close(self._pidfd)
        self._process.close()


async def _until_none(left: Callable[[], Collection[int]]) -> tuple[int, ...]:
    """End what is left, and what was started while that was ended; return the pids."""
    ended: set[int] = set()
    for _ in range(_ROUNDS):
        found = await end(left(), _LEFT_S)
        if not found:
            break
        ended.update(found)
    return tuple(sorted(ended))
