"""What every test shares: how property tests look for examples, and that programs can be ended.

A busy machine says nothing about a property, so no example has a deadline. CI takes the same
examples each time, so that a change is refused for what it changed; everywhere else new ones are
looked for at each run.

A shell starts what runs in its background with SIGINT ignored, and nohup with SIGHUP; programs
inherit that, and tests end programs by signals.

Of a test that has a second try (`tests/second_try.py`) the summary shows all of the first failure.
"""

from __future__ import annotations

import os
import signal

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "lifecycle",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize="CI" in os.environ,
)
settings.load_profile("lifecycle")

for number, default in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGHUP, signal.SIG_DFL),
):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, default)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Show how tests failed at first that were tried again."""
    for report in terminalreporter.stats.get("rerun", ()):
        terminalreporter.section(f"first try of {report.nodeid}", red=True, bold=True)
        terminalreporter.line(report.longreprtext)
        for title, text in report.sections:
            terminalreporter.section(title, sep="-")
            terminalreporter.line(text)
