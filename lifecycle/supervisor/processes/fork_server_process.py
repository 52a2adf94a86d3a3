"""Starts the fork server's process, first of all that a run does.

Owns: `ForkServerProcess`, which imports next to nothing: a fork server imports for as long as its
supervisor does, so it is started before that begins. Talking to it is fork_server.py's.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
from collections.abc import Collection

from lifecycle.errors import BringUpError
from lifecycle.run_directory import RUN_VARIABLE, new_run_id

PRELOAD = "preload"
"""Begins a message that names interface types, one a line; requests to fork are JSON."""

CLOSE_S = 1.0
"""A fork server whose children have ended ends within milliseconds of its socket."""

_MAIN = "lifecycle.supervisor.processes.fork_server_main"

_OF_SERVICE_MANAGER = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
"""The supervisor's own, run/service_manager.py: a node that has them could report in its place."""


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
                self.socket.send("\n".join((PRELOAD, *types)).encode())

    def close(self) -> None:
        """End it: it ends once its socket is closed and no child is left. Again is harmless."""
        self.socket.close()
        try:
            self.popen.wait(CLOSE_S)
        except subprocess.TimeoutExpired:
            self.popen.kill()
            self.popen.wait()
