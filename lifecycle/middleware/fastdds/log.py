"""The log of Fast DDS, which it writes to standard output from a thread of its own.

Owns: keeping one message that we cause from it.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import sys
from collections.abc import Iterator

from lifecycle.middleware.fastdds.settings import fast_dds_function

_LOG = "_ZN8eprosima7fastdds3dds3Log"
_STDOUT = 1


@contextlib.contextmanager
def without_message(message: str) -> Iterator[None]:
    """Keep lines with `message` from standard output, inside the block.

    What is written there meanwhile, by whatever thread, is written when the block is over. The
    thread of the log is ended then; the next message starts it again. Without Fast DDS 2.14, or a
    file descriptor to spare, nothing is kept.

    Args:
        message: a part of one line, as Fast DDS writes it.
    """
    flush = fast_dds_function(f"{_LOG}5FlushEv", None)
    end_thread = fast_dds_function(f"{_LOG}10KillThreadEv", None)
    with contextlib.ExitStack() as stack:
        if flush is None or end_thread is None:
            yield
            return
        try:
            sys.stdout.flush()
            kept = os.dup(_STDOUT)
            stack.callback(os.close, kept)
            written = stack.enter_context(os.fdopen(os.memfd_create("log"), "r+b"))
        except (OSError, AttributeError, ValueError):
            yield
            return
        # Threads that write to a memfd at once would write over each other's lines.
        fcntl.fcntl(written, fcntl.F_SETFL, fcntl.fcntl(written, fcntl.F_GETFL) | os.O_APPEND)
        os.dup2(written.fileno(), _STDOUT)
        try:
            yield
        finally:
            flush()
            end_thread()
            with contextlib.suppress(OSError, AttributeError, ValueError):
                sys.stdout.flush()
            os.dup2(kept, _STDOUT)
            written.seek(0)
            others = (line for line in written if message.encode() not in line)
            _write(b"".join(others))


def _write(data: bytes) -> None:
    """Write all of it; a reader that has gone is none that misses it."""
    with contextlib.suppress(OSError):
        while data:
            data = data[os.write(_STDOUT, data) :]
