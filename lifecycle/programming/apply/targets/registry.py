"""Every network that can be programmed, by its command line name, and how one declares itself.

Owns: the names; `TargetOptions`, of which each target has one; `Targets`, what targets are opened
with; and reading which networks a person asked for. A target is a module here whose `TARGET`
declares it, and one name in `TARGETS`; it is imported on first use, so that its name costs nothing.
"""

from __future__ import annotations

import abc
import importlib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from lifecycle import dataclasses
from lifecycle.errors import UsageError

if TYPE_CHECKING:
    from lifecycle.programming.apply.http import Clock, Patience
    from lifecycle.programming.apply.ledger import Ledger, TargetRecord
    from lifecycle.programming.apply.settings import ServerSettings
    from lifecycle.programming.apply.target import Target
    from lifecycle.programming.apply.tool import Tool
    from lifecycle.programming.rules.rules import RuleSet

TARGETS = ("nft", "tc", "nef", "camara")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TargetOption:
    """A command line option that a target takes.

    Attributes:
        flag: `--device`; without the dashes it is the option's name.
        help: one line.
        metavar: of its value; empty where there are choices.
        choices: all values that it may have; empty for any.
        default: its value where it is not given.
        multiple: it may be given several times, and its value is a tuple.
    """

    flag: str
    help: str
    metavar: str = ""
    choices: tuple[str, ...] = ()
    default: str = ""
    multiple: bool = False

    @property
    def name(self) -> str:
        """Key of its value."""
        return self.flag.removeprefix("--")


class TargetOptions(abc.ABC):
    """What a person said of one target, and how it is opened from that.

    Attributes:
        kind: name of the target.
        takes: options beside the flows.
        hint: how to give what it cannot do without; empty if there is nothing such.
        settings_type: of its key in the settings file of servers; None if it is no server.
    """

    kind: ClassVar[str]
    takes: ClassVar[tuple[TargetOption, ...]] = ()
    hint: ClassVar[str] = ""
    settings_type: ClassVar[type[ServerSettings] | None] = None

    @classmethod
    @abc.abstractmethod
    def read(cls, given: Mapping[str, Any]) -> TargetOptions:
        """Read the values of what it takes; what is missing was not given.

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
        tool: runs nft and tc; None for this host.
        patience: with servers.
        clock: for servers.

    Attributes:
        deadline: of everything that the targets ask of servers.
    """

    def __init__(
        self,
        ledger: Ledger,
        *,
        tool: Tool | None = None,
        patience: Patience | None = None,
        clock: Clock | None = None,
    ) -> None:
        from lifecycle.programming.apply.tool import Deadline

        self.ledger = ledger
        self.tool = tool
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


def target_options() -> dict[TargetOption, tuple[str, ...]]:
    """Return every option that a target takes, with the names of all targets that take it."""
    takers: dict[TargetOption, tuple[str, ...]] = {}
    for name in TARGETS:
        for each in target_kind(name).takes:
            takers[each] = (*takers.get(each, ()), name)
    return takers


def read_targets(
    names: Iterable[str], given: Mapping[str, Any], *, option: str = "--target"
) -> tuple[TargetOptions, ...]:
    """Return the targets that a person asked for, with their options.

    Args:
        names: of TARGETS.
        given: values of `target_options` by name; what is missing was not given.
        option: what chose the targets, for messages.

    Raises:
        UsageError: they do not fit together.
    """
    chosen = tuple(dict.fromkeys(names))
    takers = target_options()
    for those in dict.fromkeys(takers.values()):
        of_those = [each for each, names in takers.items() if names == those]
        bound = [each for each in of_those if not each.default]
        if not {*those} & {*chosen} and any(given.get(each.name) for each in bound):
            flags = _either([each.flag for each in bound])
            raise UsageError(f"cannot use {flags} without {option} {_either(those)}")
    return tuple(target_kind(each).read(given) for each in chosen)


def _either(words: Iterable[str]) -> str:
    *most, last = words
    return f"{', '.join(most)} or {last}" if most else last
