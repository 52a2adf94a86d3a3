"""`lifecycle check`: judge a manifest without running anything. Imports nothing of ROS."""

from __future__ import annotations

import os
from pathlib import Path

import click

from lifecycle.cli.check_report import CheckReport, write_check
from lifecycle.cli.common import format_option, manifest_arguments, parse_assignments, resolve
from lifecycle.cli.report import (
    report_format,
    report_option,
    write_report,
    written_or_said,
)
from lifecycle.errors import ExitCode, LifecycleError
from lifecycle.manifest import Diagnostic, Manifest, ManifestError, Severity, load
from lifecycle.manifest.diagnostics import Position
from lifecycle.plan import check_plan, effective_domain
from lifecycle.plan.programs.programs import Resolution
from lifecycle.printable import json_text, lines


@click.command()
@manifest_arguments
@format_option("text", "json", "sarif", "junit")
@click.option(
    "--strict", is_flag=True, help="Let warnings and what could not be resolved fail it, too."
)
@click.option(
    "--machine",
    default="",
    metavar="NAME",
    help="The machine that this host is; default: all whose address is this host's.",
)
@report_option
def command(
    *,
    manifest: str,
    assignments: tuple[str, ...],
    format_: str,
    strict: bool,
    machine: str,
    report: Path | None,
) -> int:
    """Check MANIFEST: schema, names, QoS compatibility, order, flows, and what its nodes run.

    Programs, packages, Python classes and their handlers are looked for without running them, as
    `lifecycle up` would find them here. Needs no ROS. Exits with 0 if it can be used, with 3 if
    not; under --strict with 5 if all that is missing is something that could not be resolved.
    """
    try:
        found = check(manifest, assignments, strict=strict, machine=machine)
    except LifecycleError as error:
        if report is not None:
            _write(report, _refused(manifest, error), strict=strict)
        raise
    unwritten = ExitCode.OK if report is None else _write(report, found, strict=strict)
    text = write_check(found, format_, strict=strict)
    # Names of files are anybody's.
    shown = {"text": lines, "json": json_text, "sarif": json_text}.get(format_, str)
    click.echo(shown(text))
    return found.exit_code(strict=strict) or unwritten


def _write(report: Path, found: CheckReport, *, strict: bool) -> ExitCode:
    text = write_check(found, report_format(report), strict=strict)
    return written_or_said(lambda: write_report(report, text))


def _refused(path: str, error: LifecycleError) -> CheckReport:
    """Return what is reported of a manifest that was not looked at, and why it was not."""
    at = Position(file=path, line=1, column=1)
    why = Diagnostic(rule="check.usage", severity=Severity.ERROR, at=at, message=str(error))
    return CheckReport(
        manifest=path, ok=False, system="", nodes=0, endpoints=0, links=0, diagnostics=(why,)
    )


def check(
    path: str, assignments: tuple[str, ...], *, strict: bool, machine: str = ""
) -> CheckReport:
    """Load and plan a manifest, look for what it runs, and report on it instead of raising.

    Raises:
        UsageError: an argument is malformed, ROS_DOMAIN_ID is needed and no domain, or the
            manifest declares no such machine.
    """
    loaded: Manifest | None = None
    resolution = Resolution()
    try:
        result = load(path, parse_assignments(assignments))
        effective_domain(result.manifest.discovery, os.environ)
        resolution = resolve(result.manifest, machine)
        diagnostics = (
            *result.warnings,
            *check_plan(result.manifest),
            *resolution.diagnostics,
        )
        if all(each.severity is Severity.WARNING for each in diagnostics):
            loaded = result.manifest
    except ManifestError as error:
        diagnostics = error.diagnostics
    nodes = loaded.nodes if loaded else ()
    return CheckReport(
        manifest=path,
        ok=loaded is not None and not (strict and (diagnostics or resolution.unresolved)),
        system=loaded.system if loaded else "",
        nodes=len(nodes),
        endpoints=sum(len(node.interface.endpoints) for node in nodes),
        links=len(loaded.links) if loaded else 0,
        diagnostics=diagnostics,
        unresolved=resolution.unresolved,
    )
