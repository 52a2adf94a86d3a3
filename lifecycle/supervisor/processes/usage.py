"""What a process uses: processor time, memory, threads; and what all of its cgroup does.

Owns: reading that from proc(5), and from the files of cgroup-v2.rst. Must not import rclpy.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from lifecycle import dataclasses
from lifecycle.codec import Count


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class CgroupUse:
    """What a process and all that it has started use together, as their cgroup counts it.

    Attributes:
        cpu_s: user and system time, seconds (cpu.stat), of those that have ended as well.
        memory_bytes: memory.current, with files in memory that they were the first to use; None
            where the kernel's controller `memory` is not delegated to the supervisor.
        tasks: processes and threads (pids.current); None where `pids` is not.
    """

    cpu_s: float
    memory_bytes: Count | None = None
    tasks: Count | None = None


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ResourceUse:
    """What one process uses.

    Attributes:
        cpu_s: user and system time since it began, seconds; of its own threads alone.
        rss_bytes: resident memory, what it shares with others included.
        threads: how many it has.
        cgroup: what is used in its cgroup; None if it has none of its own.
    """

    cpu_s: float
    rss_bytes: Count
    threads: Count
    cgroup: CgroupUse | None = None


def resource_use(pid: int, cgroup: Path | None = None) -> ResourceUse | None:
    """Return what a process uses now; None if it does not live.

    Args:
        pid: of the process.
        cgroup: directory of its own one; None if it has none.
    """
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
        cgroup=None if cgroup is None else _cgroup_use(cgroup),
    )


def _cgroup_use(cgroup: Path) -> CgroupUse | None:
    """Return what is used in a cgroup; None if it is not there any more."""
    try:
        stat = (cgroup / "cpu.stat").read_text(encoding="ascii")
    except OSError:
        return None
    used_us = next((line[11:] for line in stat.splitlines() if line.startswith("usage_usec ")), "0")
    return CgroupUse(
        cpu_s=int(used_us) / 1e6,
        memory_bytes=_number(cgroup / "memory.current"),
        tasks=_number(cgroup / "pids.current"),
    )


def _number(path: Path) -> int | None:
    with contextlib.suppress(OSError):
        return int(path.read_text(encoding="ascii"))
    return None
