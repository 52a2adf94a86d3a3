"""Every export of flows by the name that the command line gives it.

Owns: the names, and what an export needs beside the flows. Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import TypeVar

from lifecycle.network.five_qi import DscpMapping
from lifecycle.plan.model import Plan
from lifecycle.programming.rules.camara import CamaraSettings, render_camara
from lifecycle.programming.rules.fastdds_pro import render_fastdds_pro
from lifecycle.programming.rules.flows_csv import flows_to_csv
from lifecycle.programming.rules.nef import NefSettings, render_nef
from lifecycle.programming.rules.nftables import render_nft, render_nft_json
from lifecycle.programming.rules.rules import RuleSet, SourceAddress, flow_rules, rules_digest
from lifecycle.programming.rules.tc import TcSettings, render_tc
from lifecycle.programming.rules.zenoh import render_zenoh
from lifecycle.verify.verdict import FlowReport

T = TypeVar("T")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ExportSettings:
    """What some exports need and flows do not say; None where it was not given."""

    tc: TcSettings | None = None
    nef: NefSettings | None = None
    camara: CamaraSettings | None = None


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ExportInput:
    """What is exported.

    Attributes:
        flows: of a verdict.
        plan: that they were judged against.
        rules: made from both.
    """

    flows: tuple[FlowReport, ...]
    plan: Plan
    rules: RuleSet
    settings: ExportSettings = ExportSettings()

    @property
    def digest(self) -> str:
        """Sixteen hexadecimal digits that are equal for equal rules."""
        return rules_digest(self.rules.rules)


def export_input(
    flows: Iterable[FlowReport],
    plan: Plan,
    *,
    settings: ExportSettings = ExportSettings(),
    source_address: SourceAddress | None = None,
    mapping: DscpMapping | None = None,
    label_flows: bool = False,
) -> ExportInput:
    """Return what every export takes.

    Args:
        flows: of a verdict.
        plan: that they were judged against.
        settings: for the exports that need some.
        source_address: see `flow_rules`.
        mapping: see `flow_rules`.
        label_flows: see `flow_rules`.
    """
    every = tuple(flows)
    return ExportInput(
        flows=every,
        plan=plan,
        rules=flow_rules(
            every, plan, source_address=source_address, mapping=mapping, label_flows=label_flows
        ),
        settings=settings,
    )


def _nft(given: ExportInput) -> str:
    return render_nft(
        given.rules.rules,
        system=given.plan.system,
        digest=given.digest,
        left_out=given.rules.left_out,
    )


def _nft_json(given: ExportInput) -> str:
    return render_nft_json(given.rules.rules, system=given.plan.system, digest=given.digest) + "\n"


def _tc(given: ExportInput) -> str:
    return render_tc(
        given.rules.rules,
        _needed(given.settings.tc, "tc", "the network device"),
        system=given.plan.system,
        digest=given.digest,
        left_out=given.rules.left_out,
    )


def _nef(given: ExportInput) -> str:
    settings = _needed(given.settings.nef, "nef", "devices and a notification destination")
    return render_nef(given.rules.rules, settings, left_out=given.rules.left_out) + "\n"


def _camara(given: ExportInput) -> str:
    settings = _needed(given.settings.camara, "camara", "devices and QoS profiles")
    return render_camara(given.rules.rules, settings, left_out=given.rules.left_out) + "\n"


def _fastdds_pro(given: ExportInput) -> str:
    return render_fastdds_pro(
        given.rules.rules, system=given.plan.system, left_out=given.rules.left_out
    )


def _zenoh(given: ExportInput) -> str:
    return render_zenoh(given.rules.rules, left_out=given.rules.left_out)


def _csv(given: ExportInput) -> str:
    return flows_to_csv(given.flows)


def _needed(settings: T | None, name: str, what: str) -> T:
    if settings is None:
        raise ValueError(f"cannot export {name}: nothing says {what}; give {name} its settings")
    return settings


EXPORTS: Mapping[str, Callable[[ExportInput], str]] = MappingProxyType(
    {
        "nft": _nft,
        "nft-json": _nft_json,
        "tc": _tc,
        "nef": _nef,
        "camara": _camara,
        "fastdds-pro": _fastdds_pro,
        "zenoh": _zenoh,
        "csv": _csv,
    }
)
"""Exports by name; each returns the whole text, and raises ValueError for settings it lacks."""
