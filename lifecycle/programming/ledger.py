"""The ledger: what this package made in networks, written down before and after it is made.

The file `programmed.json` in a run directory outlives the process, so that a removal deletes only
what is ours, and the next run finds what a dead one left. It never has a credential.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import os
import time
from collections.abc import AsyncIterator
from pathlib import Path

import msgspec

from lifecycle.codec import from_json, to_json
from lifecycle.programming.target import ProgrammingError
from lifecycle.run_directory import (
    LEDGER_LOCK_NAME,
    LEDGER_NAME,
    ChildRecord,
    boot_id,
    is_process,
    private_directory,
    start_ticks,
)

_LOCK_S = 30.0
"""How long another process may keep the ledger: it talks to servers meanwhile."""

_LOCK_CHECK_S = 0.05
"""A lock cannot be waited for with a deadline."""


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """One thing of ours in a network, for one flow.

    Attributes:
        key: of its FlowRule.
        id: what a server calls it, a subscription or a session; empty while it was asked for and
            is not known to be made.
        what: for people.
        expires_s: on the clock of `server.steady_s`; None if it does not expire.
        body: what was written or asked for, of servers as JSON: it finds again what has no id yet.
    """

    key: str
    what: str
    id: str = ""
    expires_s: float | None = None
    body: str = ""


class TargetRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Everything of ours in one network.

    Attributes:
        target: "nft", "tc", "nef" or "camara".
        scope: which one of that kind: a table, a device, a URL.
        settings: path of the settings file that says how to get there; empty if none is needed.
        entries: nothing of ours is there without any.
        beside: what was made beside the table of a host; empty while it is written.
    """

    target: str
    scope: str
    settings: str = ""
    entries: tuple[Entry, ...] = ()
    beside: str = ""

    @property
    def network(self) -> tuple[str, str]:
        """Which network it is of."""
        return self.target, self.scope


class LedgerFile(msgspec.Struct, frozen=True, kw_only=True):
    """The file.

    Attributes:
        owner: the supervisor whose end ends it all; None if applied manually, so that it
            stays until it is removed manually or the system is brought down.
        boot_id: of the kernel that the owner ran on.
    """

    version: int = 1
    system: str = ""
    owner: ChildRecord | None = None
    boot_id: str = ""
    targets: tuple[TargetRecord, ...] = ()


class Ledger:
    """One system's ledger.

    Args:
        owned: this process is the supervisor whose end is to end what it makes.
    """

    def __init__(self, directory: Path, system: str, *, owned: bool = False) -> None:
        self._directory = directory
        self._path = directory / LEDGER_NAME
        self.system = system
        self._owned = owned

    @contextlib.asynccontextmanager
    async def locked(self) -> AsyncIterator[None]:
        """Keep other processes out, such as `flows apply` beside `up`; does not nest.

        Raises:
            ProgrammingError: another process keeps it for too long.
            UsageError: others can write where it is kept.
        """
        # What others can write would make us delete what is not ours.
        for each in (self._directory.parent, self._directory):
            private_directory(each)
        with (self._directory / LEDGER_LOCK_NAME).open("w") as lock:
            until_s = time.monotonic() + _LOCK_S
            while True:
                with contextlib.suppress(BlockingIOError):
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                if time.monotonic() > until_s:
                    raise ProgrammingError(
                        f"cannot program the flows of {self.system!r}: another process has been "
                        f"doing so for {_LOCK_S:g} s",
                        hint="wait for it, or end it",
                    )
                await asyncio.sleep(_LOCK_CHECK_S)
            yield

    def read(self) -> LedgerFile:
        """Return what is written.

        Raises:
            ProgrammingError: it cannot be read: what it lists cannot be removed then.
        """
        try:
            data = self._path.read_bytes()
        except FileNotFoundError:
            return LedgerFile(system=self.system)
        try:
            return from_json(data, LedgerFile)
        except ValueError as error:
            raise ProgrammingError(
                f"cannot read ledger {str(self._path)!r}: {error}",
                hint="look at what it lists, remove that by hand, then delete the file",
            ) from error

    def find(self, record: TargetRecord) -> TargetRecord | None:
        """Return what is written of the network of a record; None if nothing is."""
        found = (each for each in self.read().targets if each.network == record.network)
        return next(found, None)

    def put(self, record: TargetRecord) -> None:
        """Write down what is ours in one network, in place of what was written of it.

        Raises:
            ProgrammingError: it cannot be read or written.
        """
        before = self.read()
        targets = [each for each in before.targets if each.network != record.network]
        if record.entries:
            targets.append(record)
        if not targets:
            self._path.unlink(missing_ok=True)
            return
        # What is applied manually after a supervisor has died is not the dead one's.
        owner = None if owner_is_dead(before) else before.owner
        if self._owned:
            pid = os.getpid()
            owner = ChildRecord(name="supervisor", pid=pid, start_ticks=start_ticks(pid) or 0)
        part = self._path.with_name(f".{LEDGER_NAME}")
        text = to_json(
            LedgerFile(system=self.system, owner=owner, boot_id=boot_id(), targets=tuple(targets))
        )
        try:
            with part.open("wb") as file:
                file.write(text)
                file.flush()
                # What it lists costs money at some operators: it must survive a power cut.
                os.fsync(file.fileno())
            part.replace(self._path)
        except OSError as error:
            raise ProgrammingError(
                f"cannot write ledger {str(self._path)!r}: {error.strerror}",
                hint="make room there: nothing is programmed that is not written down first",
            ) from error


def has_ledger(directory: Path) -> bool:
    """Whether anything of ours may be left of the run in `directory`."""
    return (directory / LEDGER_NAME).is_file()


def owner_is_dead(file: LedgerFile) -> bool:
    """Whether the supervisor that made all this is gone; False if applied manually."""
    if file.owner is None:
        return False
    return file.boot_id != boot_id() or not is_process(file.owner.pid, file.owner.start_ticks)
