"""`lifecycle flows --export`: verified flows as the file of another system.

Owns: from options to what an export needs, and its refusals. The texts are `programming.rules`'s.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import click

from lifecycle.cli.flows_program import chosen, treatment_of
from lifecycle.errors import UsageError
from lifecycle.printable import lines

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lifecycle.plan.model import Plan
    from lifecycle.programming.apply import TargetOptions, Treatment
    from lifecycle.programming.rules import ExportSettings
    from lifecycle.verify.verdict import FlowReport

NAMES = ("nft", "nft-json", "tc", "nef", "camara", "fastdds-pro", "zenoh", "csv")

_SETTINGS = {
    "tc": "give --device eth0",
    "nef": "give --config FILE",
    "camara": "give --config FILE",
}
"""What exports that need more than flows get it from."""


class Export:
    """One export, with its options checked before anything is looked at.

    Args:
        name: of NAMES.
        mapping, flow_labels: see flows_program.treatment_options.
        given: see flows_program.network_options.

    Raises:
        UsageError: the options do not fit.
    """

    def __init__(self, name: str, *, mapping: str, flow_labels: bool, **given: Any) -> None:
        self._name = name
        # Such an export takes what programming that network takes; it says itself if it needs any.
        some = any(value for option, value in given.items() if option != "match")
        options = chosen((name,) if some and name in _SETTINGS else (), option="--export", **given)
        self._settings = _settings(options)
        self._treatment: Treatment = treatment_of(mapping=mapping, flow_labels=flow_labels)

    def write(self, plan: Plan, flows: Sequence[FlowReport]) -> None:
        """Print the text; flows that are not in it, and why, go to stderr.

        Raises:
            UsageError: it cannot be exported so.
        """
        from lifecycle.programming.apply import open_programmer
        from lifecycle.programming.rules import EXPORTS, ExportInput

        programmer = open_programmer(plan, (), environment=os.environ, treatment=self._treatment)
        given = ExportInput(
            flows=tuple(flows),
            plan=plan,
            rules=programmer.rules(flows),
            settings=self._settings,
        )
        try:
            text = EXPORTS[self._name](given)
        except ValueError as error:
            raise UsageError(str(error), hint=_SETTINGS.get(self._name, "")) from error
        click.echo(text, nl=not text.endswith("\n"))
        if self._name != "csv":
            for each in given.rules.left_out:
                click.echo(lines(f"left out: {each}"), err=True)


def _settings(options: Sequence[TargetOptions]) -> ExportSettings:
    from lifecycle.programming.apply.settings import load_settings
    from lifecycle.programming.rules import ExportSettings

    for each in options:
        if each.kind == "tc":
            return ExportSettings(tc=each.tc())
        settings = load_settings(each.settings)
        return ExportSettings(
            nef=None if settings.nef is None else settings.nef.asked(),
            camara=None if settings.camara is None else settings.camara.asked(),
        )
    return ExportSettings()
