"""`lifecycle flows`: show every network flow and how unique it is, or export them (`--export`).

Owns: flows as a table, JSON or CSV: the columns of the table, and how unknown values read; and for
`--export` the step from options to what an export needs, and its refusals. The exported texts are
from `programming.rules`; `apply`, `diff` and `remove`, which program networks, are in
flows_program.py.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import click

from lifecycle.cli.common import format_option, load_manifest, target_plan, timeout_option
from lifecycle.cli.standard_streams import echo_while_read
from lifecycle.cli.verbs.flows_program import (
    chosen,
    network_options,
    treatment_of,
    treatment_options,
    with_subcommands,
)
from lifecycle.codec import to_json
from lifecycle.errors import UsageError
from lifecycle.manifest import UniqueHow
from lifecycle.network import NetworkFlowEndpoint, describe
from lifecycle.printable import json_text, lines, one_line
from lifecycle.programming import flows_to_csv
from lifecycle.verify import FlowReport

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lifecycle.plan import Plan
    from lifecycle.programming import ExportSettings, TargetOptions, Treatment
    from lifecycle.verify import FlowReport


_HEADS = (
    "topic",
    "publisher",
    "subscription",
    "source",
    "destination",
    "protocol",
    "flow_label",
    "dscp",
    "5qi",
    "unique",
    "required",
    "demanded",
    "transport",
    "verdict",
)
_UNIQUE = {UniqueHow.NOT: "no", UniqueHow.WEAKLY: "weakly", UniqueHow.STRONGLY: "strongly"}


def render_flows(flows: Sequence[FlowReport], format_: str) -> str:
    """Return `flows` as "text", "json" (an array) or "csv" (with a head line).

    In text and CSV a pair has one line for each network flow that its ends form, in JSON they are
    its `tuples`. `transport` is what carries it, not what could.
    """
    if format_ == "json":
        return json_text(to_json(tuple(flows)).decode())
    if format_ == "csv":
        return lines(flows_to_csv(flows).replace("\r\n", "\n").rstrip("\n"))
    if not flows:
        return "no flow"
    rows = [_HEADS, *(tuple(map(one_line, row)) for flow in flows for row in _rows(flow))]
    widths = [max(len(row[index]) for row in rows) for index in range(len(_HEADS))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


def _rows(flow: FlowReport) -> Iterator[tuple[str, ...]]:
    pair = (flow.topic, flow.publisher, flow.subscription)
    demands_and_verdict = (
        _dscps(flow),
        _five_qi(flow),
        "unknown" if flow.unique is None else _UNIQUE[flow.unique],
        " / ".join(each.value for each in flow.requirement),
        flow.demanded.value,
        flow.effective_transport,
        flow.outcome.value,
    )
    for each in _tuples(flow):
        yield (*pair, *each, *demands_and_verdict)


def _tuples(flow: FlowReport) -> Sequence[tuple[str, ...]]:
    """Source, destination, protocol and flow label of each network flow of a pair."""
    found = [
        (each.source, each.destination, each.transport_protocol.value, each.label or "–")
        for each in flow.tuples
    ]
    return found or [(_ends(flow.source), _ends(flow.destination), "–", "–")]


def _dscps(flow: FlowReport) -> str:
    """What the data carry, and where that is known what the subscription acknowledges with."""
    data = "–" if flow.dscp is None else describe(flow.dscp)
    return data if flow.reader_dscp is None else f"{data}; back {describe(flow.reader_dscp)}"


def _five_qi(flow: FlowReport) -> str:
    if flow.five_qi is None:
        return "–"
    return f"{flow.five_qi} (auto)" if flow.five_qi_reason else str(flow.five_qi)


def _ends(nfes: Sequence[NetworkFlowEndpoint]) -> str:
    """Write the network flow endpoints of an end that forms no IP flow with the other."""
    return " ".join(dict.fromkeys(each.describe() for each in nfes)) or "unknown"


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
        from lifecycle.programming import EXPORTS, ExportInput, open_programmer

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
    from lifecycle.programming import ExportSettings, load_settings

    for each in options:
        if each.kind == "tc":
            return ExportSettings(tc=each.tc())
        settings = load_settings(each.settings)
        return ExportSettings(
            nef=None if settings.nef is None else settings.nef.asked(),
            camara=None if settings.camara is None else settings.camara.asked(),
        )
    return ExportSettings()


_NOBODY_S = 1.5
"""Some node of what runs is seen within so long; a system without any is waited for if asked."""


@click.command("flows")
@click.argument("target", metavar="TARGET")
@click.argument("assignments", nargs=-1, metavar="[NAME:=VALUE]...")
@format_option("text", "json", "csv")
@click.option("--watch", is_flag=True, help="Show them again whenever they change; Ctrl-C ends.")
@timeout_option(5.0, "How long flows that are not complete may still become so.")
@click.option(
    "--export",
    type=click.Choice(NAMES),
    help="Print the verified flows as rules, settings or request bodies of another system instead.",
)
@network_options
@treatment_options
def _show(
    *,
    target: str,
    assignments: tuple[str, ...],
    format_: str,
    watch: bool,
    timeout: float,
    export: str | None,
    **rest: Any,
) -> int:
    """Show every publisher → subscription pair of a running system.

    TARGET is a manifest, or the name of a system that a supervisor runs on this host.

    One line per network flow: its 5-tuple, on IPv6 its flow label, DSCP and TOS byte, how unique it
    is, what was required and the verdict. Exits as `lifecycle verify` does.
    """
    from lifecycle.cli.verbs.verify import exit_code
    from lifecycle.supervisor import follow_running, judge_running, supervisor_of
    from lifecycle.verify import Verdict

    exporter = None
    if export is not None:
        if watch:
            raise UsageError("cannot use --export with --watch; export once")
        exporter = Export(export, **rest)
    elif any(value for name, value in rest.items() if name != "match"):
        raise UsageError(
            "cannot say how to treat flows that are only shown",
            hint="give --export, or use lifecycle flows apply",
        )
    plan = _plan(target, assignments)

    def show(verdict: Verdict) -> None:
        click.echo(render_flows(verdict.flows, format_))

    if watch:
        follow_running(plan, lambda seen: echo_while_read(render_flows(seen.flows, format_)))
    asked = click.get_current_context().get_parameter_source("timeout")
    waits = asked is not click.core.ParameterSource.DEFAULT or supervisor_of(os.environ, plan, "")
    nobody_s = None if waits else _NOBODY_S
    seen = judge_running(plan, timeout_s=timeout, strict=False, nobody_s=nobody_s)
    if seen.where:
        click.echo(lines(seen.where), err=True)
    if exporter is not None:
        exporter.write(seen.plan, seen.verdict.flows)
    else:
        show(seen.verdict)
    return exit_code(seen.verdict, strict=False)


def _plan(target: str, assignments: tuple[str, ...]) -> Plan:
    """Return the plan of a manifest, or that of a running system of this name."""
    if os.path.isfile(target):  # noqa: PTH113 - Path.is_file() raises for a name too long
        from lifecycle.plan import build_plan

        return build_plan(load_manifest(target, assignments).manifest)
    from lifecycle.supervisor import running_plan

    path, _ = target_plan(os.environ, target, assignments, "")
    return running_plan(path)


command = with_subcommands(_show)
