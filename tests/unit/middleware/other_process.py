"""Sockets that only another process has open."""

from __future__ import annotations

import contextlib
import socket
import subprocess
from collections.abc import Iterator


@contextlib.contextmanager
def of_another_process(*sockets: socket.socket) -> Iterator[None]:
    """Give sockets to another process, which closes them at the end of the block."""
    numbers = [each.fileno() for each in sockets]
    with subprocess.Popen(["cat"], pass_fds=numbers, stdin=subprocess.PIPE) as process:
        for each in sockets:
            each.close()
        try:
            yield
        finally:
            process.communicate()
