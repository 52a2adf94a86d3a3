"""What processes leave of Fast DDS's files in /dev/shm, seen from outside.

A port or a segment is a group of files: `fastrtps_port7411`, its locks `fastrtps_port7411_el` and
`_sl`, and `sem.fastrtps_port7411_mutex`. It is left behind where no living process maps or opens
any of them.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Collection, Iterable
from pathlib import Path

_FOLDER = "/dev/shm/"
_NAME = re.compile(r"(?:sem\.)?fastrtps_(\w+?)(?:_el|_sl|_mutex)?")
_LOCK = re.compile(r"/dev/shm/(fastrtps_\w+_[es]l)")
_MAPPED = re.compile(r"/dev/shm/(\S*fastrtps_\S+)")


def used_by(pids: Iterable[int]) -> set[str]:
    """Return the names of the files that these processes map or have open."""
    names: set[str] = set()
    for pid in pids:
        with contextlib.suppress(OSError):
            names.update(_MAPPED.findall(Path(f"/proc/{pid}/maps").read_text(errors="replace")))
            for each in Path(f"/proc/{pid}/fd").iterdir():
                with contextlib.suppress(OSError):
                    names.update(_MAPPED.findall(str(each.readlink())))
    return names


def owned_by(pids: Iterable[int]) -> set[str]:
    """Return the files of the groups of which these processes have the lock open."""
    groups: set[str] = set()
    for pid in pids:
        with contextlib.suppress(OSError):
            for each in Path(f"/proc/{pid}/fd").iterdir():
                with contextlib.suppress(OSError):
                    if found := _LOCK.fullmatch(str(each.readlink())):
                        groups.add(_group(found[1]))
    there = os.scandir(_FOLDER) if groups else ()
    return {each.name for each in there if _group(each.name) in groups}


def left_behind(only: Collection[str] | None = None) -> set[str]:
    """Return the files that nobody uses; those of the groups of `only`, where that is given."""
    wanted = None if only is None else {_group(each) for each in only}
    there = {
        each.name
        for each in os.scandir(_FOLDER)
        if _NAME.fullmatch(each.name) and (wanted is None or _group(each.name) in wanted)
    }
    if not there:
        return set()
    every = (int(each.name) for each in Path("/proc").glob("[0-9]*"))
    used = {_group(each) for each in used_by(every)}
    return {each for each in there if _group(each) not in used}


def _group(name: str) -> str:
    found = _NAME.fullmatch(name)
    return found[1] if found else name
