"""The supervisor's side of a fork server: a `Spawner` over a socket.

Owns: asking it to fork, starting it anew when it was killed, and following its children by
pidfd, so that an end is noticed at once. Children of a fork server that died become this process's
own, which then learns by itself how they end and whether they are stopped. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import sys
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from lifecycle import dataclasses
from lifecycle.codec import from_json, to_json
from lifecycle.errors import BringUpError
from lifecycle.graph import set_within
from lifecycle.manifest import RunKind
from lifecycle.run_directory import PROCESS_VARIABLE
from lifecycle.supervisor.processes.forerunner import CLOSE_S, ForkServerProcess
from lifecycle.supervisor.processes.fork_server_main import (
    DISOWN,
    KEEP,
    LARGEST_MESSAGE,
    MSG_CMSG_CLOEXEC,
    RELEASE,
    SERVES,
    SWEEP,
    ChildReport,
    ForkRequest,
)
from lifecycle.supervisor.processes.orphans import (
    Lineage,
    belonging,
    children,
    descendants,
    end_left,
)
from lifecycle.supervisor.processes.process import ProcessExit, SpawnRequest, run_delay_s
from lifecycle.supervisor.run.events import Emitter, Notice

if TYPE_CHECKING:
    from lifecycle.plan import PlannedProcess
    from lifecycle.supervisor.processes.cgroup import ProcessCgroup, RunCgroup, RunRecorder

_STATUS_WAIT_S = 1.0
"""The fork server reaps within microseconds; after this long its report does not come any more."""

_READY_S = 10.0
"""A fork server serves after 0.2 s; a loaded machine takes longer."""

_SOON_S = 2.0
"""One that dies sooner after its start is started again only when it is needed."""

_TRIES = 3

_SWEPT_S = 5.0
"""A sweep takes milliseconds, on a loaded machine longer; what is left is swept at the end."""

_STOPS = os.WSTOPPED | os.WCONTINUED | os.WNOHANG

_HOST = "lifecycle.node.host.host"

_FRESH_INTERPRETER = ("PYTHON", "LD_", "RMW_IMPLEMENTATION", "VIRTUAL_ENV")
"""Variables that act while an interpreter starts; a fork of a running one would ignore them."""


class ForkServerChild:
    """A process forked by the fork server.

    Args:
        on_stop: see SpawnRequest.
        lineage: which processes descend from it.
        send: sends the fork server a message with descriptors.
        group: the cgroup that it joins; None for none.
    """

    def __init__(
        self,
        pid: int,
        pidfd: int,
        on_stop: Callable[[bool], None],
        lineage: Lineage,
        send: Callable[[str, Collection[int]], None],
        *,
        group: ProcessCgroup | None = None,
    ) -> None:
        self.pid = pid
        self._group = group
        self._clearing: asyncio.Future[None] | None = None
        self._send = send
        self._lineage = lineage
        self.exited: asyncio.Future[ProcessExit] = asyncio.get_running_loop().create_future()
        self.on_stop = on_stop
        self._pidfd: int | None = pidfd
        self._has_ended = False
        self._is_ours = False
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(pidfd, self._ended)

    def signal(self, number: int) -> None:
        """Send a signal to the child's group; harmless once it ended."""
        if self._pidfd is None:
            return
        try:
            os.killpg(self.pid, number)
        except ProcessLookupError:
            # It has not reached setsid yet, or only its pidfd is left of it.
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, number)

    def keep(self, log: str, outputs: Collection[int]) -> None:
        """Have the fork server spare it, and read its output, should this process be killed.

        Children of a fork server that died are not known to another one, which ends them then.
        """
        self._send(f"{KEEP}\n{self.pid}\n{log}", outputs)

    def release(self) -> None:
        """Have the fork server end it, should this process be killed."""
        self._send(f"{RELEASE}\n{self.pid}\n", ())

    @property
    def cgroup(self) -> Path | None:
        """Directory of its own cgroup; None if it has none."""
        return None if self._group is None else self._group.path

    async def cleared(self) -> None:
        """Wait until what it left in its cgroup has ended and that is gone, bounded."""
        if self._clearing is not None:
            await asyncio.shield(self._clearing)

    def run_delay_s(self) -> float:
        """Return how long its threads, and those of its descendants, waited for a processor."""
        return sum(map(run_delay_s, self._lineage.of(self.pid)))

    def _ended(self) -> None:
        """The pidfd is readable: it ended. The fork server reports how, unless it is gone."""
        assert self._pidfd is not None
        self._loop.remove_reader(self._pidfd)
        self._has_ended = True
        if self._is_ours:
            self.settle(None)
        else:
            self._loop.call_later(_STATUS_WAIT_S, self.settle, None)

    def adopt(self) -> None:
        """Take it as our own child: the fork server has died, and we are the subreaper."""
        self._is_ours = True
        if self._has_ended:
            self.settle(None)
        self.note_stops()

    def note_stops(self) -> None:
        """Report that it was stopped or continues, where we are its parent."""
        if not self._is_ours:
            return
        with contextlib.suppress(ChildProcessError):
            while (
                self._pidfd is not None
                and (found := os.waitid(os.P_PIDFD, self._pidfd, _STOPS)) is not None
            ):
                self.on_stop(found.si_code != os.CLD_CONTINUED)

    def settle(self, raw: int | None) -> None:
        """Take the wait status, or find it ourselves."""
        if self.exited.done():
            return
        assert self._pidfd is not None
        self._loop.remove_reader(self._pidfd)
        exit_ = ProcessExit() if raw is None else ProcessExit.from_wait(raw)
        if raw is None:
            with contextlib.suppress(ChildProcessError):
                found = os.waitid(os.P_PIDFD, self._pidfd, os.WEXITED | os.WNOHANG)
                if found is not None and found.si_code == os.CLD_EXITED:
                    exit_ = ProcessExit(status=found.si_status)
                elif found is not None:
                    exit_ = ProcessExit(signal=found.si_status)
        os.close(self._pidfd)
        self._pidfd = None
        if self._group is not None:
            exit_ = dataclasses.replace(exit_, why=self._group.explain())
            self._clearing = asyncio.ensure_future(self._group.end())
        self.exited.set_result(exit_)


class _Pending(NamedTuple):
    """A process that the fork server was asked for."""

    born: asyncio.Future[ForkServerChild]
    request: SpawnRequest
    group: ProcessCgroup | None


class ForkServer:
    """A `Spawner` that asks a process to fork, and starts another one if that is killed.

    Args:
        process: the first one.
        emit: where it is reported if one dies.
        recorder: notes the cgroup of the run; None where no process has resources.
    """

    def __init__(
        self,
        process: ForkServerProcess,
        emit: Emitter | None = None,
        recorder: RunRecorder | None = None,
    ) -> None:
        self._emit = emit or Emitter()
        self._recorder = recorder
        self._cgroup: RunCgroup | None = None
        self._pending: dict[int, _Pending] = {}
        self._children: dict[int, ForkServerChild] = {}
        self._sweeping: dict[int, asyncio.Future[tuple[str, ...]]] = {}
        self._next = 0
        self._loop = asyncio.get_running_loop()
        # Of a shell that became this process by exec: no part of the run.
        self._foreign = children()
        self._lineage = Lineage()
        self._has_died = False
        self._closed = False
        self._begin(process)

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
        roots = {self.pid}
        if self._has_died:
            # What it had adopted, and what it had started, is ours now.
            roots |= children() - self._foreign
        return frozenset(roots.union(*map(descendants, roots)) - {self.pid})

    async def ready(self) -> None:
        """Have the fork server answer, bounded; if it has died, another one.

        Raises:
            BringUpError: it does not, or cannot be started.
        """
        deadline = self._loop.time() + _READY_S
        for _ in range(_TRIES):
            if not self._alive and not self._closed:
                self._begin(self._process.again())
            process, gone = self._process, self._gone
            self._serves.clear()
            try:
                process.socket.send(to_json(SERVES))
            except ConnectionError:
                await set_within(gone, deadline - self._loop.time())
                continue
            except OSError as error:
                raise BringUpError(f"cannot ask the fork server: {error.strerror}") from error
            if not await set_within(self._serves, deadline - self._loop.time()):
                raise BringUpError(f"the fork server does not answer within {_READY_S:g} s")
            if self._alive and process is self._process:
                return
        raise BringUpError(f"the fork server {self._how}")

    def confine(self, processes: Iterable[PlannedProcess]) -> None:
        """Make the run's cgroup, where processes ask for resources, see `Spawner`.

        Raises:
            CgroupError: that cannot be, or they cannot have what they ask for.
        """
        asking = [
            each
            for each in processes
            if each.run.resources is not None and each.run.kind is not RunKind.ATTACH
        ]
        if not asking or self._recorder is None:
            return
        from lifecycle.supervisor.processes.cgroup import RunCgroup

        made = self._cgroup or RunCgroup.below_own(self._recorder, asking[0])
        made.prepare(asking, self)
        self._cgroup = made

    async def spawn(self, request: SpawnRequest) -> ForkServerChild:
        """Fork one process.

        Raises:
            BringUpError: the fork server is gone, or the system is out of processes.
        """
        group: ProcessCgroup | None = None
        try:
            if request.resources is not None:
                assert self._cgroup is not None
                group = self._cgroup.make(request.name, request.resources)
            if not self._alive:
                await self.ready()
            try:
                return await self._forked(request, group)
            except ConnectionError:  # it is dying: nothing was forked
                await self.ready()
                return await self._forked(request, group)
        except (BringUpError, OSError) as error:
            if group is not None:
                await group.end()
            message = error.message if isinstance(error, BringUpError) else str(error)
            raise BringUpError(f"cannot start process {request.name!r}: {message}") from error

    async def _forked(self, request: SpawnRequest, group: ProcessCgroup | None) -> ForkServerChild:
        """Have it fork; raises OSError if it cannot be asked, BringUpError otherwise."""
        self._next += 1
        descriptors = [request.stdout, request.stderr]
        argv = request.argv
        if request.control is not None:
            descriptors.append(request.control)
            fresh = any(name.startswith(_FRESH_INTERPRETER) for name, _ in request.environment)
            if fresh or request.prefix:
                host = (sys.executable, "-m", _HOST, "--control-fd", "{control}")
                argv = (*request.prefix, *host)
        message = ForkRequest(
            id=self._next,
            argv=argv,
            environment=(*request.environment, (PROCESS_VARIABLE, request.name)),
            working_directory=request.working_directory,
            control=request.control is not None,
            limits=request.limits,
            no_new_privileges=request.no_new_privileges,
            cgroup="" if group is None else group.procs,
        )
        born: asyncio.Future[ForkServerChild] = self._loop.create_future()
        self._pending[message.id] = _Pending(born, request, group)
        try:
            socket.send_fds(self._process.socket, [to_json(message)], descriptors)
        except OSError:
            del self._pending[message.id]
            raise
        return await born

    def belonging(self, processes: Mapping[int, str]) -> frozenset[int]:
        """Return the pids of all that processes have started; their names by pid."""
        others = self._living() - processes.keys()
        return frozenset(belonging(self._process.run_id, self, processes, others))

    async def end_left(
        self, ended: Mapping[int, str], known: Collection[int] = ()
    ) -> tuple[int, ...]:
        """End, bounded, what processes have left that have ended; return the pids.

        Args:
            ended: their names by pid.
            known: pids of what belonged to them before.
        """
        return await end_left(self._process.run_id, self, ended, self._living(), known)

    def _living(self) -> set[int]:
        return {each.pid for each in self._children.values() if not each.exited.done()}

    def disown_ports(self) -> None:
        """Have all participants of this host send no more to ports whose process was killed."""
        self._send(DISOWN, ())

    async def sweep(self, names: Collection[str]) -> tuple[str, ...]:
        """Have files of shared memory removed that are unused, see `lifecycle.middleware.sweep`.

        Returns:
            The names removed; none if the fork server is gone, or does not answer.
        """
        if not names or not self._alive:
            return ()
        self._next += 1
        number, swept = self._next, self._loop.create_future()
        self._sweeping[number] = swept
        self._send("\n".join((SWEEP, str(number), *names)), ())
        done, _ = await asyncio.wait((swept,), timeout=_SWEPT_S)
        self._sweeping.pop(number, None)
        return swept.result() if done else ()

    def _send(self, message: str, descriptors: Collection[int]) -> None:
        """Send what is not answered; one that has died is noticed elsewhere."""
        if self._alive:
            with contextlib.suppress(OSError):
                socket.send_fds(self._process.socket, [message.encode()], list(descriptors))

    def _begin(self, process: ForkServerProcess) -> None:
        self._process = process
        self._alive = True
        self._how = ""
        self._serves = asyncio.Event()
        self._gone = asyncio.Event()
        self._began_s = self._loop.time()
        self._pidfd = os.pidfd_open(process.popen.pid)
        process.socket.setblocking(False)
        self._loop.add_reader(process.socket, self._reports)
        self._loop.add_reader(self._pidfd, self._ended)

    def _reports(self) -> None:
        """Take one report; at end of file it is about to end."""
        if self._report() is False:
            self._loop.remove_reader(self._process.socket)

    def _report(self) -> bool | None:
        """Take one report: True; False at end of file, None if there is nothing more now."""
        try:
            data, descriptors, _, _ = socket.recv_fds(
                self._process.socket, LARGEST_MESSAGE, 1, MSG_CMSG_CLOEXEC
            )
        except BlockingIOError:
            return None
        except ConnectionError:
            return True  # it died with requests unread; what it had sent before still comes
        if not data:
            return False
        report = from_json(data, ChildReport)
        if report.id == SERVES.id:
            self._serves.set()
        elif report.swept is not None:
            if report.id in self._sweeping:
                self._sweeping.pop(report.id).set_result(report.swept)
        elif report.stopped is not None:
            if report.id in self._children:
                self._children[report.id].on_stop(report.stopped)
        elif report.status is not None:
            # On a loaded machine it may come later than we waited for it.
            if report.id in self._children:
                self._children.pop(report.id).settle(report.status)
        else:
            self._born(report, descriptors)
        return True

    def _born(self, report: ChildReport, descriptors: list[int]) -> None:
        born, request, group = self._pending.pop(report.id)
        if report.error:
            if not born.done():
                born.set_exception(BringUpError(report.error))
            return
        child = ForkServerChild(
            report.pid, descriptors[0], request.on_stop, self._lineage, self._send, group=group
        )
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
        self._gone.set()
        if self._closed:
            return
        while self._report():
            pass
        self._loop.remove_reader(self._process.socket)
        self._process.socket.close()
        self._alive = False
        self._has_died = True
        exit_ = ProcessExit(status=status) if status >= 0 else ProcessExit(signal=-status)
        self._how = f"ended unasked ({exit_})"
        for child in tuple(self._children.values()):
            child.adopt()
        for born, _, _ in self._pending.values():
            if not born.done():
                born.set_exception(BringUpError(f"the fork server {self._how}"))
        self._pending.clear()
        for swept in self._sweeping.values():
            swept.set_result(())
        self._sweeping.clear()
        self._renew()

    def _renew(self) -> None:
        """Start another one, and say so."""
        lost, waits = f"the fork server (pid {self.pid}) {self._how}", self._serves
        what = "another one is started when it is needed"
        if self._loop.time() - self._began_s > _SOON_S:
            try:
                self._begin(self._process.again())
                what = f"another one (pid {self.pid}) is started"
            except BringUpError as error:
                what = error.message
        waits.set()
        self._emit(Notice(message=f"{lost}; what it started runs on, and {what}"))

    def note_stops(self) -> None:
        """Take SIGCHLD: children that were left to us may have been stopped, or continue."""
        for child in tuple(self._children.values()):
            child.note_stops()

    async def close(self) -> None:
        """End the fork server; its children must have ended. Then the run's cgroup is removed."""
        await self._end()
        if self._cgroup is not None and (left := self._cgroup.close()):
            self._emit(Notice(message=left))

    async def _end(self) -> None:
        self._closed = True
        if not self._alive:
            return
        self._alive = False
        self._how = "is ended"
        self._loop.remove_reader(self._process.socket)
        self._process.socket.close()
        if not await set_within(self._gone, CLOSE_S):
            self._process.popen.kill()
            await self._gone.wait()
