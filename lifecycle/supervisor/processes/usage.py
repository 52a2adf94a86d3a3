"""What a process uses: processor time, memory, threads.

Owns: reading that from proc(5). Must not import rclpy.
"""

from __future__ import annotations

import os
from pathlib import Path

from lifecycle import dataclasses
from lifecycle.codec import Count


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ResourceUse:
    """What one process uses.

    Attributes:
        cpu_s: user and system time since it began, seconds; of its own threads alone.
        rss_bytes: resident memory, what it shares with others included.
        threads: how many it has.
    """

    cpu_s: float
    rss_bytes: Count
    threads: Count


def resource_use(pid: int) -> ResourceUse | None:
    """Return what a process uses now; None if it does not live."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    # The command is in parentheses and may hold any character; the state follows it.
    fields = text.rpartition(")")[2].split()
    if fields[0] in "ZX":
        return None
    return ResourceUse(
        cpu_s=(int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"),
        rss_bytes=int(fields[21]) * os.sysconf("SC_PAGE_SIZE"),
        threads=int(fields[17]),
    )
