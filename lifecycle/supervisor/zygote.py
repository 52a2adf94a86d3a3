"""The supervisor's side of a zygote: a `Spawner` over a socket.

Owns: starting `zygote_main` and following its children by pidfd, so that an end is noticed at
once. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping

from lifecycle.codec import from_json, to_json
from lifecycle.errors import BringUpError
from lifecycle.supervisor.spawn import SpawnRequest
from lifecycle.supervisor.states import ProcessExit
from lifecycle.supervisor.zygote_protocol import (
    LARGEST_MESSAGE,
    MSG_CMSG_CLOEXEC,
    ForkRequest,
    Report,
)

_STATUS_WAIT_S = 1.0
"""The zygote reaps within microseconds; after this long it is taken for dead."""

_FRESH_INTERPRETER = ("PYTHON", "LD_", "RMW_IMPLEMENTATION", "VIRTUAL_ENV")
"""Variables that act while an interpreter starts; a fork of a running one would ignore them."""


class ZygoteProcess:
    """The operating system process of a zygote; can be started before there is an event loop.

    Args:
        preload: import rclpy and the message packages, to fork Python nodes.
        environment: complete environment of the zygote, which its children inherit.
    """

    def __init__(self, *, preload: bool, environment: Mapping[str, str]) -> None:
        self.socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        argv = [sys.executable, "-m", "lifecycle.supervisor.zygote_main", str(theirs.fileno())]
        if preload:
            argv.append("--preload")
        try:
            self.popen = subprocess.Popen(
                argv,
                stdin=subprocess.DEVNULL,
                env=dict(environment),
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )
        finally:
            theirs.close()

    def close(self, grace_s: float = 1.0) -> None:
        """End the zygote; it ends by itself when its socket closes and no child is left."""
        self.socket.close()
        try:
            self.popen.wait(grace_s)
        except subprocess.TimeoutExpired:
            self.popen.kill()
            self.popen.wait()


class ZygoteChild:
    """A process forked by the zygote."""

    def __init__(self, pid: int, pidfd: int) -> None:
        self.pid = pid
        self.exited: asyncio.Future[ProcessExit] = asyncio.get_running_loop().create_future()
        self._pidfd: int | None = pidfd
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(pidfd, self._ended)

    def signal(self, number: int) -> None:
        """Send a signal to the child's group; harmless once it ended."""
        if self._pidfd is None:
            return
        try:
            os.killpg(self.pid, number)
        except ProcessLookupError:
            # It has not reached setsid yet, or only its pidfd still stands for it.
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, number)

    def _ended(self) -> None:
        """The pidfd is readable: it ended. The zygote tells how, unless it is gone itself."""
        assert self._pidfd is not None
        self._loop.remove_reader(self._pidfd)
        self._loop.call_later(_STATUS_WAIT_S, self.settle, None)

    def settle(self, raw: int | None) -> None:
        """Take the status word, or find it ourselves: orphans are adopted by the subreaper."""
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
        self.exited.set_result(exit_)


class Zygote:
    """A `Spawner` that asks a zygote process to fork."""

    def __init__(self, process: ZygoteProcess) -> None:
        self._process = process
        self._pending: dict[int, asyncio.Future[ZygoteChild]] = {}
        self._children: dict[int, ZygoteChild] = {}
        self._on_stop: dict[int, Callable[[bool], None]] = {}
        self._next = 0
        self._loop = asyncio.get_running_loop()
        self._alive = True
        self._process.socket.setblocking(False)
        self._loop.add_reader(self._process.socket, self._report)

    @property
    def pid(self) -> int:
        """Process id of the zygote itself."""
        return self._process.popen.pid

    async def spawn(self, request: SpawnRequest) -> ZygoteChild:
        """Fork one process.

        Raises:
            BringUpError: the zygote is gone, or the system is out of processes.
        """
        if not self._alive:
            raise BringUpError(f"cannot start process {request.name!r}: the fork server has ended")
        self._next += 1
        descriptors = [request.stdout, request.stderr]
        argv = request.argv
        if request.control is not None:
            descriptors.append(request.control)
            if any(name.startswith(_FRESH_INTERPRETER) for name, _ in request.environment):
                argv = (sys.executable, "-m", "lifecycle.node.host", "--control-fd", "{control}")
        message = ForkRequest(
            id=self._next,
            argv=argv,
            environment=request.environment,
            working_directory=request.working_directory,
            control=request.control is not None,
        )
        born: asyncio.Future[ZygoteChild] = self._loop.create_future()
        self._pending[message.id] = born
        self._on_stop[message.id] = request.on_stop
        try:
            socket.send_fds(self._process.socket, [to_json(message)], descriptors)
        except OSError as error:
            del self._pending[message.id], self._on_stop[message.id]
            raise BringUpError(f"cannot start process {request.name!r}: {error}") from error
        try:
            return await born
        except BringUpError as error:
            raise BringUpError(f"cannot start process {request.name!r}: {error.message}") from error

    def _report(self) -> None:
        try:
            data, descriptors, _, _ = socket.recv_fds(
                self._process.socket, LARGEST_MESSAGE, 1, MSG_CMSG_CLOEXEC
            )
        except BlockingIOError:
            return
        except ConnectionError:
            data, descriptors = b"", []
        if not data:
            self._lost()
            return
        report = from_json(data, Report)
        if report.stopped is not None:
            self._on_stop[report.id](report.stopped)
            return
        if report.status is not None:
            del self._on_stop[report.id]
            self._children.pop(report.id).settle(report.status)
            return
        born = self._pending.pop(report.id)
        if report.error:
            del self._on_stop[report.id]
            born.set_exception(BringUpError(report.error))
            return
        child = ZygoteChild(report.pid, descriptors[0])
        self._children[report.id] = child
        if born.cancelled():
            # Whoever asked has given up; a process that nobody knows of must not live.
            child.signal(signal.SIGKILL)
        else:
            born.set_result(child)

    def _lost(self) -> None:
        """The zygote ended before we closed it: nothing can be started any more."""
        self._alive = False
        self._loop.remove_reader(self._process.socket)
        for born in self._pending.values():
            if not born.done():
                born.set_exception(BringUpError("the fork server has ended; its error is above"))
        self._pending.clear()

    async def close(self) -> None:
        """End the zygote."""
        if self._alive:
            self._loop.remove_reader(self._process.socket)
            self._alive = False
        await self._loop.run_in_executor(None, self._process.close)
