"""What dead runs left in networks.

Owns: finding the ledgers of supervisors that are gone and removing what they list. What somebody
applied by hand stays: `lifecycle flows remove` or `lifecycle down` ends it.
"""

from __future__ import annotations

import dataclasses
import math
import time
from pathlib import Path

from lifecycle.errors import LifecycleError
from lifecycle.supervisor.programming.changes import Changes
from lifecycle.supervisor.programming.ledger import Ledger, has_ledger, owner_is_dead
from lifecycle.supervisor.programming.programmer import remove_all
from lifecycle.supervisor.programming.targets import Targets
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


def sweep_orphans(root: Path, *, own: str = "", within_s: float | None = None) -> Swept:
    """Remove what the dead runs of this user left in networks.

    Args:
        root: directory of all run directories, see rundir.runtime_root.
        own: name of the caller's own run, whose directory it holds itself.
        within_s: for all that servers are asked; None for the patience with each request.
    """
    until_s = math.inf if within_s is None else time.monotonic() + within_s
    removed: list[Changes] = []
    errors: list[LifecycleError] = []
    for directory in sorted(root.iterdir()) if root.is_dir() else ():
        if not has_ledger(directory) or (directory.name != own and is_held(directory)):
            continue
        try:
            removed += _sweep(directory, until_s - time.monotonic())
        except LifecycleError as error:
            errors.append(error)
    return Swept(removed=tuple(removed), errors=tuple(errors))


def remove_run(directory: Path, *, within_s: float | None = None) -> tuple[Changes, ...]:
    """Remove everything that a run has in networks, also what somebody applied by hand.

    For `lifecycle down`.

    Args:
        directory: of the run.
        within_s: for all that servers are asked; None for the patience with each request.

    Raises:
        ProgrammingError: something could not be removed; it stays listed.
    """
    if not has_ledger(directory):
        return ()
    return Removal(directory).close(within_s=within_s)


class Removal:
    """Removes everything that a run has in networks, from one thread and cancelled from another.

    Args:
        directory: of the run.
    """

    def __init__(self, directory: Path) -> None:
        self._ledger = Ledger(directory, _system(directory))
        self._targets = Targets(self._ledger)

    def close(self, *, within_s: float | None) -> tuple[Changes, ...]:
        """Remove it.

        Args:
            within_s: for all that servers are asked; None for the patience with each request.

        Raises:
            ProgrammingError: something could not be removed; it stays listed.
        """
        try:
            return remove_all(self._ledger, self._targets, within_s=within_s)
        finally:
            self._targets.close()

    def cancel(self) -> None:
        """Have what servers are asked fail at once."""
        self._targets.deadline.cancel()


def _sweep(directory: Path, within_s: float) -> tuple[Changes, ...]:
    file = Ledger(directory, _system(directory)).read()
    return remove_run(directory, within_s=within_s) if owner_is_dead(file) else ()


def _system(directory: Path) -> str:
    """The system's name as the ledger has it: a directory's name is made safe."""
    return Ledger(directory, "").read().system or directory.name.partition("@")[0]
