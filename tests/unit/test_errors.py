"""What only means that a resource is used up, and what does not."""

from __future__ import annotations

import errno
import os

import pytest

from lifecycle.errors import ExitCode, exhausted


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.EMFILE, os.strerror(errno.EMFILE), "/proc/self/fd"),
        OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
        MemoryError(),
        RuntimeError("can't start new thread"),
        ImportError("librcl.so: failed to map segment from shared object"),
        RuntimeError("eventfd_select_interrupter: Too many open files"),
    ],
)
def test_what_is_used_up_is_named_and_no_bug(error: Exception) -> None:
    found = exhausted(error)
    assert found is not None
    assert (str(error) or "MemoryError") in str(found)
    assert found.exit_code is ExitCode.BRING_UP_FAILED


@pytest.mark.parametrize("error", [RuntimeError("no"), KeyError("x"), OSError(errno.ENOENT, "x")])
def test_other_errors_are_none_of_a_resource(error: Exception) -> None:
    assert exhausted(error) is None
