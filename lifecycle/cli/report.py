"""`--report FILE`: a verdict in the format that the suffix says, whatever the command's end.

The file is emptied before anything is started, so that nothing old is taken for new, and written on
every exit code. Imports next to nothing: it is opened before the rest of a command is imported.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

import click
from msgspec.structs import replace

from lifecycle.cli.common import replace_text, say, unwritable
from lifecycle.errors import ExitCode, LifecycleError, UsageError, exhausted
from lifecycle.printable import count

if TYPE_CHECKING:
    from lifecycle.plan.model import Plan
    from lifecycle.verify.verdict import Verdict

F = TypeVar("F", bound=Callable[..., Any])

SUFFIXES = {
    ".json": "json",
    ".xml": "junit",
    ".sarif": "sarif",
    ".sarif.json": "sarif",
    ".txt": "text",
}
"""End of a file's name → format; SARIF 2.1.0 §3.2 recommends both of its own."""


def report_format(path: Path) -> str:
    """Return the format that a file's suffix says: "json", "junit", "sarif" or "text".

    Raises:
        UsageError: the suffix says none.
    """
    name = path.name.lower()
    for suffix in sorted(SUFFIXES, key=len, reverse=True):
        if name.endswith(suffix) and name != suffix:
            return SUFFIXES[suffix]
    raise UsageError(
        f"cannot tell the format of report {str(path)!r} by its suffix {path.suffix!r}; "
        "allowed: .json, .xml (JUnit), .sarif, .txt"
    )


def open_report(path: Path) -> None:
    """Make sure that a report can be written, and that nothing old is in it.

    Raises:
        UsageError: its suffix says no format, or it cannot be written.
    """
    report_format(path)
    try:
        if not _is_stream(path):
            replace_text(path, "")
        elif not os.access(path, os.W_OK):
            raise PermissionError(13, "Permission denied")
    except OSError as error:
        raise unwritable(path, error, "report ") from error


def write_report(path: Path, text: str) -> ExitCode:
    """Replace what is in a report, half of which might read as a success.

    Returns:
        USAGE where it cannot be written any more, which then has been said: no success.
    """
    try:
        _replace(path, text)
    except UsageError as error:
        say(str(error))
        return ExitCode.USAGE
    return ExitCode.OK


def _replace(path: Path, text: str) -> None:
    try:
        replace_text(path, text.rstrip("\n") + "\n")
    except OSError as error:
        raise unwritable(path, error, "report ") from error


def report_option(function: F) -> F:
    """Add `--report FILE`; it is opened while the command line is read."""

    def opened(ctx: click.Context, _: click.Parameter, path: Path | None) -> Path | None:
        if path is not None and not ctx.resilient_parsing:
            open_report(path)
        return path

    return click.option(
        "--report",
        type=click.Path(path_type=Path),
        metavar="FILE",
        callback=opened,
        is_eager=True,
        help="Write the result to FILE, too, on every exit code: by suffix JSON (.json), JUnit "
        "(.xml), SARIF (.sarif) or text (.txt).",
    )(function)


def format_verdict(
    verdict: Verdict,
    plan: Plan | None,
    format_: str,
    *,
    colour: bool = False,
    strict: bool = False,
) -> str:
    """Return `verdict` as "text", "json", "junit", "sarif" or "github" (text and annotations).

    There is no plan where the manifest cannot be used.
    """
    from lifecycle.verify.report import render_text, to_github, to_json, to_junit, to_sarif

    if format_ == "json":
        return to_json(verdict)
    if format_ == "junit":
        return to_junit(verdict, plan, strict=strict)
    if format_ == "sarif":
        return to_sarif(verdict)
    if format_ == "github":
        return to_github(verdict, strict=strict)
    return render_text(verdict, colour=colour)


def exit_code(verdict: Verdict, *, strict: bool) -> ExitCode:
    """Return the exit code of a verdict."""
    from lifecycle.supervisor.core.gate import closes
    from lifecycle.verify.outcome import Outcome

    if not closes(verdict, strict=strict):
        return ExitCode.OK
    violated = verdict.verdict is Outcome.VIOLATED
    return ExitCode.VIOLATED if violated else ExitCode.UNVERIFIABLE


class ReportFile:
    """The report of one command; use it in a `with` around all that may fail.

    Whatever leaves the block, the file says how the command ended: the verdict given to `end`, or
    the exception. Until then it says that there was no end, for a reader after a SIGKILL.

    Args:
        path: opened by `report_option`; None writes nothing.
        strict: what cannot be verified counts as refused.
    """

    def __init__(self, path: Path | None, *, strict: bool = False) -> None:
        self._path = path
        self._strict = strict
        self._waits = path is not None and _is_stream(path)
        self._plan: Plan | None = None
        self._ended = False

    def __enter__(self) -> ReportFile:  # noqa: PYI034 - typing.Self is not in Python 3.10
        return self

    def begin(self, plan: Plan) -> None:
        """Take the plan that the verdict will be of."""
        self._plan = plan
        if not self._waits:
            reason = "it never came to its end: the process was killed"
            if self._path is not None:
                _replace(self._path, self._text(self._path, _unjudged(reason, ExitCode.INTERNAL)))

    def end(self, verdict: Verdict, plan: Plan | None = None) -> ExitCode:
        """Write how it ended, of another plan where one was taken since `begin`.

        Returns:
            See `write_report`.
        """
        self._ended = True
        self._plan = plan or self._plan
        if self._path is None:
            return ExitCode.OK
        return write_report(self._path, self._text(self._path, verdict))

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is not None and not self._ended:
            self.end(_verdict_of(error))

    def _text(self, path: Path, verdict: Verdict) -> str:
        return format_verdict(verdict, self._plan, report_format(path), strict=self._strict)


def _verdict_of(error: BaseException) -> Verdict:
    """Return the verdict of a command that ended by an exception before anything was judged."""
    from lifecycle.manifest.diagnostics import ManifestError, Severity
    from lifecycle.supervisor.run.signals import Ended
    from lifecycle.verify.outcome import Outcome
    from lifecycle.verify.verdict import Finding

    if isinstance(error, ManifestError):
        found = [each for each in error.diagnostics if each.severity is Severity.ERROR]
        reason = f"the manifest is invalid: {count(len(found), 'error')}"
        return replace(
            _unjudged(reason, error.exit_code),
            verdict=Outcome.VIOLATED,
            findings=tuple(
                Finding(
                    rule=each.rule,
                    outcome=Outcome.VIOLATED,
                    subject=each.at.path or each.at.file,
                    expected="",
                    observed="",
                    message=each.message,
                    at=each.at.spelled,
                    hint=each.hint,
                )
                for each in found
            ),
        )
    if isinstance(error, Ended):
        return _unjudged(error.reason, error.exit_code)
    if isinstance(error, click.ClickException):
        return _unjudged(error.format_message(), ExitCode.USAGE)
    if isinstance(error, LifecycleError):
        return _unjudged(str(error), error.exit_code)
    if isinstance(error, KeyboardInterrupt | click.Abort):
        return _unjudged("interrupted", ExitCode.INTERRUPTED)
    used_up = exhausted(error)
    code = ExitCode.INTERNAL if used_up is None else used_up.exit_code
    return _unjudged(f"a bug in lifecycle: {type(error).__name__}: {error}", code)


def _unjudged(reason: str, code: ExitCode) -> Verdict:
    from lifecycle.verify.verdict import NOT_JUDGED, RunEnd

    run = RunEnd(reason=reason, reached=None, exit_code=code)
    return replace(NOT_JUDGED, run=run)


def _is_stream(path: Path) -> bool:
    """Whether it is a pipe or a terminal, which is written once, in the end."""
    return path.exists() and not (path.is_file() or path.is_dir())
