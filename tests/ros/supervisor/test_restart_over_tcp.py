"""Restarts and deaths where participants are connected by TCP, and a discovery server that dies."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from lifecycle.errors import ExitCode
from tests.ros.middleware.free_ports import first_port
from tests.ros.supervisor.running import pair, up, verb

pytestmark = pytest.mark.thorough


def by_tcp(directory: Path, domain_id: int, **discovery: str) -> Path:
    """Write the manifest of the pair, connected by TCP on ports that nobody has."""
    how: dict[str, Any] = {"domain_id": domain_id, "first_port": first_port(), **discovery}
    return pair(directory, domain_id, edit={"discovery": how})


@pytest.mark.parametrize(
    ("mode", "orders"),
    [("static", (("talker",), ("listener",))), ("server", (("listener",), ()))],
    ids=["static", "server"],
)
def test_who_is_restarted_or_killed_is_found_again(
    tmp_path: Path, fresh_domain: int, mode: str, orders: tuple[tuple[str, ...], ...]
) -> None:
    discovery = {"mode": mode} | ({"transport": "tcpv4"} if mode == "static" else {})
    manifest = by_tcp(tmp_path, fresh_domain, **discovery)
    numbered = manifest.read_text().replace("systems:Talker", "systems:Numbered")
    manifest.write_text(f"{numbered}restart: always\n")
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        for process in ("talker", "listener"):
            begun = len(run.events)
            os.kill(run.pid_of(process), signal.SIGKILL)
            run.until("restarted", process=process)
            run.met("log", since=begun, line=f"heard pid {run.pid_of('talker')}")
        for nodes in orders:
            begun = run.catch_up()
            done = verb("restart", "pair", *nodes, runtime=tmp_path)
            assert (done.returncode, done.stderr) == (ExitCode.OK, "")
            run.met("system", since=begun, reached="active")
            run.met("log", since=begun, line=f"heard pid {run.pid_of('talker')}")
        # Whoever looks on is told where they listen now.
        judged = verb("verify", str(manifest), "--timeout", "20", runtime=tmp_path)
        assert judged.returncode == ExitCode.OK, judged.stdout
        assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
        assert run.finish() == ExitCode.OK
        run.assert_nothing_left()


def test_a_discovery_server_that_dies_ends_the_run_and_is_named(
    tmp_path: Path, fresh_domain: int
) -> None:
    manifest = by_tcp(tmp_path, fresh_domain, mode="server")
    with up(manifest, "--keep-going", runtime=tmp_path) as run:
        run.until("system", reached="active")
        pid = run.pid_of("discovery_server")
        os.kill(pid, signal.SIGKILL)
        assert run.finish() == ExitCode.BRING_UP_FAILED
        died = f"cannot keep process 'discovery_server' running: pid {pid} died: killed by SIGKILL"
        (failed,) = run.of_kind("failure")
        said = (failed["rule"], failed["subject"], failed["message"])
        assert said == ("run.process-died", "discovery_server", died)
        run.assert_nothing_left()
