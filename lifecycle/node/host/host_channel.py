"""A host's end of the control channel (control.py).

Owns: reading and writing its lines, and the descriptors that come beside the first byte.
"""

from __future__ import annotations

import importlib
import logging
import os
import socket
import sys
import threading
import traceback
from pathlib import Path
from types import TracebackType
from typing import NoReturn

from lifecycle import codec
from lifecycle.errors import LifecycleError
from lifecycle.node.host.control import SIGN_DESCRIPTORS, Event

_OURS = f"{Path(__file__).parents[1]}{os.sep}"
"""Where the host's own modules are."""


class HostChannel:
    """JSON lines both ways; written from two threads, read from one.

    Attributes:
        descriptors: of the busy sign, beside the first byte; none if nobody watches.
    """

    def __init__(self, control: socket.socket) -> None:
        control.setblocking(True)
        self._control = control
        try:
            self._first, found, _, _ = socket.recv_fds(control, 1, SIGN_DESCRIPTORS)
        except ConnectionError:  # as at end of file
            self._first, found = b"", []
        self.descriptors = tuple(found)
        for descriptor in found:
            os.set_inheritable(descriptor, False)
        self._reader = control.makefile("rb")
        self._lock = threading.Lock()

    def read(self) -> bytes | None:
        """Return the next line, or None at end of file."""
        try:
            first, self._first = self._first, b""
            return first + self._reader.readline() or None
        except OSError:  # a supervisor that was killed resets the connection
            return None

    def write(self, event: Event) -> None:
        """Send one event; a supervisor that has gone is noticed by the reader, not here."""
        with self._lock:
            try:
                self._control.sendall(codec.to_json(event) + b"\n")
            except OSError as error:
                logging.getLogger(__name__).debug("cannot tell the supervisor: %s", error)


def report_failure(channel: HostChannel, node: str, error: Exception) -> None:
    """Notify the supervisor why a node cannot be hosted, and leave the user's trace in the log."""
    trace = _of_user(error.__traceback__)
    if trace is not None or not isinstance(error, LifecycleError):
        traceback.print_exception(type(error), error, trace)
        sys.stderr.flush()
    reason = str(error) if isinstance(error, LifecycleError) else f"{type(error).__name__}: {error}"
    channel.write(Event(kind="failed", node=node, ok=False, error=reason))


def give_up(channel: HostChannel, node: str, error: Exception) -> NoReturn:
    """Report a failure, and end the process."""
    report_failure(channel, node, error)
    from lifecycle.middleware.process.teardown import leave_and_exit

    leave_and_exit(1)


def _of_user(trace: TracebackType | None) -> TracebackType | None:
    """Return a traceback from the first frame on that is the user's; None if all are ours.

    Ours, and those of the import system, are the same for every node that cannot be imported.
    """
    while trace is not None:
        file = trace.tb_frame.f_code.co_filename
        if not file.startswith((_OURS, "<frozen importlib")) and file != importlib.__file__:
            return trace
        trace = trace.tb_next
    return None
