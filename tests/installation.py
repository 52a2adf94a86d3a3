"""Which installation is tried: `LIFECYCLE=path/to/lifecycle`, or the one beside pytest.

Owns: `LIFECYCLE`, `PYTHON` and `modules`. Tests that use them know the command and nothing of the
package's inside, so that any installation can be asked.
"""

from __future__ import annotations

import atexit
import functools
import os
import shutil
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]


def _found() -> Path:
    given = os.environ.get("LIFECYCLE", "")
    if not given:
        return Path(sys.executable).with_name("lifecycle")
    return Path(shutil.which(given) or given).absolute()


LIFECYCLE = _found()
"""The command that is tried."""

PYTHON = LIFECYCLE.with_name("python")
"""Runs the programs of its systems, and the strangers beside them."""


@functools.cache
def modules() -> Path:
    """Return a directory to run in, from which tests, examples and benchmarks can be imported.

    Not the checkout itself: its package would come before the one that is tried.
    """
    directory = Path(tempfile.mkdtemp(prefix="lifecycle-tests-"))
    atexit.register(shutil.rmtree, directory, ignore_errors=True)
    for name in ("tests", "examples", "manifests", "benchmarks"):
        (directory / name).symlink_to(ROOT / name)
    return directory
