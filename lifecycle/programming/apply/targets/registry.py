"""Every network that can be programmed, by its command line name, and how one declares itself.

Owns: the names; `TargetOptions`, of which each target has one; `Targets`, what targets are opened
with; and reading which networks a person asked for. A target is a module here whose `TARGET`
declares it, and one name in `TARGETS`; it is imported on first use, so that its name costs nothing.
"""

from __future__ import annotations

import abc
import importlib
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from lifecycle.errors import UsageError

if TYPE_CHECKING:
    from lifecycle.programming.apply.http import Clock, Patience
    from lifecycle.programming.apply.ledger import Ledger, TargetRecord
    from lifecycle.programming.apply.settings import ServerSettings
    from lifecycle.programming.apply.target import Target
    from lifecycle.programming.rules.rules import RuleSet

TARGETS = ("nft", "tc", "nef", "camara")


class TargetOptions(abc.ABC):
    """What a person said of one target, and how it is opened from that.

    Attributes:
        kind: name of the target.
        hint: how to give what it cannot do without; empty if there is nothing such.
        settings_type: of its key in the settings file of servers; None if it is no server.
    """

    kind: ClassVar[str]
    hint: ClassVar[str] = ""
    settings_type: ClassVar[type[ServerSettings] | None] = None

    @classmethod
    @abc.abstractmethod
    def read(cls, given: Mapping[str, Any]) -> TargetOptions:
        """Read the values of what it takes; what is missing, None or empty was not given.

        Raises:
            UsageError: something is missing, or they do not fit together.
        """

    @classmethod
    @abc.abstractmethod
    def restore(cls, record: TargetRecord, means: Targets) -> Target:
        """Return the target that a ledger's record is of, good enough to remove what it lists.

        The record has to be enough, long after the options are forgotten.

        Raises:
            SettingsError: the settings file is gone, or is of another server now.
        """

    @abc.abstractmethod
    def open(self, means: Targets) -> Target:
        """Return the target.

        Raises:
            UsageError: the options do not fit.
            SettingsError: the settings file cannot be used.
        """

    @abc.abstractmethod
    def export(self, rules: RuleSet, system: str) -> str:
        """Return what the network would be given, as text, and what is left out of it.

        Raises:
            ValueError: the rates of a device do not fit.
        """

    def token_variables(self) -> frozenset[str]:
        """Return the environment variables that hold tokens."""
        return frozenset()


class Targets:
    """What targets are opened with.

    Args:
        ledger: of the system.
        patience: with servers.
        clock: for servers.

    Attributes:
        deadline: of everything that the targets ask of servers.
    """

    def __init__(
        self,
        ledger: Ledger,
        *,
        patience: Patience | None = None,
        clock: Clock | None = None,
    ) -> None:
        from lifecycle.programming.apply.tool import Deadline

        self.ledger = ledger
        self.patience = patience
        self.clock = clock
        self.deadline = Deadline()


def target_kind(name: str) -> type[TargetOptions]:
    """Return what declares a target.

    Raises:
        UsageError: there is no such target.
    """
    if name not in TARGETS:
        raise UsageError(f"cannot program target {name!r}; use {', '.join(TARGETS)}")
    kind: type[TargetOptions] = importlib.import_module(f"{__package__}.{name}").TARGET
    return kind


def settings_types() -> dict[str, type[ServerSettings]]:
    """Return what may be in the settings file of servers, by the names of their targets."""
    types = {name: target_kind(name).settings_type for name in TARGETS}
    return {name: type_ for name, type_ in types.items() if type_ is not None}


def read_targets(
    names: Iterable[str], given: Mapping[str, Any], *, option: str = "--target"
) -> tuple[TargetOptions, ...]:
    """Return the targets that a person asked for, with their options.

    Args:
        names: of TARGETS.
        given: values of options by name; what is missing, None or empty was not given.
        option: what chose the targets, for messages.

    Raises:
        UsageError: they do not fit together.
    """
    chosen = tuple(dict.fromkeys(names))
    for those, flags in _TAKEN.items():
        if not {*those} & {*chosen} and any(given.get(each) for each in flags):
            needs = _either([f"--{each}" for each in flags])
            raise UsageError(f"cannot use {needs} without {option} {_either(those)}")
    return tuple(target_kind(each).read(given) for each in chosen)


_TAKEN = {("tc",): ("device", "rate", "guarantee"), ("nef", "camara"): ("config",)}
"""Targets → options that only they take."""


def _either(words: Sequence[str]) -> str:
    *most, last = words
    return f"{', '.join(most)} or {last}" if most else last
