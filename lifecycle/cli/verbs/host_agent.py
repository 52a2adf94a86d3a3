"""`lifecycle host-agent`: the other end of `--hosts`; no verb for people, and not listed."""

from __future__ import annotations

import sys

import click

from lifecycle.fleet import serve


@click.command("host-agent")
def command() -> None:
    """Start and follow a supervisor for `lifecycle up --hosts`, which speaks on standard input."""
    serve(sys.stdin.fileno(), sys.stdout.fileno())
