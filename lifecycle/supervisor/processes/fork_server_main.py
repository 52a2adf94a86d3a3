"""The fork server's own process: forks the processes of a system.

Owns: starting it, first of all that a run does, so nothing here takes long to import; and what runs
in `python -m lifecycle.supervisor.processes.fork_server_main SOCKET_FD [--preload] [--programs]`.
That stays single-threaded and never calls rclpy.init, so that forking is safe and every child is a
participant of its own; with `--preload` a forked host skips ~130 ms of imports. Each child leads a
session of its own. It adopts what its children leave behind (PR_SET_CHILD_SUBREAPER), so as long as
it lives, what descends from it is what the run started. If the supervisor vanishes it ends what is
left of its children, bounded.
"""

from __future__ import annotations

import contextlib
import gc
import os
import selectors
import signal
import socket
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Collection, Iterable
from typing import NoReturn

import msgspec

from lifecycle.codec import from_json, to_json
from lifecycle.errors import BringUpError, MiddlewareError
from lifecycle.middleware.process.control import (
    adopt_orphans,
    drop_network_administration,
    limit_resources,
    refuse_new_privileges,
)
from lifecycle.run_directory import RUN_VARIABLE, new_run_id

LARGEST_MESSAGE = 1 << 18
"""Bytes; a request is one datagram, its argv and variables must fit."""

MSG_CMSG_CLOEXEC = 0x40000000
"""recvmsg(2): descriptors arrive close-on-exec; the socket module does not name it."""

GRACE_S = 4.0
"""How long orphans get to end by themselves once the supervisor is gone."""


class ForkRequest(msgspec.Struct, frozen=True, kw_only=True):
    """Supervisor → fork server, with descriptors stdout, stderr and, if `control`, the channel.

    Attributes:
        id: ≥ 1.
        argv: command line; empty for a process that serves the control channel as our node host.
        environment: (name, value) on top of the fork server's own environment.
        working_directory: empty for the fork server's own.
        limits: (name, value) of setrlimit(2), `RLIMIT_NOFILE`.
        no_new_privileges: see prctl(2), PR_SET_NO_NEW_PRIVS.
        grace_s: seconds that the process gets to end by itself once the supervisor is gone.
    """

    id: int
    argv: tuple[str, ...]
    environment: tuple[tuple[str, str], ...]
    working_directory: str
    control: bool
    limits: tuple[tuple[str, int], ...] = ()
    no_new_privileges: bool = False
    grace_s: float = GRACE_S


class ChildReport(msgspec.Struct, frozen=True, kw_only=True):
    """Fork server → supervisor: a child was forked (with its pidfd), stopped, continued or ended.

    Attributes:
        id: of the ForkRequest.
        pid: of the child; 0 if it could not be forked.
        status: exit code, below 0 for a signal; None while it runs.
        error: why it could not be forked.
        stopped: a signal stopped it (True) or made it continue (False); None reports neither.
    """

    id: int
    pid: int = 0
    status: int | None = None
    error: str = ""
    stopped: bool | None = None


_CLOSE_S = 1.0
"""A fork server whose children have ended ends within milliseconds of its socket."""

_MAIN = "lifecycle.supervisor.processes.fork_server_main"

_OF_SERVICE_MANAGER = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
"""The supervisor's own, run/journal.py: a node that has them could report in its place."""

_CHANGES = os.WNOHANG | os.WUNTRACED | os.WCONTINUED
_WAKEUP_BYTES = 4096


class ForkServerProcess:
    """The operating system process of a fork server; can be started before there is an event loop.

    Args:
        preload: import rclpy and what every node has, to fork Python nodes.
        without: variables of our environment that nothing it starts shall have.
        programs: the supervisor programs networks: what that takes its children shall not have.

    Attributes:
        run_id: of the run that it is for.

    Raises:
        BringUpError: it cannot be started.
    """

    def __init__(
        self, *, preload: bool = True, without: Collection[str] = (), programs: bool = False
    ) -> None:
        self.run_id = new_run_id()
        self._preloads = preload
        hidden = {*without, *_OF_SERVICE_MANAGER}
        environment = {name: text for name, text in os.environ.items() if name not in hidden}
        self.socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        argv = [sys.executable, "-m", _MAIN, str(theirs.fileno())]
        try:
            self.popen = subprocess.Popen(
                [*argv, *["--preload"] * preload, *["--programs"] * programs],
                stdin=subprocess.DEVNULL,
                env={**environment, RUN_VARIABLE: self.run_id},
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )
        except OSError as error:
            self.socket.close()
            raise BringUpError(f"cannot start the fork server: {error.strerror}") from error
        finally:
            theirs.close()

    def preload(self, types: Collection[str]) -> None:
        """Have it import interface types once, before it forks nodes that use them."""
        if self._preloads and types:
            # One that has died is noticed by what asks it to fork.
            with contextlib.suppress(OSError):
                self.socket.send("\n".join(types).encode())

    def close(self) -> None:
        """End it: it ends once its socket is closed and no child is left. Again is harmless."""
        self.socket.close()
        try:
            self.popen.wait(_CLOSE_S)
        except subprocess.TimeoutExpired:
            self.popen.kill()
            self.popen.wait()


class _ForkServer:
    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._selector = selectors.DefaultSelector()
        self._selector.register(sock, selectors.EVENT_READ)
        self._children: dict[int, ForkRequest] = {}  # by pid
        self._signals = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        signal.signal(signal.SIGCHLD, _arrived)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGCHLD})  # what started us may block it
        signal.set_wakeup_fd(self._signals[1], warn_on_full_buffer=False)
        self._selector.register(self._signals[0], selectors.EVENT_READ)

    def serve(self) -> None:
        """Fork on request and report ends until the supervisor closes its side."""
        serves = True
        while serves:
            for key, _ in self._selector.select():
                if key.fileobj is not self._sock:
                    self._reap()
                elif not self._request():
                    serves = False
        self._selector.unregister(self._sock)
        self._end_all()

    def _request(self) -> bool:
        """Serve one request; False at end of file."""
        try:
            data, descriptors, _, _ = socket.recv_fds(
                self._sock, LARGEST_MESSAGE, 3, MSG_CMSG_CLOEXEC
            )
        except ConnectionError:
            return False
        if not data:
            return False
        if data.startswith(b"{"):
            self._fork(from_json(data, ForkRequest), descriptors)
            return True
        _preload(data.decode().split("\n"))
        return True

    def _fork(self, request: ForkRequest, descriptors: list[int]) -> None:
        try:
            with warnings.catch_warnings():
                # Python 3.12 warns of any other thread. Those here belong to the libraries that
                # were preloaded (numpy's among them), are idle, and hold no lock of Python's.
                warnings.simplefilter("ignore", DeprecationWarning)
                pid = os.fork()
        except OSError as error:
            pid = -1
            self._tell(ChildReport(id=request.id, error=str(error)))
        if pid == 0:
            self._become(request, descriptors)
        for descriptor in descriptors:
            os.close(descriptor)
        if pid > 0:
            self._children[pid] = request
            pidfd = os.pidfd_open(pid)
            self._tell(ChildReport(id=request.id, pid=pid), pidfd)
            os.close(pidfd)

    def _reap(self) -> None:
        """Report which children were stopped, continue or have ended; bury orphans, too."""
        with contextlib.suppress(BlockingIOError):
            os.read(self._signals[0], _WAKEUP_BYTES)
        with contextlib.suppress(ChildProcessError):
            while (found := os.waitpid(-1, _CHANGES)) != (0, 0):
                pid, status = found
                lives = os.WIFSTOPPED(status) or os.WIFCONTINUED(status)
                request = self._children.get(pid) if lives else self._children.pop(pid, None)
                if request is not None:
                    stopped = os.WIFSTOPPED(status) if lives else None
                    ended = None if lives else os.waitstatus_to_exitcode(status)
                    self._tell(ChildReport(id=request.id, pid=pid, status=ended, stopped=stopped))

    def _tell(self, report: ChildReport, *descriptors: int) -> None:
        # A supervisor that is gone is noticed by the next read.
        with contextlib.suppress(ConnectionError):
            socket.send_fds(self._sock, [to_json(report)], descriptors)

    def _end_all(self) -> None:
        """End what is left, bounded: the supervisor is gone.

        Hosts notice the end of their control channel, deactivate their nodes and end by themselves;
        commands are asked to.
        """
        began_s = time.monotonic()
        for pid, request in self._children.items():
            if not request.control:
                _signal(pid, signal.SIGINT)
        while self._children:
            passed_s = time.monotonic() - began_s
            left_s = {pid: each.grace_s - passed_s for pid, each in self._children.items()}
            for pid, each_s in left_s.items():
                if each_s <= 0:
                    _signal(pid, signal.SIGKILL)
            self._selector.select(max(0.0, min(left_s.values())) or None)
            self._reap()

    def _become(self, request: ForkRequest, descriptors: list[int]) -> NoReturn:
        """Turn this fork into the requested process; never returns to the fork server's code."""
        code = 70
        try:
            os.setsid()
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            for descriptor in self._signals:
                os.close(descriptor)
            self._selector.close()
            self._sock.close()
            # A host takes them itself, once there is something to shut down; until then it ends
            # at once, and without a KeyboardInterrupt in the middle of an import.
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            _take_streams(descriptors[0], descriptors[1])
            os.environ.update(dict(request.environment))
            if request.working_directory:
                os.chdir(request.working_directory)
            _confine(request)
            control = descriptors[2] if request.control else None
            code = _run(request.argv, control)
        except SystemExit as error:
            code = error.code if isinstance(error.code, int) else 1
        except BaseException:  # noqa: BLE001 - a fork must end here, whatever happens
            traceback.print_exc()
        finally:
            with contextlib.suppress(Exception):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(code)


def _arrived(number: int, frame: object) -> None:
    """Replace the default, which notifies nothing; the wake-up descriptor ends the select."""


def _signal(pid: int, number: int) -> None:
    """Signal a child's group, which it leads once it has reached setsid."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(pid, number)


def _take_streams(stdout: int, stderr: int) -> None:
    null = os.open(os.devnull, os.O_RDONLY)
    for descriptor, number in ((null, 0), (stdout, 1), (stderr, 2)):
        os.dup2(descriptor, number)
        os.close(descriptor)
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(line_buffering=True)  # type: ignore[union-attr]


def _confine(request: ForkRequest) -> None:
    try:
        limit_resources(request.limits)
        if request.no_new_privileges:
            refuse_new_privileges()
    except MiddlewareError as error:
        print(error, file=sys.stderr)
        raise SystemExit(1) from error


def _run(argv: tuple[str, ...], control: int | None) -> int:
    """Serve as our host, or become another program."""
    if not argv:
        assert control is not None
        from lifecycle.node.host.host import serve

        if (numpy_random := sys.modules.get("numpy.random")) is not None:
            numpy_random.seed()  # CPython gives a fork random numbers of its own in `random` only
        return serve(socket.socket(fileno=control))
    if control is not None:
        os.set_inheritable(control, True)
        argv = tuple(word.replace("{control}", str(control)) for word in argv)
    for number in (signal.SIGPIPE, signal.SIGXFSZ):  # which Python ignores, and exec would keep so
        signal.signal(number, signal.SIG_DFL)
    try:
        os.execvp(argv[0], argv)  # noqa: S606 - what a spawner is for
    except OSError as error:
        print(f"cannot run {argv[0]!r}: {error.strerror}", file=sys.stderr)
        return 126 if isinstance(error, PermissionError) else 127


def _preload(types: Iterable[str]) -> None:
    """Import what every Python node has, and interface types."""
    from lifecycle.node.host.host import preload

    # A first collection would touch the pages of what is imported, and share them no more.
    gc.disable()
    preload(types)
    gc.freeze()
    gc.enable()


def main() -> NoReturn:
    """Run the fork server: the arguments of this program are what a ForkServerProcess gives it."""
    descriptor, *options = sys.argv[1:]
    # Ctrl-C is the supervisor's to handle, and its end is what ends us.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    adopt_orphans()
    if "--programs" in options and os.geteuid() != 0:
        drop_network_administration()
    if "--preload" in options:
        _preload(())
    with socket.socket(fileno=int(descriptor)) as control:
        _ForkServer(control).serve()
    os._exit(0)


if __name__ == "__main__":
    main()
