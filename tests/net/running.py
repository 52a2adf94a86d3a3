"""Runs `lifecycle up` on several hosts at once, and gives the manifest that they share.

Owns: `article`, the example of *Unique Network Flows* on two machines, and `up_on`.
"""

from __future__ import annotations

import contextlib
import copy
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from tests.net.hosts import Host
from tests.ros.supervisor.running import ROOT, Up

DOMAIN = 7
"""Nobody else is in a network of our own."""

_NODES = "tests.net.systems"
_STRING = "std_msgs/msg/String"
_LIMITS = {"start_s": 10, "configure_s": 25, "connect_s": 10, "activate_s": 10}


def article(
    directory: Path, left: str = "", right: str = "", *, edit: Mapping[str, Any] | None = None
) -> Path:
    """Write the manifest of N1 on machine `a` and N2 on machine `b`; return its path.

    Args:
        directory: to write it to.
        left: address of machine `a`.
        right: address of machine `b`.
        edit: values by path, `nodes/n1/flows`, that are set or replaced.
    """
    document: dict[str, Any] = {
        "manifest_version": 1,
        "system": "article",
        "discovery": {"domain_id": DOMAIN, "range": "subnet"},
        "machines": {
            "a": {"address": left} if left else {},
            "b": {"address": right} if right else {},
        },
        "nodes": {
            "n1": {
                "run": {"python": f"{_NODES}:Source"},
                "machine": "a",
                "timeouts": _LIMITS,
                "interface": {
                    "publishers": [
                        {"name": "video", "type": _STRING, "qos": "sensor_data"},
                        {"name": "battery", "type": _STRING},
                    ]
                },
            },
            "n2": {
                "run": {"python": f"{_NODES}:Sink"},
                "machine": "b",
                "timeouts": _LIMITS,
                "interface": {
                    "subscriptions": [
                        {"name": "video", "type": _STRING, "qos": "sensor_data"},
                        {"name": "battery", "type": _STRING},
                    ]
                },
            },
        },
        "links": [
            {"topic": "/video", "from": "n1", "to": "n2"},
            {"topic": "/battery", "from": "n1", "to": "n2"},
        ],
    }
    for path, value in (edit or {}).items():
        *parents, last = path.split("/")
        place = document
        for key in parents:
            place = place.setdefault(key, {})
        place[last] = copy.deepcopy(value)  # another edit may be inside of it
    file = directory / "article.lifecycle.yaml"
    file.write_text(yaml.safe_dump(document))
    return file


UNIQUE: Mapping[str, Any] = {
    "nodes/n1/flows": {
        "publishers": {
            "video": {"unique": "strictly_required"},
            "battery": {"unique": "strictly_required"},
        }
    },
    "nodes/n2/flows": {
        "subscriptions": {
            "video": {"unique": "strictly_required"},
            "battery": {"unique": "strictly_required"},
        }
    },
    "links": [
        {"topic": "/video", "from": "n1", "to": "n2", "unique": "strongly"},
        {"topic": "/battery", "from": "n1", "to": "n2", "unique": "strongly"},
    ],
}
"""An edit of `article`: every flow must be unique."""


def run_directory(runtime: Path, machine: str) -> Path:
    """Return where the supervisor of a machine can be asked, see supervisor.remote."""
    return runtime / "lifecycle" / f"article@{DOMAIN}.{machine}"


def verb_on(host: Host, *words: str, runtime: Path) -> subprocess.CompletedProcess[str]:
    """Run a verb on a host to its end."""
    return subprocess.run(
        host.command(sys.executable, "-m", "lifecycle", *words),
        cwd=ROOT,
        env=host.environment(runtime),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@contextlib.contextmanager
def up_on(
    host: Host,
    manifest: Path,
    *options: str,
    runtime: Path,
    variables: Mapping[str, str] | None = None,
) -> Iterator[Up]:
    """Start `lifecycle up` on a host, and end it whatever happens."""
    running = Up(
        manifest,
        *options,
        runtime=runtime,
        through=host.command(guarded=True),
        variables={**host.environment(runtime, {}), **(variables or {})},
    )
    try:
        yield running
    finally:
        running.close()


@contextlib.contextmanager
def up_on_both(
    left: Host,
    right: Host,
    manifest: Path,
    *options: str,
    runtime: Path,
    variables: Mapping[str, str] | None = None,
) -> Iterator[tuple[Up, Up]]:
    """Start `lifecycle up` for machine `a` on one host and for `b` on the other."""
    with (
        up_on(
            left, manifest, "--machine", "a", *options, runtime=runtime / "a", variables=variables
        ) as up_a,
        up_on(
            right, manifest, "--machine", "b", *options, runtime=runtime / "b", variables=variables
        ) as up_b,
    ):
        yield up_a, up_b
