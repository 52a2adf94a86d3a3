"""Starts the fork server's process, first of all that a run does.

Owns: `Forerunner` and `ForkServerProcess`, which import next to nothing: a fork server imports for
as long as its supervisor does, so it is started before that begins. Talking to it is
fork_server.py's. Must not import rclpy.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
from collections.abc import Collection, Mapping

from lifecycle.errors import BringUpError
from lifecycle.run_directory import RUN_VARIABLE, new_run_id

PRELOAD = "preload"
"""Begins a message that names modules and interface types, one a line; all others are JSON."""

CLOSE_S = 1.0
"""A fork server whose children have ended ends within milliseconds of its socket."""

_MAIN = "lifecycle.supervisor.processes.fork_server_main"


class ForkServerProcess:
    """The operating system process of a fork server; can be started before there is an event loop.

    Args:
        preload: import rclpy and what every node has, to fork Python nodes.
        environment: complete environment of the fork server, which its children inherit.
        programs: the supervisor programs networks: what that takes its children shall not have.
        again: another one ran before it.
    """

    def __init__(
        self,
        *,
        preload: bool,
        environment: Mapping[str, str],
        programs: bool = False,
        again: bool = False,
    ) -> None:
        self._preload = preload
        self._programs = programs
        self._environment = dict(environment)
        self._names: tuple[str, ...] = ()
        self.socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        argv = [sys.executable, "-m", _MAIN, str(theirs.fileno())]
        argv += ["--preload"] * preload + ["--programs"] * programs + ["--again"] * again
        try:
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
    """A fork server that is started before the manifest is read, to import while we do.

    Args:
        preload: see ForkServerProcess.
        without: variables of our environment that nothing it starts shall have.
        programs: see ForkServerProcess.

    Attributes:
        run_id: of the run that it is for.
    """

    def __init__(
        self, *, preload: bool = True, without: Collection[str] = (), programs: bool = False
    ) -> None:
        self.run_id = new_run_id()
        hidden = {*without, *_OF_SERVICE_MANAGER}
        environment = {name: text for name, text in os.environ.items() if name not in hidden}
        self.process = ForkServerProcess(
            preload=preload,
            environment={**environment, RUN_VARIABLE: self.run_id},
            programs=programs,
        )

    def close(self) -> None:
        """End it; harmless if a run has ended it already."""
        self.process.close()
