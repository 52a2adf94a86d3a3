"""Starts the fork server's process, first of all that a run does.

Owns: `Forerunner` and `ForkServerProcess`, which import next to nothing: a fork server imports for
as long as its supervisor does, so it is started before that begins. That of `lifecycle up` is a
fork of the supervisor's process, from when it has imported what both need and nothing else; any
other is a Python of its own. Talking to it is fork_server.py's.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import subprocess
import sys
import traceback
import warnings
from collections.abc import Collection, Mapping, Sequence

from lifecycle.errors import BringUpError
from lifecycle.run_directory import RUN_VARIABLE, new_run_id

PRELOAD = "preload"
"""Begins a message that names modules and interface types, one a line; all others are JSON."""

CLOSE_S = 1.0
"""A fork server whose children have ended ends within milliseconds of its socket."""

_MAIN = "lifecycle.supervisor.processes.fork_server_main"


class _Fork:
    """A process that is a fork of this one; as much of `subprocess.Popen` as is used of it."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._exit_code: int | None = None

    def wait(self, timeout: float | None = None) -> int:
        """Return its exit code, or minus the number of the signal that ended it."""
        if self._exit_code is None:
            if timeout is not None:
                self._await(timeout)
            status = 0  # of one that somebody else has waited for
            with contextlib.suppress(ChildProcessError):
                _, status = os.waitpid(self.pid, 0)
            self._exit_code = os.waitstatus_to_exitcode(status)
        return self._exit_code

    def _await(self, timeout: float) -> None:
        with contextlib.suppress(ProcessLookupError):
            pidfd = os.pidfd_open(self.pid)
            try:
                poll = select.poll()
                poll.register(pidfd, select.POLLIN)
                if not poll.poll(timeout * 1000):
                    raise subprocess.TimeoutExpired(_MAIN, timeout)
            finally:
                os.close(pidfd)

    def kill(self) -> None:
        """End it, unless it has been waited for."""
        if self._exit_code is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)


def _forked(argv: Sequence[str], environment: Mapping[str, str], control: int) -> _Fork:
    """Fork this process, which has one thread of Python's that runs, to be a fork server.

    Args:
        argv: the command line that it would have as a program of its own, and shows.
        environment: its complete environment.
        control: descriptor of its socket; all others but the standard streams are closed in it.

    Raises:
        OSError: the system is out of processes.
    """
    from lifecycle.supervisor.processes import fork_server_main

    fork_server_main.import_shared()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    # What handles signals here must not in the fork, not even before it has handlers of its own.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
    try:
        with warnings.catch_warnings():
            # Python 3.12 warns of any other thread. That which writes standard error has nothing
            # to do with the fork, which writes by itself; those of libraries, see fork_server_main.
            warnings.simplefilter("ignore", DeprecationWarning)
            pid = os.fork()
        if pid == 0:
            try:
                fork_server_main.become(argv, environment, control, mask)
            except BaseException:  # noqa: BLE001 - a fork must end here, whatever happens
                traceback.print_exc()
            finally:
                os._exit(70)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    return _Fork(pid)


class ForkServerProcess:
    """The operating system process of a fork server; can be started before there is an event loop.

    Args:
        preload: import rclpy and what every node has, to fork Python nodes.
        environment: complete environment of the fork server, which its children inherit.
        programs: the supervisor programs networks: what that takes its children shall not have.
        again: another one ran before it.
        forks: it is a fork of this process, see Forerunner.
    """

    def __init__(
        self,
        *,
        preload: bool,
        environment: Mapping[str, str],
        programs: bool = False,
        again: bool = False,
        forks: bool = False,
    ) -> None:
        self._preload = preload
        self._programs = programs
        self._environment = dict(environment)
        self._names: tuple[str, ...] = ()
        self.socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        argv = [sys.executable, "-m", _MAIN, str(theirs.fileno())]
        argv += ["--preload"] * preload + ["--programs"] * programs + ["--again"] * again
        self.popen: subprocess.Popen[bytes] | _Fork
        try:
            if forks:
                self.popen = _forked(argv, self._environment, theirs.fileno())
            else:
                self.popen = subprocess.Popen(
                    argv,
                    stdin=subprocess.DEVNULL,
                    env=self._environment,
                    pass_fds=[theirs.fileno()],
                    start_new_session=True,
                )
        except OSError as error:
            self.socket.close()
            raise BringUpError(f"cannot start the fork server: {error.strerror}") from error
        finally:
            theirs.close()

    def again(self) -> ForkServerProcess:
        """Start another one in the place of this one, which has died.

        Raises:
            BringUpError: it cannot be started.
        """
        another = ForkServerProcess(
            preload=self._preload,
            environment=self._environment,
            programs=self._programs,
            again=True,
        )
        another.preload(self._names)
        return another

    @property
    def run_id(self) -> str:
        """Of the run whose processes it starts; empty for none."""
        return self._environment.get(RUN_VARIABLE, "")

    def preload(self, names: Collection[str]) -> None:
        """Have it import what the nodes of this manifest need besides, before it forks any.

        Args:
            names: see node's `needed_by`; what cannot be imported is left to hosts that need it.
        """
        self._names = tuple(names)
        if self._preload and self._names:
            # One that has died is noticed by who asks it to fork.
            with contextlib.suppress(OSError):
                self.socket.send("\n".join((PRELOAD, *self._names)).encode())

    def close(self, grace_s: float = CLOSE_S) -> None:
        """End the fork server; it ends by itself when its socket closes and no child is left."""
        self.socket.close()
        try:
            self.popen.wait(grace_s)
        except subprocess.TimeoutExpired:
            self.popen.kill()
            self.popen.wait()


_OF_SERVICE_MANAGER = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
"""The supervisor's own, run/service_manager.py: a node that has them could report in its place."""


class Forerunner:
    """A fork server that is started early: before the manifest is read, to import while we do.

    A fork is made after that, and has the manifest in its memory as we have.

    Args:
        preload: see ForkServerProcess.
        without: variables of our environment that nothing it starts shall have.
        programs: see ForkServerProcess.
        forks: it is a fork of this process, once that has imported what both need: half of the
            processor time of a start. Only for a program of ours, which has no thread and holds
            nothing that nodes shall not have. Without effect if there are variables to hide.

    Attributes:
        run_id: of the run that it is for.
    """

    def __init__(
        self,
        *,
        preload: bool = True,
        without: Collection[str] = (),
        programs: bool = False,
        forks: bool = False,
    ) -> None:
        self.run_id = new_run_id()
        hidden = {*without, *_OF_SERVICE_MANAGER}
        environment = {name: text for name, text in os.environ.items() if name not in hidden}
        self.process = ForkServerProcess(
            preload=preload,
            environment={**environment, RUN_VARIABLE: self.run_id},
            programs=programs,
            # The memory of a fork has what is hidden.
            forks=forks and not without and not programs,
        )

    def close(self) -> None:
        """End it; harmless if a run has ended it already."""
        self.process.close()
