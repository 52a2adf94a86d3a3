"""`lifecycle ports`: DDS port arithmetic, platform limits, and whether a manifest's system fits.

Owns: the verb and what it prints; the arithmetic is `lifecycle.network`'s.
"""

from __future__ import annotations

import os
from pathlib import Path

import click

from lifecycle import dataclasses
from lifecycle.cli.common import (
    assignments_argument,
    format_option,
    load_manifest,
)
from lifecycle.cli.completion import completing
from lifecycle.codec import to_json
from lifecycle.errors import ExitCode, UsageError
from lifecycle.manifest import Discovery
from lifecycle.network import (
    LOCALHOST_PARTICIPANTS,
    Capacity,
    EphemeralRange,
    ParticipantPorts,
    Platform,
    PortUse,
    count,
    describe_domains,
    ephemeral_range,
    max_participants,
    overflows,
    overlaps,
    participant_ports,
    read_ephemeral_range,
    safe_domains,
    unique_flow_ports,
)
from lifecycle.plan import Plan, build_plan, demand, effective_domain

THIS = "this"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Need:
    """What one host must hold.

    Attributes:
        host: the machine, or machines with one address; else what was asked for.
        participants: how many.
        owners: what each participant of a plan is for; ids are given out by start order.
        unique_subscriptions: how many ask for a port of their own.
        problems: why it does not fit; empty if it does.
    """

    host: str
    participants: int
    owners: tuple[str, ...] = ()
    unique_subscriptions: int = 0
    problems: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PortsReport:
    """All that the verb says; the JSON document has these keys.

    Attributes:
        safe_domains: first and last id of each run.
        localhost_participants: so many of one host all find each other with `range: localhost`.
        unique_subscription_ports: first and last.
        needs: one per host of the manifest, or one for `--participants`.
    """

    domain_id: int
    participant_id: int
    ports: ParticipantPorts
    overlaps: tuple[PortUse, ...]
    platform: str
    ephemeral: EphemeralRange
    safe_domains: tuple[tuple[int, int], ...]
    capacity: Capacity
    localhost_participants: int
    unique_subscription_ports: tuple[int, int]
    needs: tuple[Need, ...]


@click.command("ports")
@click.argument(
    "manifest", metavar="[MANIFEST]", required=False, shell_complete=completing("manifests")
)
@assignments_argument
@click.option("--domain", type=int, help="Domain id, 0-232; else the manifest's or ROS_DOMAIN_ID.")
@click.option("--participant", type=int, default=0, show_default=True, help="Counts from 0.")
@click.option("--participants", type=int, help="Ask whether so many fit on one host.")
@click.option(
    "--platform",
    type=click.Choice([*(each.value for each in Platform), THIS]),
    default=THIS,
    show_default=True,
    help="Whose ephemeral ports to keep clear of; `this` reads this machine's own.",
)
@format_option("text", "json")
def command(
    *,
    manifest: str | None,
    assignments: tuple[str, ...],
    domain: int | None,
    participant: int,
    participants: int | None,
    platform: str,
    format_: str,
) -> int:
    """Show the UDP ports of a DDS participant and how many fit.

    With a MANIFEST, show which participants its plan needs on each machine and whether they fit.

    Exits 3 if the manifest's system does not fit, 4 if --participants do not.
    """
    if manifest is not None and participants is not None:
        raise UsageError("cannot use --participants with a MANIFEST: its plan says how many")
    plan = build_plan(load_manifest(manifest, assignments).manifest) if manifest else None
    ephemeral = _ephemeral(platform)
    if domain is None:
        domain = plan.domain_id if plan else effective_domain(Discovery(), os.environ)
    try:
        report = PortsReport(
            domain_id=domain,
            participant_id=participant,
            ports=participant_ports(domain, participant),
            overlaps=overlaps(domain, participant),
            platform=platform,
            ephemeral=ephemeral,
            safe_domains=tuple((run[0], run[-1]) for run in safe_domains(ephemeral)),
            capacity=max_participants(domain, ephemeral),
            localhost_participants=LOCALHOST_PARTICIPANTS,
            unique_subscription_ports=(unique_flow_ports()[0], unique_flow_ports()[-1]),
            needs=_judged(_needs(plan, participants), domain, ephemeral),
        )
    except ValueError as error:
        raise UsageError(str(error)) from error
    click.echo(to_json(report).decode() if format_ == "json" else "\n".join(_lines(report)))
    if any(need.problems for need in report.needs):
        return ExitCode.MANIFEST_INVALID if plan else ExitCode.VIOLATED
    return ExitCode.OK


def _ephemeral(platform: str) -> EphemeralRange:
    if platform != THIS:
        return ephemeral_range(Platform(platform))
    try:
        return read_ephemeral_range(lambda path: Path(path).read_text(encoding="ascii"))
    except (OSError, ValueError) as error:
        raise UsageError(
            f"cannot tell this machine's ephemeral ports: {error}",
            hint="name a platform, for example --platform linux",
        ) from error


def _needs(plan: Plan | None, participants: int | None) -> tuple[Need, ...]:
    """What each host must hold, not yet judged."""
    if plan is None:
        asked = "--participants"
        return () if participants is None else (Need(host=asked, participants=participants),)
    return tuple(
        Need(
            host=each.machine or "this host",
            participants=len(each.participants),
            owners=tuple(participant.owner for participant in each.participants),
            unique_subscriptions=each.unique_subscriptions,
        )
        for each in demand(plan)
    )


def _judged(needs: tuple[Need, ...], domain: int, ephemeral: EphemeralRange) -> tuple[Need, ...]:
    return tuple(
        dataclasses.replace(
            need,
            problems=overflows(
                domain,
                participants=need.participants,
                unique_subscriptions=need.unique_subscriptions,
                ephemeral=ephemeral,
            ),
        )
        for need in needs
    )


def _lines(report: PortsReport) -> list[str]:
    """The report for people."""
    first, last = report.unique_subscription_ports
    capacity = report.capacity
    lines = [
        f"domain {report.domain_id}, participant {report.participant_id}",
        f"  discovery multicast   {report.ports.discovery_multicast}",
        f"  user multicast        {report.ports.user_multicast}",
        f"  discovery unicast     {report.ports.discovery_unicast}",
        f"  user unicast          {report.ports.user_unicast}",
        f"  unique subscriptions  {first}–{last} (Fast DDS; shared by all domains of a host)",
    ]
    lines += [f"  overlaps with         {_use(each)}" for each in report.overlaps]
    place = "this machine" if report.platform == THIS else report.platform
    runs = tuple(range(low, high + 1) for low, high in report.safe_domains)
    lines += [
        f"{place}: ephemeral ports {report.ephemeral}",
        f"  safe domains          {describe_domains(runs)}",
        (
            f"  fit in domain {report.domain_id:<8}{capacity.participants} participants per host, "
            f"then {capacity.limit}"
        ),
        f"  find each other       {report.localhost_participants} with 'range: localhost'",
    ]
    for need in report.needs:
        lines += _need_lines(need)
    return lines


def _need_lines(need: Need) -> list[str]:
    counts = count(need.participants, "participant")
    if need.unique_subscriptions:
        counts += f", {count(need.unique_subscriptions, 'unique subscription')}"
    return [
        f"{need.host}: {counts}: {'do not fit' if need.problems else 'fit'}",
        *(f"  {each}" for each in (*need.owners, *need.problems)),
    ]


def _use(use: PortUse) -> str:
    who = "" if use.participant_id is None else f" of participant {use.participant_id}"
    return f"{use.role.replace('_', ' ')}{who} of domain {use.domain_id}"
