"""`lifecycle up --program nft`: its table is there exactly while the system is active."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from lifecycle.errors import ExitCode
from tests.net.hosts import Host, Hosts
from tests.net.running import UNIQUE, article, up_on
from tests.ros.supervisor.running import ROOT, Up

pytestmark = pytest.mark.skipif(shutil.which("nft") is None, reason="nft is not installed")

_TABLE = "table inet flowqos_article\n"
_BOUND_S = 60

_MARKED: Mapping[str, Any] = {
    **UNIQUE,
    "nodes/n1/flows": {
        "publishers": {
            "video": {"unique": "strictly_required", "five_qi": 85},
            "battery": {"unique": "strictly_required"},
        }
    },
}
_PROGRAM = ("--program", "nft", "--dscp-from-5qi")


@pytest.fixture
def mapping(tmp_path: Path) -> str:
    """A mapping that marks the video."""
    file = tmp_path / "mapping.json"
    file.write_text('{"name": "test", "source": "this test", "values": {"85": "EF"}}')
    return str(file)


def tables(host: Host) -> str:
    return host.run("nft", "list", "tables")


def listing(host: Host) -> str:
    return host.run("nft", "list", "table", "inet", "flowqos_article")


def video_port(up: Up, to: Host) -> int:
    """Return where the video goes, as last verified."""
    verdicts = [each["verdict"]["flows"] for each in up.of_kind("verdict")]
    found = [
        nfe["transport_port"]
        for flows in verdicts
        for flow in flows
        if flow["topic"] == "/video"
        for nfe in flow["destination"]
        if nfe["internet_address"] == to.ipv4
    ]
    return int(found[-1])


def programmed(up: Up, count: int) -> str:
    """Return the last of so many notices of what was programmed."""
    said = [each["message"] for each in up.of_kind("notice")]
    found = [each for each in said if each.startswith("nft table inet flowqos_article: ")]
    while len(found) < count:
        message = up.until("notice")["message"]
        if message.startswith("nft table inet flowqos_article: "):
            found.append(message)
    return found[count - 1]


def test_a_system_programs_its_host_while_it_is_active_follows_its_flows_and_cleans_up(
    hosts: Hosts, tmp_path: Path, mapping: str
) -> None:
    one, other = hosts.bridged("A", "B")
    manifest = article(tmp_path, one.ipv4, other.ipv4, edit=_MARKED)
    options = ("--machine", "a", *_PROGRAM, mapping)
    with up_on(one, manifest, *options, runtime=tmp_path / "a") as near:
        with up_on(other, manifest, "--machine", "b", runtime=tmp_path / "b") as far:
            near.until("gate")
            assert "1 created" in programmed(near, 1)
            assert tables(one) == _TABLE
            assert tables(other) == ""
            near.until("system", reached="active")
            assert "dscp set ef" in listing(one)
            far.until("system", reached="active")
            port = video_port(near, other)
            assert f". {port} " in listing(one)
            far.signal(signal.SIGTERM)
            assert far.finish() == ExitCode.OK
        # The rule of a flow that is away for a moment harms nobody.
        assert f". {port} " in listing(one)

        with other.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
            taken.bind(("0.0.0.0", port))
            with up_on(other, manifest, "--machine", "b", runtime=tmp_path / "b") as far:
                assert "1 updated" in programmed(near, 2)
                assert f". {port} " not in listing(one)
                assert f". {video_port(near, other)} " in listing(one)
                far.until("system", reached="active")
                near.signal(signal.SIGINT)
                assert near.finish() == ExitCode.INTERRUPTED
    assert "1 deleted" in programmed(near, 3)
    assert tables(one) == ""
    assert not (tmp_path / "a" / "lifecycle" / "article@7.a" / "programmed.json").exists()
    near.assert_nothing_left()


def test_down_removes_what_a_killed_supervisor_programmed(
    hosts: Hosts, tmp_path: Path, mapping: str
) -> None:
    one, other = hosts.bridged("A", "B")
    manifest = article(tmp_path, one.ipv4, other.ipv4, edit=_MARKED)
    with (
        up_on(one, manifest, "--machine", "a", *_PROGRAM, mapping, runtime=tmp_path / "a") as near,
        up_on(other, manifest, "--machine", "b", runtime=tmp_path / "b"),
    ):
        near.until("system", reached="active")
        near.signal(signal.SIGKILL)
        near.process.wait(_BOUND_S)
        assert tables(one) == _TABLE
        done = subprocess.run(
            one.command(
                sys.executable, "-m", "lifecycle.cli", "down", str(manifest), "--machine", "a"
            ),
            cwd=ROOT,
            env=one.environment(tmp_path / "a"),
            capture_output=True,
            text=True,
            timeout=_BOUND_S,
            check=False,
        )
        assert (done.returncode, done.stderr) == (ExitCode.OK, "")
        assert tables(one) == ""


def test_without_the_privilege_nothing_is_activated_and_the_run_says_which_is_missing(
    hosts: Hosts, tmp_path: Path, mapping: str
) -> None:
    one, other = hosts.bridged("A", "B")
    manifest = article(tmp_path, one.ipv4, other.ipv4, edit=_MARKED)
    with up_on(other, manifest, "--machine", "b", runtime=tmp_path / "b"):
        near = Up(
            manifest,
            *("--machine", "a", *_PROGRAM, mapping),
            runtime=tmp_path / "a",
            through=one.command("setpriv", "--bounding-set", "-net_admin", guarded=True),
            variables=one.environment(tmp_path / "a", {}),
        )
        try:
            assert near.finish() == ExitCode.BRING_UP_FAILED
        finally:
            near.close()
    (failure,) = near.of_kind("failure")
    assert failure["rule"] == "run.not-programmed"
    assert "needs CAP_NET_ADMIN in this network namespace" in failure["message"]
    assert not [each for each in near.of_kind("request") if each["operation"] == "activate"]
    assert tables(one) == ""
