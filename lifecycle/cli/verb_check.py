"""`lifecycle check`: judge a manifest without running anything. Imports nothing of ROS."""

from __future__ import annotations

import dataclasses
import os

import click

from lifecycle.cli.common import format_option, manifest_arguments, parse_assignments
from lifecycle.codec import to_json
from lifecycle.errors import ExitCode
from lifecycle.manifest import Diagnostic, Manifest, ManifestError, Severity, load
from lifecycle.plan import check_plan, effective_domain


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class CheckReport:
    """What `check --format json` prints (schema: schemas/check.v1.schema.json).

    Attributes:
        ok: the exit code is 0.
        system: empty where the manifest could not be loaded.
        nodes: number of nodes; likewise endpoints and links. 0 where it could not be loaded.
        diagnostics: by position.
    """

    manifest: str
    ok: bool
    system: str
    nodes: int
    endpoints: int
    links: int
    diagnostics: tuple[Diagnostic, ...]


@click.command()
@manifest_arguments
@format_option("text", "json")
@click.option("--strict", is_flag=True, help="Let warnings fail the check, too.")
def command(manifest: str, assignments: tuple[str, ...], format_: str, *, strict: bool) -> int:
    """Check MANIFEST: schema, names, QoS compatibility, order, flows. Runs nothing, needs no ROS.

    Exits with 0 if it can be used, with 3 if not.
    """
    report = check(manifest, assignments, strict=strict)
    if format_ == "json":
        click.echo(to_json(report))
    else:
        for each in report.diagnostics:
            click.echo(str(each))
        click.echo(summary(report))
    return ExitCode.OK if report.ok else ExitCode.MANIFEST_INVALID


def check(path: str, assignments: tuple[str, ...], *, strict: bool) -> CheckReport:
    """Load and plan a manifest and report on it instead of raising.

    Raises:
        UsageError: an argument is malformed, or ROS_DOMAIN_ID is needed and no domain.
    """
    loaded: Manifest | None = None
    try:
        result = load(path, parse_assignments(assignments))
        effective_domain(result.manifest.discovery, os.environ)
        diagnostics = (*result.warnings, *check_plan(result.manifest))
        if all(each.severity is Severity.WARNING for each in diagnostics):
            loaded = result.manifest
    except ManifestError as error:
        diagnostics = error.diagnostics
    nodes = loaded.nodes if loaded else ()
    return CheckReport(
        manifest=path,
        ok=loaded is not None and not (strict and diagnostics),
        system=loaded.system if loaded else "",
        nodes=len(nodes),
        endpoints=sum(len(node.interface.endpoints) for node in nodes),
        links=len(loaded.links) if loaded else 0,
        diagnostics=diagnostics,
    )


def summary(report: CheckReport) -> str:
    """Return one line, `teleop: 6 nodes, 14 endpoints, 3 links: ok`."""
    severities = [each.severity for each in report.diagnostics]
    errors, warnings = severities.count(Severity.ERROR), severities.count(Severity.WARNING)
    found = [_count(errors, "error")] * bool(errors) + [_count(warnings, "warning")] * bool(
        warnings
    )
    outcome = "ok" if report.ok else "not ok"
    verdict = f"{outcome} ({', '.join(found)})" if found else outcome
    if not report.system:
        return f"{report.manifest}: {verdict}"
    counts = (
        _count(report.nodes, "node"),
        _count(report.endpoints, "endpoint"),
        _count(report.links, "link"),
    )
    return f"{report.system}: {', '.join(counts)}: {verdict}"


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"
