"""Writing a verdict to a file in the format that its suffix says. Owns: `write_report`."""

from __future__ import annotations

from pathlib import Path

from lifecycle.errors import UsageError
from lifecycle.plan import Plan
from lifecycle.verify import Verdict, render_text, to_json, to_junit, to_sarif


def format_verdict(verdict: Verdict, plan: Plan, format_: str, *, colour: bool = False) -> str:
    """Return `verdict` as "text", "json", "junit" or "sarif"."""
    if format_ == "json":
        return to_json(verdict)
    if format_ == "junit":
        return to_junit(verdict, plan)
    if format_ == "sarif":
        return to_sarif(verdict)
    return render_text(verdict, colour=colour)


def write_report(path: Path, verdict: Verdict, plan: Plan) -> None:
    """Write `verdict` to `path`: JUnit for .xml, SARIF for .sarif, text for .txt, else JSON.

    Raises:
        UsageError: the file cannot be written.
    """
    formats = {".xml": "junit", ".sarif": "sarif", ".txt": "text"}
    text = format_verdict(verdict, plan, formats.get(path.suffix, "json"))
    try:
        path.write_text(text.rstrip("\n") + "\n", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"cannot write report {str(path)!r}: {error.strerror}") from error
