"""Standard output for what a verb prints, and for nothing else.

Owns: `keep_stdout`. Fast DDS 2.14 prints errors of TCP connections on standard output, where they
would stand among JSON lines or in a CSV file.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys

_STDOUT, _STDERR = 1, 2


def keep_stdout() -> None:
    """Have only `sys.stdout` write to this process's standard output from now on.

    What writes to the descriptor itself, as C++ does, comes out on standard error; so does what
    child processes print that are given no other.
    """
    # Closed, or no real one: then there is nothing to keep.
    with contextlib.suppress(AttributeError, OSError, ValueError):
        now = sys.stdout
        now.flush()
        ours = os.fdopen(os.dup(now.fileno()), "wb")
        os.dup2(_STDERR, _STDOUT)
        sys.stdout = io.TextIOWrapper(
            ours,
            encoding=now.encoding,
            errors=now.errors,
            line_buffering=bool(now.line_buffering),
            write_through=getattr(now, "write_through", False),
        )
