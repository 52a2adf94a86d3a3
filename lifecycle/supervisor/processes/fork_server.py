"""The supervisor's side of a fork server, and what is ended that its processes left behind.

Owns: asking it to fork, following its children by pidfd, so that an end is noticed at once, and
finding, without guessing, what a run has started and what of a killed supervisor's is left. A
process belongs to a run if it descends from the run's fork server, which adopts all that its
descendants leave behind, or if its environment carries the run's id. Other children of this process
do not: it may have become the supervisor by exec of a shell with background jobs. A pid alone never
proves it. A run whose fork server dies fails: its children become this process's own, and are
ended. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from lifecycle.codec import from_json, to_json
from lifecycle.errors import BringUpError
from lifecycle.run_directory import (
    OWN_CHILD,
    PROCESS_VARIABLE,
    RUN_VARIABLE,
    RunRecord,
    boot_id,
    groups_of,
    is_process,
    parent_of,
)
from lifecycle.supervisor.processes.fork_server_main import (
    LARGEST_MESSAGE,
    MSG_CMSG_CLOEXEC,
    ChildReport,
    ForkRequest,
    ForkServerProcess,
)
from lifecycle.supervisor.processes.process import (
    ManagedProcess,
    ProcessExit,
    run_delay_s,
    scope,
)

_STATUS_WAIT_S = 1.0
"""The fork server reaps within microseconds; after this long its report does not come any more."""

_LEFT_S = 0.5
"""Between asking what a process left to end and killing it: another waits to start in its place."""

_ORPHAN_GRACE_S = 3.0
"""Between asking an orphan to end and killing it."""

_KILL_S = 5.0
"""How long the kernel may take to end a killed process, before it is reported."""

_ROUNDS = 3
"""How often what was started while others were ended is looked for."""

_LOOK_S = 0.02

_HOST = "lifecycle.node.host.host"

_FRESH_INTERPRETER = ("PYTHON", "LD_", "RMW_IMPLEMENTATION", "VIRTUAL_ENV")
"""Variables that act while an interpreter starts; a fork of a running one would ignore them."""


class _Child(NamedTuple):
    """A process that was forked, and what it is followed by."""

    process: ManagedProcess
    pid: int
    pidfd: int


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
        self._pending: dict[int, tuple[asyncio.Future[int], ManagedProcess]] = {}
        self._children: dict[int, _Child] = {}  # those that have not ended, by their requests
        self._next = 0
        # Of a shell that became this process by exec: no part of the run.
        self._foreign = {*children().get(os.getpid(), ())}
        self.died: asyncio.Future[str] = self._loop.create_future()
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
        roots = {self.pid}
        if self.died.done():
            # What it had adopted, and what it had started, is ours now.
            roots |= {*children().get(os.getpid(), ())} - self._foreign
        return frozenset(descendants(roots) - {self.pid})

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
    ) -> int:
        """Fork one process, in a session of its own; return its pid. Its end settles it.

        `streams` are descriptors for its standard output and error, `control` that of the host's
        end of the control channel, None for a foreign command; they are not closed here.

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
        born: asyncio.Future[int] = self._loop.create_future()
        try:
            self._ask(to_json(message), descriptors)
            self._pending[message.id] = (born, process)
            return await born
        except BringUpError as error:
            raise BringUpError(f"cannot start process {process.name!r}: {error.message}") from error

    def signal(self, pid: int, number: int) -> None:
        """Send a signal to the group of a child; harmless once it ended."""
        pidfd = next((each.pidfd for each in self._children.values() if each.pid == pid), None)
        if pidfd is None:
            return
        try:
            os.killpg(pid, number)
        except ProcessLookupError:
            # It has not reached setsid yet, or only its pidfd is left of it.
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(pidfd, number)

    def run_delay_s(self, pid: int) -> float:
        """Return how long the main thread of a process has waited for a processor."""
        return run_delay_s(str(pid))

    def belonging(self, processes: Mapping[int, str]) -> set[int]:
        """Return the pids of all that processes have started, whether they live or not.

        It belongs to one if it descends from it, is in its session or group, carries its name in
        its environment, or descends from one of these. `processes` are names by pid.
        """
        others = {each.pid for each in self._children.values()} - processes.keys()
        spared = descendants(others)
        names = set(processes.values())
        found = {pid for pid, name in marked(self._process.run_id).items() if name in names}
        for pid in self.family():
            groups = groups_of(pid)
            if not processes.keys().isdisjoint(groups) and spared.isdisjoint(groups):
                found.add(pid)
        found = descendants({*(found - spared), *processes})
        return found - spared - processes.keys() - {os.getpid(), self.pid}

    async def end_left(
        self, ended: Mapping[int, str], known: Collection[int] = ()
    ) -> tuple[int, ...]:
        """End, bounded, what processes that `ended` have left; return the pids.

        Pids of what belonged to them before are `known`.
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
        if report.id in self._pending:
            self._born(report, descriptors)
        elif child is not None and report.stopped is not None:
            child.process.on_stop(report.stopped)
        elif child is not None and report.status is not None:
            self._settle(report.id, ProcessExit.of(report.status))

    def _born(self, report: ChildReport, descriptors: list[int]) -> None:
        born, process = self._pending.pop(report.id)
        if report.error:
            if not born.done():
                born.set_exception(BringUpError(report.error))
            return
        child = self._children[report.id] = _Child(process, report.pid, descriptors[0])
        self._loop.add_reader(child.pidfd, self._gone, report.id, _STATUS_WAIT_S)
        if born.cancelled():
            # The caller has given up; a process that no caller knows must not live.
            self.signal(child.pid, signal.SIGKILL)
        else:
            born.set_result(child.pid)

    def _gone(self, number: int, patience_s: float) -> None:
        """The pidfd of a child is readable. The fork server reports how, unless it is gone."""
        if (child := self._children.get(number)) is None:
            return
        self._loop.remove_reader(child.pidfd)
        found = None
        with contextlib.suppress(ChildProcessError):  # else the fork server has left it to us
            found = os.waitid(os.P_PIDFD, child.pidfd, os.WEXITED | os.WNOHANG)
        if found is not None:
            sign = 1 if found.si_code == os.CLD_EXITED else -1
            self._settle(number, ProcessExit.of(sign * found.si_status))
        elif patience_s > 0:
            self._loop.call_later(patience_s, self._gone, number, 0.0)
        else:
            self._settle(number, ProcessExit())

    def _settle(self, number: int, how: ProcessExit) -> None:
        child = self._children.pop(number)
        self._loop.remove_reader(child.pidfd)
        os.close(child.pidfd)
        child.process.settle(how)

    def _ended(self) -> None:
        """The fork server itself has ended: by now its children are ours."""
        self._loop.remove_reader(self._pidfd)
        os.close(self._pidfd)
        end = ProcessExit.of(self._process.popen.wait())
        self._reports()
        self.died.set_result(f"the fork server (pid {self.pid}) ended unasked: {end}")
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


def reap_adopted(spare: Iterable[int]) -> None:
    """Bury ended orphans that the kernel gave us (PR_SET_CHILD_SUBREAPER).

    While a program of OWN_CHILD runs they wait: for the next time, or for our own end.
    """
    if not OWN_CHILD.acquire(blocking=False):
        return
    try:
        spared = set(spare)
        for pid in {*children().get(os.getpid(), ())} - spared:
            with contextlib.suppress(ChildProcessError):
                os.waitpid(pid, os.WNOHANG)
    finally:
        OWN_CHILD.release()


def end_run(record: RunRecord) -> tuple[int, ...]:
    """End what is left of a run whose supervisor was killed; return the pids. Blocks."""
    if record.boot_id != boot_id():
        return ()
    pids = {child.pid for child in record.children if is_process(child.pid, child.start_ticks)}
    pids |= marked(record.run_id).keys()
    return asyncio.run(end(descendants(pids) - {os.getpid()}, _ORPHAN_GRACE_S))


def children() -> dict[int, list[int]]:
    """Return the children of each process, adopted ones included."""
    found: dict[int, list[int]] = {}
    for entry in os.listdir("/proc"):  # noqa: PTH208 - hot loop
        if entry.isdigit() and (parent := parent_of(int(entry))) is not None:
            found.setdefault(parent, []).append(int(entry))
    return found


def descendants(pids: Iterable[int]) -> set[int]:
    """Return processes and all that descends from them."""
    found, left, known = set[int](), {*pids}, children()
    while left:
        found |= left
        left = {child for pid in left for child in known.get(pid, ())} - found
    return found


def marked(run_id: str) -> dict[int, str]:
    """Return the planned process whose name each process carries that carries the run's id."""
    mark = f"{RUN_VARIABLE}={run_id}".encode()
    prefix = f"{PROCESS_VARIABLE}=".encode()
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        with contextlib.suppress(OSError):
            words = (entry / "environ").read_bytes().split(b"\0")
            if mark in words:
                names = [each.removeprefix(prefix) for each in words if each.startswith(prefix)]
                found[int(entry.name)] = os.fsdecode(names[-1]) if names else ""
    return found


async def end(pids: Iterable[int], grace_s: float) -> tuple[int, ...]:
    """End processes, killing what has not ended after `grace_s`; return those that lived."""
    # Held by their pidfds, so that no signal can reach a later owner of a pid.
    held: dict[int, int] = {}
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            held[os.pidfd_open(pid)] = pid
    try:
        left = _living(held)
        ended = tuple(sorted(held[each] for each in left))
        for number, wait_s in ((signal.SIGTERM, grace_s), (signal.SIGKILL, _KILL_S)):
            for each in left:
                with contextlib.suppress(ProcessLookupError):
                    signal.pidfd_send_signal(each, number)
                    # A stopped process ends only once it goes on.
                    signal.pidfd_send_signal(each, signal.SIGCONT)
            deadline = time.monotonic() + wait_s
            while (left := _living(left)) and time.monotonic() < deadline:  # noqa: ASYNC110
                await asyncio.sleep(_LOOK_S)
        return ended
    finally:
        for each in held:
            os.close(each)


def _living(pidfds: Iterable[int]) -> list[int]:
    """Return those whose processes have not ended: then a pidfd can be read."""
    poll = select.poll()
    for each in pidfds:
        poll.register(each, select.POLLIN)
    ended = {pidfd for pidfd, _ in poll.poll(0)}
    return [each for each in pidfds if each not in ended]
