"""The id of this machine, which distinguishes it from others.

Owns: where that is found.
"""

from __future__ import annotations

import functools
import os
from pathlib import Path

MACHINE_ID_VARIABLE = "LIFECYCLE_MACHINE_ID"
"""Names the machine where the files cannot: containers and network namespaces that are hosts of
their own share /etc/machine-id or have none, and always share the kernel's boot id."""


@functools.lru_cache(maxsize=1)
def machine_id() -> str:
    """Return what distinguishes this machine from others.

    It is $LIFECYCLE_MACHINE_ID where that is set, else /etc/machine-id (machine-id(5)), else the
    kernel's boot id. Nodes of one id are taken to share memory and loopback.
    """
    if given := os.environ.get(MACHINE_ID_VARIABLE):
        return given
    for path in ("/etc/machine-id", "/proc/sys/kernel/random/boot_id"):
        try:
            found = Path(path).read_text(encoding="ascii").strip()
        except OSError:
            continue
        if found:
            return found
    return ""
