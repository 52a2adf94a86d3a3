"""`lifecycle check`: judge a manifest without running anything; imports nothing of ROS.

Owns: the verb, `CheckReport` and its formats: text, JSON, SARIF 2.1.0 and JUnit.
"""

from __future__ import annotations

import os
from pathlib import Path

import click
import msgspec

from lifecycle.ci_formats import Case, Problem, github, junit, sarif
from lifecycle.cli import common
from lifecycle.cli.report import report_format, report_option, write_report
from lifecycle.codec import Count
from lifecycle.errors import ExitCode, LifecycleError, UsageError
from lifecycle.manifest.diagnostics import Diagnostic, ManifestError, Position, Severity
from lifecycle.manifest.loading import ArgumentDeclaration, declared_arguments, load
from lifecycle.manifest.model import Manifest
from lifecycle.plan.build import check_plan, effective_domain
from lifecycle.plan.programs import Resolution, UnresolvedProgram
from lifecycle.printable import count, lines


class CheckReport(msgspec.Struct, frozen=True, kw_only=True):
    """What was found in one manifest and everything it includes (schemas/check.v1.schema.json).

    Attributes:
        ok: the exit code is 0.
        system: empty where the manifest could not be loaded.
        nodes: number of nodes; likewise endpoints and links. 0 where it could not be loaded.
        diagnostics: by position.
        unresolved: what nodes run and could not be looked for here.
    """

    manifest: str
    ok: bool
    system: str
    nodes: Count
    endpoints: Count
    links: Count
    diagnostics: tuple[Diagnostic, ...]
    unresolved: tuple[UnresolvedProgram, ...] = ()

    def exit_code(self, *, strict: bool) -> ExitCode:
        """Return what `check` exits with."""
        if self.ok:
            return ExitCode.OK
        errors = any(each.severity is Severity.ERROR for each in self.diagnostics)
        alone = strict and not errors and bool(self.system)
        return ExitCode.UNVERIFIABLE if alone else ExitCode.MANIFEST_INVALID


def write_check(report: CheckReport, format_: str, *, strict: bool) -> str:
    """Return a report as "text", "json", "sarif", "junit" or "github" (text and annotations).

    What is unproven or could not be resolved is a failure if it is `strict`.
    """
    if format_ == "json":
        return common.json_of(report)
    if format_ == "sarif":
        return _sarif(report).rstrip("\n")
    if format_ == "junit":
        return _junit(report, strict=strict).rstrip("\n")
    lines = [*map(str, report.diagnostics), *map(str, report.unresolved), summary(report)]
    if format_ == "github":
        lines += [
            github(_problem(each, fails=strict and each.is_unproven)) for each in report.diagnostics
        ]
    return "\n".join(lines)


def summary(report: CheckReport) -> str:
    """Return one line, `teleop: 6 nodes, 14 endpoints, 3 links: ok`."""
    severities = [each.severity for each in report.diagnostics]
    errors, warnings = severities.count(Severity.ERROR), severities.count(Severity.WARNING)
    by_word = [(errors, "error"), (warnings, "warning"), (severities.count(Severity.NOTE), "note")]
    found = [count(number, word) for number, word in by_word if number]
    found += [f"{len(report.unresolved)} not resolved"] * bool(report.unresolved)
    outcome = "ok" if report.ok else "not ok"
    verdict = f"{outcome} ({', '.join(found)})" if found else outcome
    if not report.system:
        return f"{report.manifest}: {verdict}"
    counts = (
        count(report.nodes, "node"),
        count(report.endpoints, "endpoint"),
        count(report.links, "link"),
    )
    return f"{report.system}: {', '.join(counts)}: {verdict}"


def _problem(found: Diagnostic, *, fails: bool = False) -> Problem:
    return Problem(
        rule=found.rule,
        level="error" if fails else found.severity.value,
        message=found.message,
        hint=found.hint,
        subject=found.at.path,
        at=found.at.spelled,
    )


def _junit(report: CheckReport, *, strict: bool) -> str:
    bad = [each for each in report.diagnostics if each.severity is Severity.ERROR]
    bad += [each for each in report.diagnostics if strict and each.is_unproven and each not in bad]
    failed = [*map(str, bad), *(map(str, report.unresolved) if strict else ())]
    case = Case(
        classname="check",
        name="the manifest is valid",
        failure=(failed[0], "\n".join(failed)) if failed else None,
        note=write_check(report, "text", strict=strict),
    )
    return junit(f"lifecycle check {report.manifest}", [case])


def _sarif(report: CheckReport) -> str:
    rules = sorted({each.rule for each in report.diagnostics} | {_UNRESOLVED})
    unresolved = [
        Problem(
            rule=_UNRESOLVED,
            level="note",
            message=f"could not resolve {each.subject}: {each.reason}",
            subject=each.at.path,
            at=each.at.spelled,
        )
        for each in report.unresolved
    ]
    return sarif(
        [*map(_problem, report.diagnostics), *unresolved],
        [{"id": each} for each in rules],
        properties={"ok": report.ok, "summary": summary(report)},
        invocation={"executionSuccessful": report.ok},
    )


_UNRESOLVED = "program.unresolved"


@click.command()
@common.manifest_arguments
@common.format_option("text", "json", "sarif", "junit", "github")
@click.option(
    "--strict",
    is_flag=True,
    help="Let what is not proven (warnings, what could not be resolved) fail it, too.",
)
@common.machine_option("The machine that this host is; default: all whose address is this host's.")
@click.option(
    "--arguments", "lists", is_flag=True, help="List the arguments that it takes, and end."
)
@common.run_commands_option
@report_option
def command(
    *,
    manifest: str,
    assignments: tuple[str, ...],
    format_: str,
    strict: bool,
    machine: str,
    lists: bool,
    run_commands: bool,
    report: Path | None,
) -> int:
    """Check MANIFEST: schema, names, QoS compatibility, order, flows, and what its nodes run.

    Programs, packages, Python classes and their handlers are looked for without running them, as
    `lifecycle up` would find them here. Needs no ROS. Exits with 0 if it can be used, with 3 if
    not; under --strict with 5 if it can, but a warning or something that could not be resolved
    remains. Notes, and warnings that `policy:` asks for, never fail it.
    """
    if lists:
        return _list(manifest, format_, others=bool(assignments or strict or machine or report))
    try:
        found = check(
            manifest, assignments, strict=strict, machine=machine, run_commands=run_commands
        )
    except LifecycleError as error:
        if report is not None:
            _write(report, _refused(manifest, error), strict=strict)
        raise
    unwritten = ExitCode.OK if report is None else _write(report, found, strict=strict)
    text = write_check(found, format_, strict=strict)
    # Names of files are not ours to trust.
    shown = {"text": lines, "github": lines}
    click.echo(shown.get(format_, str)(text))
    return found.exit_code(strict=strict) or unwritten


def _list(path: str, format_: str, *, others: bool) -> int:
    if others or format_ not in ("text", "json"):
        raise UsageError(
            "cannot use --arguments with anything but --format text or json",
            hint=f"lifecycle check {path} --arguments",
        )
    found = declared_arguments(path)
    if format_ == "json":
        click.echo(common.json_of(found))
    else:
        text = "\n".join(map(_argument, found)) or f"{path} takes no arguments"
        click.echo(lines(text))
    return ExitCode.OK


def _argument(each: ArgumentDeclaration) -> str:
    """Return `rate:=10  frames per second; allowed: 5, 10`."""
    value = "VALUE" if each.default is None else each.default
    about = [each.description, "required" if each.default is None else ""]
    about += [f"allowed: {', '.join(each.choices)}"] if each.choices else []
    said = "; ".join(filter(None, about))
    return f"{each.name}:={value}  {said}".rstrip()


def _write(report: Path, found: CheckReport, *, strict: bool) -> ExitCode:
    return write_report(report, write_check(found, report_format(report), strict=strict))


def _refused(path: str, error: LifecycleError) -> CheckReport:
    """Return what is reported of a manifest that was not looked at, and why it was not."""
    at = Position(file=path, line=1, column=1)
    why = Diagnostic(rule="check.usage", severity=Severity.ERROR, at=at, message=str(error))
    return CheckReport(
        manifest=path, ok=False, system="", nodes=0, endpoints=0, links=0, diagnostics=(why,)
    )


def check(
    path: str,
    assignments: tuple[str, ...],
    *,
    strict: bool,
    machine: str = "",
    run_commands: bool = False,
) -> CheckReport:
    """Load and plan a manifest, look for what it runs, and report on it instead of raising.

    Raises:
        UsageError: an argument is malformed, ROS_DOMAIN_ID is needed and no domain, or the
            manifest declares no such machine.
    """
    loaded: Manifest | None = None
    resolution = Resolution()
    try:
        result = load(path, common.parse_assignments(assignments), run_commands=run_commands)
        effective_domain(result.manifest.discovery, os.environ)
        resolution = common.resolve(result.manifest, machine)
        diagnostics = (
            *result.warnings,
            *check_plan(result.manifest, files=result.files),
            *resolution.diagnostics,
        )
        if all(each.severity is not Severity.ERROR for each in diagnostics):
            loaded = result.manifest
    except ManifestError as error:
        diagnostics = error.diagnostics
    nodes = loaded.nodes if loaded else ()
    return CheckReport(
        manifest=path,
        ok=loaded is not None
        and not (
            strict and (any(each.is_unproven for each in diagnostics) or resolution.unresolved)
        ),
        system=loaded.system if loaded else "",
        nodes=len(nodes),
        endpoints=sum(len(node.interface.endpoints) for node in nodes),
        links=len(loaded.links) if loaded else 0,
        diagnostics=diagnostics,
        unresolved=resolution.unresolved,
    )
