"""What dead runs left in networks.

Owns: finding the ledgers of supervisors that are gone and removing what they list. What somebody
applied by hand stays: `lifecycle flows remove` or `lifecycle down` ends it.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from lifecycle.errors import LifecycleError
from lifecycle.supervisor.programming.changes import Changes
from lifecycle.supervisor.programming.ledger import Ledger, has_ledger, owner_is_dead
from lifecycle.supervisor.programming.programmer import remove_all
from lifecycle.supervisor.rundir import is_held


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Swept:
    """What became of the leftovers.

    Attributes:
        removed: per target.
        errors: what could not be removed, and why; it stays listed.
    """

    removed: tuple[Changes, ...] = ()
    errors: tuple[LifecycleError, ...] = ()


def sweep_orphans(root: Path, *, own: str = "") -> Swept:
    """Remove what the dead runs of this user left in networks.

    Args:
        root: directory of all run directories, see rundir.runtime_root.
        own: name of the caller's own run, whose directory it holds itself.
    """
    removed: list[Changes] = []
    errors: list[LifecycleError] = []
    for directory in sorted(root.iterdir()) if root.is_dir() else ():
        if not has_ledger(directory) or (directory.name != own and is_held(directory)):
            continue
        try:
            removed += _sweep(directory)
        except LifecycleError as error:
            errors.append(error)
    return Swept(removed=tuple(removed), errors=tuple(errors))


def remove_run(directory: Path) -> tuple[Changes, ...]:
    """Remove everything that a run has in networks, also what somebody applied by hand.

    For `lifecycle down`.

    Raises:
        ProgrammingError: something could not be removed; it stays listed.
    """
    if not has_ledger(directory):
        return ()
    return remove_all(Ledger(directory, _system(directory)))


def _sweep(directory: Path) -> tuple[Changes, ...]:
    file = Ledger(directory, _system(directory)).read()
    return remove_run(directory) if owner_is_dead(file) else ()


def _system(directory: Path) -> str:
    """The system's name as the ledger has it: a directory's name is made safe."""
    return Ledger(directory, "").read().system or directory.name.partition("@")[0]
