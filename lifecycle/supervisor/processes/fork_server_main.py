"""The fork server's own process: forks the processes of a system, and guards them.

Owns: what runs in `python -m lifecycle.supervisor.processes.fork_server_main SOCKET_FD [--preload]
[--programs] [--again]`, or in a fork of the supervisor that is made to be the same (`become`), so
that what both need is imported once. It stays single-threaded and never calls rclpy.init, so that
forking is safe and every child is a participant of its own; with `--preload` a forked host skips
~130 ms of imports. For the same reason it is who handles shared memory that processes have left
(lifecycle.middleware.process.shared_memory). Each child leads a session of its own. It adopts what
its children leave behind (PR_SET_CHILD_SUBREAPER), so as long as it lives, what descends from it is
what the run started. If the supervisor vanishes it ends what is left of its children, bounded, and
of those of a fork server before it that was killed; those that are to be kept it reads, so that
none of them writes to a pipe without a reader.
"""

from __future__ import annotations

import contextlib
import gc
import os
import selectors
import signal
import socket
import sys
import time
import traceback
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from lifecycle import dataclasses
from lifecycle.codec import from_json, to_json
from lifecycle.errors import MiddlewareError
from lifecycle.middleware import (
    adopt_orphans,
    disown_ports,
    drop_network_administration,
    fill_heap,
    limit_resources,
    refuse_new_privileges,
    rename_process,
    sweep,
)
from lifecycle.supervisor.processes.forerunner import PRELOAD

if TYPE_CHECKING:
    from lifecycle.supervisor.processes.logs import ProcessLog

LARGEST_MESSAGE = 1 << 18
"""Bytes; a request is one datagram, its argv and variables must fit."""

MSG_CMSG_CLOEXEC = 0x40000000
"""recvmsg(2): descriptors arrive close-on-exec; the socket module does not name it."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ForkRequest:
    """Supervisor → fork server, with descriptors stdout, stderr and, if `control`, the channel.

    Attributes:
        id: ≥ 1; 0 only asks whether the fork server serves, which answers with the same id.
        limits: see SpawnRequest.
        no_new_privileges: likewise.
        cgroup: file that it writes to join its cgroup; empty to stay in that of the fork server.
    """

    id: int
    argv: tuple[str, ...]
    environment: tuple[tuple[str, str], ...]
    working_directory: str
    control: bool
    limits: tuple[tuple[str, int], ...] = ()
    no_new_privileges: bool = False
    cgroup: str = ""


SERVES = ForkRequest(id=0, argv=(), environment=(), working_directory="", control=False)
"""Forks nothing, see ForkRequest.id."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ChildReport:
    """Fork server → supervisor: a child was forked (with its pidfd), stopped, continued or ended.

    Attributes:
        id: of the ForkRequest.
        pid: of the child; 0 if it could not be forked.
        status: waitpid(2) status; None while it runs.
        error: why it could not be forked.
        stopped: a signal stopped it (True) or made it continue (False); None reports neither.
        swept: names of the files removed, where `SWEEP` asked with this id.
    """

    id: int
    pid: int = 0
    status: int | None = None
    error: str = ""
    stopped: bool | None = None
    swept: tuple[str, ...] | None = None


KEEP = "keep"
"""Begins a message: should the supervisor vanish, spare the child of this pid, and write its output
to this file; one a line, with our ends of its output."""

RELEASE = "release"
"""Begins a message: should the supervisor vanish, end the child of this pid, as all others."""

DISOWN = "disown"
"""A message: have all let go of ports in shared memory whose process was killed; not answered."""

SWEEP = "sweep"
"""Begins a message: remove unused files of shared memory; an id and their names, one a line."""


GRACE_S = 4.0
"""How long orphans get to end by themselves once the supervisor is gone."""

_CHILD_SIGNAL = -1
_ENDED = os.WEXITED | os.WNOWAIT | os.WNOHANG
_STOPS = os.WSTOPPED | os.WCONTINUED | os.WNOHANG
_PIPE_BYTES = 65536
_STDOUT, _STDERR = 1, 2


class _Kept:
    """A child that outlives the supervisor, and its output.

    Attributes:
        log: file that it is written to; empty for none.
    """

    def __init__(self, log: str, outputs: Iterable[int]) -> None:
        self.log = log
        self.outputs = list(outputs)
        self._rest = b""
        self._file: ProcessLog | None = None

    def open(self) -> None:
        """Begin to write its log; nobody else does any more."""
        from lifecycle.supervisor.processes.logs import LogDirectory, ProcessLog

        if self.log:
            path = Path(self.log)
            self._file = ProcessLog(LogDirectory(path.parent, lambda _: None), path.stem)
            self._file.open()

    def read(self, output: int) -> bool:
        """Take what it wrote; False at end of file."""
        try:
            data = os.read(output, _PIPE_BYTES)
        except BlockingIOError:
            return True
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) >= _PIPE_BYTES or not data:
            lines, self._rest = [*lines, self._rest], b""
        for line in lines:
            if self._file is not None and line:
                self._file.add(line.decode(errors="replace"))
        return bool(data)

    def close(self) -> None:
        """Give up its output."""
        for each in self.outputs:
            os.close(each)
        self.outputs = []
        if self._file is not None:
            self._file.close()


class _ForkServer:
    def __init__(self, sock: socket.socket, *, again: bool) -> None:
        self._sock = sock
        self._again = again
        self._serves = True
        self._selector = selectors.DefaultSelector()
        self._selector.register(sock, selectors.EVENT_READ, None)
        self._children: dict[int, tuple[int, int]] = {}  # pid → (request id, pidfd)
        self._kept: dict[int, _Kept] = {}  # by pid
        # SIGCHLD notifies a parent that a child was stopped; nothing else does.
        self._signals = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        signal.signal(signal.SIGCHLD, _arrived)
        signal.set_wakeup_fd(self._signals[1], warn_on_full_buffer=False)
        self._selector.register(self._signals[0], selectors.EVENT_READ, _CHILD_SIGNAL)

    def serve(self) -> None:
        """Fork on request and report ends until the supervisor closes its side."""
        while True:
            for key, _ in self._selector.select():
                if key.data == _CHILD_SIGNAL:
                    self._note_stops()
                    self._bury_adopted()
                elif key.data is not None:
                    self._reap(key.data)
                elif not self._request():
                    self._guard()
                    return

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
        else:
            self._obey(data.decode(), descriptors)
        return True

    def _obey(self, message: str, descriptors: Collection[int]) -> None:
        """Do what one of the words above says."""
        word, *lines = message.split("\n")
        if word == DISOWN:
            disown_ports()
        elif word == SWEEP:
            number, *names = lines
            self._tell(ChildReport(id=int(number), swept=sweep(names)))
        elif word in (KEEP, RELEASE):
            self._keep(message, descriptors)
        elif word == PRELOAD:
            _preload_for_some(lines)

    def _fork(self, request: ForkRequest, descriptors: list[int]) -> None:
        if request == SERVES:
            self._tell(ChildReport(id=request.id))
            return
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
            self._born(request.id, pid)

    def _keep(self, message: str, outputs: Iterable[int]) -> None:
        """Spare a child should the supervisor vanish, or not any more."""
        what, pid, log = message.split("\n", 2)
        kept = _Kept(log, outputs)
        if what == KEEP and int(pid) in self._children:
            self._kept[int(pid)] = kept
        else:
            kept.close()
            self._give_up(int(pid))

    def _give_up(self, pid: int) -> None:
        """Keep a child no more."""
        if (kept := self._kept.pop(pid, None)) is not None:
            for each in kept.outputs:
                with contextlib.suppress(KeyError):
                    self._selector.unregister(each)
                if not self._serves:
                    kept.read(each)
            kept.close()

    def _born(self, request: int, pid: int) -> None:
        pidfd = os.pidfd_open(pid)
        self._children[pid] = (request, pidfd)
        self._selector.register(pidfd, selectors.EVENT_READ, pid)
        self._tell(ChildReport(id=request, pid=pid), pidfd)

    def _reap(self, pid: int) -> None:
        if pid not in self._children:
            return  # on the way to an adopted one
        request, pidfd = self._children.pop(pid)
        self._selector.unregister(pidfd)
        os.close(pidfd)
        _, status = os.waitpid(pid, 0)
        self._give_up(pid)
        self._tell(ChildReport(id=request, pid=pid, status=status))

    def _note_stops(self) -> None:
        """Report which children were stopped or continue."""
        with contextlib.suppress(BlockingIOError):
            os.read(self._signals[0], _PIPE_BYTES)
        with contextlib.suppress(ChildProcessError):
            while (found := os.waitid(os.P_ALL, 0, _STOPS)) is not None:
                if found.si_pid in self._children:
                    request, _ = self._children[found.si_pid]
                    stopped = found.si_code != os.CLD_CONTINUED
                    self._tell(ChildReport(id=request, pid=found.si_pid, stopped=stopped))

    def _bury_adopted(self) -> None:
        """Reap orphans that have ended, and children where one of them is in between."""
        with contextlib.suppress(ChildProcessError):
            while (found := os.waitid(os.P_ALL, 0, _ENDED)) is not None:
                if found.si_pid in self._children:
                    self._reap(found.si_pid)
                else:
                    os.waitpid(found.si_pid, 0)

    def _tell(self, report: ChildReport, *descriptors: int) -> None:
        # A supervisor that is gone is noticed by the next read.
        with contextlib.suppress(ConnectionError):
            socket.send_fds(self._sock, [to_json(report)], descriptors)

    def _guard(self) -> None:
        """End what is left: hosts end by themselves at end of file, commands are asked to.

        What is kept is read until it ends; that may be asked for by the next `up`, or by `down`.
        """
        self._serves = False
        self._selector.unregister(self._sock)
        for kept in self._kept.values():
            kept.open()
            for output in kept.outputs:
                self._selector.register(output, selectors.EVENT_READ, kept)
        self._signal(signal.SIGINT)
        deadline = time.monotonic() + GRACE_S
        while self._doomed() and (left := deadline - time.monotonic()) > 0:
            self._attend(left)
        self._signal(signal.SIGKILL)
        for pid in self._doomed():
            self._reap(pid)
        if self._again:
            from lifecycle.run_directory import RUN_VARIABLE
            from lifecycle.supervisor.processes.orphans import end_strays

            end_strays(os.environ.get(RUN_VARIABLE, ""), spare=self._kept)
        while self._kept:
            self._attend(None)

    def _attend(self, limit_s: float | None) -> None:
        """Bury children that have ended, and take what those that are kept write."""
        for key, _ in self._selector.select(limit_s):
            if key.data == _CHILD_SIGNAL:
                self._note_stops()
                self._bury_adopted()
            elif not isinstance(key.data, _Kept):
                self._reap(key.data)
            elif key.fd in key.data.outputs and not key.data.read(key.fd):
                self._selector.unregister(key.fd)

    def _doomed(self) -> tuple[int, ...]:
        return tuple(pid for pid in self._children if pid not in self._kept)

    def _signal(self, number: int) -> None:
        for pid in self._doomed():
            with contextlib.suppress(ProcessLookupError):
                os.killpg(pid, number)

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
            for _, pidfd in self._children.values():
                os.close(pidfd)
            for kept in self._kept.values():
                kept.close()
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


def _take_streams(stdout: int, stderr: int) -> None:
    null = os.open(os.devnull, os.O_RDONLY)
    for descriptor, number in ((null, 0), (stdout, 1), (stderr, 2)):
        os.dup2(descriptor, number)
        os.close(descriptor)
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(line_buffering=True)  # type: ignore[union-attr]


def _confine(request: ForkRequest) -> None:
    if request.cgroup:
        _join(request.cgroup)
    try:
        limit_resources(request.limits)
        if request.no_new_privileges:
            refuse_new_privileges()
    except MiddlewareError as error:
        print(error, file=sys.stderr)
        raise SystemExit(1) from error


def _join(procs: str) -> None:
    """Have this process, and all that it will start, in a cgroup, see cgroups(7)."""
    try:
        descriptor = os.open(procs, os.O_WRONLY | os.O_CLOEXEC)
        os.write(descriptor, b"0")
        os.close(descriptor)
    except OSError as error:
        print(f"cannot join cgroup {str(Path(procs).parent)!r}: {error.strerror}", file=sys.stderr)
        raise SystemExit(1) from error


def _run(argv: tuple[str, ...], control: int | None) -> int:
    """Serve as our host, or become another program.

    A host ends by itself when its control channel does. A command has none: it outlives a fork
    server that is killed, as hosts do, and is ended by the supervisor, the next fork server or the
    next `up`.
    """
    if not argv:
        assert control is not None
        from lifecycle.node import serve

        _reseed()
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


def _reseed() -> None:
    """Give this fork random numbers of its own; CPython reseeds only its `random` module."""
    numpy_random = sys.modules.get("numpy.random")
    if numpy_random is not None:
        numpy_random.seed()


_BLAS_TIMEOUT = "OPENBLAS_THREAD_TIMEOUT"
"""The logarithm of how many cycles a thread of OpenBLAS looks for work before it sleeps."""


@contextlib.contextmanager
def _idle_blas() -> Iterator[None]:
    """Have threads that numpy starts when it is imported sleep at once, as nothing uses them yet.

    Else they look for work for 26 ms and more, each of them, while all processors are needed. What
    a node calculates wakes them, in microseconds.
    """
    before = os.environ.get(_BLAS_TIMEOUT)
    os.environ.setdefault(_BLAS_TIMEOUT, "4")  # the least
    try:
        yield
    finally:
        if before is None:
            del os.environ[_BLAS_TIMEOUT]


def _preload() -> None:
    from lifecycle.node import preload

    with _pages_shared():
        preload()


def _preload_for_some(names: Iterable[str]) -> None:
    from lifecycle.node import preload_for_some

    with _pages_shared():
        preload_for_some(names)


@contextlib.contextmanager
def _pages_shared() -> Iterator[None]:
    """Keep the pages of what is imported inside shared: a first collection would touch them.

    None takes place meanwhile: importing makes next to no garbage, and a lot to look through.
    """
    gc.disable()
    with _idle_blas():
        yield
    fill_heap()
    gc.freeze()
    gc.enable()


def import_shared() -> None:
    """Import what a supervisor needs as well as a fork server, before one becomes the other."""
    from lifecycle.node import preload_shared

    with _idle_blas():
        preload_shared()


def become(
    argv: Sequence[str], environment: Mapping[str, str], control: int, mask: Iterable[int]
) -> NoReturn:
    """Turn a fork of a supervisor into what `argv` would start; never returns.

    Like a program it has an environment, a command line and a session of its own, the descriptors
    and handlers of signals that a program would inherit, and none of its parent's threads. Where
    the kernel does not let it have that environment for all to see, by which others recognise what
    belongs to a run, it executes the program.

    Args:
        argv: a command line of this module, by `python -m`.
        environment: complete.
        control: descriptor of its socket.
        mask: of signals; while this is called all are blocked.
    """
    os.setsid()
    for number in map(int, signal.valid_signals()):
        if callable(signal.getsignal(number)):
            signal.signal(number, signal.SIG_DFL)
    for each in os.listdir("/proc/self/fd"):  # noqa: PTH208 - names are numbers
        if int(each) > _STDERR and int(each) != control:
            with contextlib.suppress(OSError):  # that by which they are listed
                os.close(int(each))
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.close(null)
    try:
        rename_process(argv, environment)
    except MiddlewareError:
        os.set_inheritable(control, True)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        os.execve(argv[0], [*argv], environment)  # noqa: S606 - as the supervisor would
    for name in os.environ.keys() - environment.keys():
        del os.environ[name]
    os.environ.update(environment)
    # The supervisor has streams of its own, and a thread that writes one of them.
    sys.stdin, sys.stdout, sys.stderr = sys.__stdin__, sys.__stdout__, sys.__stderr__
    for name, number in (("stdout", _STDOUT), ("stderr", _STDERR)):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w", closefd=False))
    module = sys.modules[__name__]
    sys.modules["__main__"] = module
    sys.orig_argv = [*argv]
    sys.argv = [str(module.__file__), *argv[3:]]
    if not getattr(sys.flags, "safe_path", False):
        sys.path[0] = os.getcwd()  # noqa: PTH109 - it is a text
    main(mask)


def main(mask: Iterable[int] | None = None) -> NoReturn:
    """Run the fork server: the arguments of this program are what a ForkServerProcess gives it.

    Args:
        mask: of signals, once they are handled; None leaves it.
    """
    descriptor, *options = sys.argv[1:]
    # Ctrl-C is the supervisor's to handle, and its end is what ends us.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    if mask is not None:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    adopt_orphans()
    if "--programs" in options and os.geteuid() != 0:
        drop_network_administration()
    if "--preload" in options:
        _preload()
    with socket.socket(fileno=int(descriptor)) as control:
        _ForkServer(control, again="--again" in options).serve()
    os._exit(0)


if __name__ == "__main__":
    main()
