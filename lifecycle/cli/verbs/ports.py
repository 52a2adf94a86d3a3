"""`lifecycle ports`: which ports DDS uses in a domain; the arithmetic is in lifecycle.network."""

from __future__ import annotations

import os
from pathlib import Path

import click
import msgspec

from lifecycle.cli.common import format_option, json_of
from lifecycle.errors import ExitCode, UsageError
from lifecycle.manifest.model import Discovery
from lifecycle.network.ports import (
    LOCALHOST_PARTICIPANTS,
    PARTICIPANTS_PER_DOMAIN,
    Capacity,
    ParticipantPorts,
    describe_domains,
    max_participants,
    participant_ports,
    read_ephemeral_range,
    safe_domains,
    unique_flow_ports,
)
from lifecycle.plan.build import effective_domain


class PortsReport(msgspec.Struct, frozen=True, kw_only=True):
    """All that the verb says; the JSON document has these keys.

    Attributes:
        ephemeral: first and last port that Linux gives to sockets without one.
        safe_domains: first and last id of each run.
        localhost_participants: so many of one host all find each other with `range: localhost`.
        unique_subscription_ports: first and last.
    """

    domain_id: int
    participant_id: int
    ports: ParticipantPorts
    ephemeral: tuple[int, int]
    safe_domains: tuple[tuple[int, int], ...]
    capacity: Capacity
    localhost_participants: int
    unique_subscription_ports: tuple[int, int]


@click.command("ports")
@click.option("--domain", type=int, help="Domain id, 0-232; default: ROS_DOMAIN_ID, else 0.")
@click.option("--participant", type=int, default=0, show_default=True, help="Counts from 0.")
@format_option("text", "json")
def command(*, domain: int | None, participant: int, format_: str) -> int:
    """Show the UDP ports of a DDS participant and how many fit.

    Whether a manifest's system fits `lifecycle check` says, and `lifecycle plan` which participants
    it has.
    """
    try:
        ephemeral = read_ephemeral_range(lambda path: Path(path).read_text(encoding="ascii"))
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot tell this machine's ephemeral ports: {error}") from error
    if domain is None:
        domain = effective_domain(Discovery(), os.environ)
    try:
        report = PortsReport(
            domain_id=domain,
            participant_id=participant,
            ports=participant_ports(domain, participant),
            ephemeral=(ephemeral[0], ephemeral[-1]),
            safe_domains=tuple((run[0], run[-1]) for run in safe_domains(ephemeral)),
            capacity=max_participants(domain, ephemeral),
            localhost_participants=LOCALHOST_PARTICIPANTS,
            unique_subscription_ports=(unique_flow_ports()[0], unique_flow_ports()[-1]),
        )
    except ValueError as error:
        raise UsageError(str(error)) from error
    click.echo(json_of(report) if format_ == "json" else "\n".join(_lines(report)))
    return ExitCode.OK


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
    if report.participant_id >= PARTICIPANTS_PER_DOMAIN:
        lines.append("  overlaps with         ports of the domains after it")
    runs = tuple(range(low, high + 1) for low, high in report.safe_domains)
    lines += [
        f"this machine: ephemeral ports {report.ephemeral[0]}–{report.ephemeral[1]}",
        f"  safe domains          {describe_domains(runs)}",
        (
            f"  fit in domain {report.domain_id:<8}{capacity.participants} participants per host, "
            f"then {capacity.limit}"
        ),
        f"  find each other       {report.localhost_participants} with 'range: localhost'",
    ]
    return lines
