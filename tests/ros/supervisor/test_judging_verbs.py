"""`lifecycle verify` and `flows` on a system that runs, and reports of runs that failed."""

from __future__ import annotations

import csv
import io
import json
import socket
import subprocess
from pathlib import Path

import pytest

from lifecycle.errors import ExitCode
from tests.ros.supervisor.running import ENOUGH, ROOT, command, environment, pair, up, verb

pytestmark = pytest.mark.thorough


def test_a_running_system_is_judged_from_outside(tmp_path: Path, fresh_domain: int) -> None:
    manifest = pair(tmp_path, fresh_domain)
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        judged = verb(
            "verify", str(manifest), *ENOUGH, "--format", "json", "--strict", runtime=tmp_path
        )
        assert (judged.returncode, judged.stderr) == (ExitCode.OK, "")
        assert json.loads(judged.stdout)["verdict"] == "ok"
        flows = verb("flows", "pair", "--format", "csv", runtime=tmp_path)
        assert flows.returncode == ExitCode.OK
        rows = list(csv.DictReader(io.StringIO(flows.stdout)))
        assert [(row["topic"], row["publisher"], row["subscription"]) for row in rows] == [
            ("/chatter", "/talker", "/listener")
        ]
        assert rows[0]["transport_protocol"] == "udp"
        assert rows[0]["outcome"] == "ok"

        other = pair(tmp_path, fresh_domain, edit={"nodes/third": _THIRD})
        missing = verb(
            "verify", str(other), "--format", "json", "--timeout", "0.5", runtime=tmp_path
        )
        assert missing.returncode == ExitCode.VIOLATED
        findings = json.loads(missing.stdout)["findings"]
        assert ("graph.missing-node", "/third") in {(e["rule"], e["subject"]) for e in findings}


def test_a_flow_over_ipv6_shows_its_3_tuple_and_that_no_label_is_set(
    tmp_path: Path, fresh_domain: int
) -> None:
    try:
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as probe:
            probe.bind(("::1", 0))
    except OSError as error:
        pytest.skip(f"this host has no IPv6: {error}")
    manifest = pair(tmp_path, fresh_domain, edit={"links": [{**_CHATTER, "transport": "udpv6"}]})
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        text, cells, document = (
            verb("flows", str(manifest), *ENOUGH, "--format", each, runtime=tmp_path)
            for each in ("text", "csv", "json")
        )
        judged = verb("verify", str(manifest), *ENOUGH, runtime=tmp_path)
    rows = list(csv.DictReader(io.StringIO(cells.stdout)))
    assert {(row["effective_transport"], row["flow_label"]) for row in rows} == {("udpv6", "unset")}
    (flow,) = json.loads(document.stdout)
    assert len(flow["tuples"]) == len(rows)
    for one, row in zip(flow["tuples"], rows, strict=True):
        source, destination = (
            f"[{one[f'{end}_address']}]:{one[f'{end}_port']}" for end in ("source", "destination")
        )
        assert (one["source_address"], one["flow_label"]) == (row["source_address"], 0)
        for shown in (text, judged):
            assert f"    udp {source} → {destination} flow_label unset\n" in shown.stdout


_CHATTER = {"topic": "/chatter", "from": "talker", "to": "listener"}
_THIRD = {"run": {"attach": True}, "managed": False}


def test_an_empty_graph_says_where_it_looked(tmp_path: Path, fresh_domain: int) -> None:
    manifest = pair(tmp_path, fresh_domain)
    judged = verb("verify", str(manifest), "--timeout", "0.2", runtime=tmp_path)
    assert judged.returncode == ExitCode.VIOLATED
    assert judged.stderr == (
        f"no node in the graph; looked in ROS domain {fresh_domain} with rmw_fastrtps_cpp, "
        "discovery range localhost\n"
    )
    # A system that is not there is not waited for where flows are only shown: who says for how long
    # to wait, as long as it would be by default, gets no answer before.
    with subprocess.Popen(
        [*command("flows"), str(manifest), "--timeout", "5"],
        cwd=ROOT,
        env=environment(tmp_path, ""),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as waits:
        shown = verb("flows", str(manifest), runtime=tmp_path)
        assert (shown.returncode, shown.stderr) == (ExitCode.VIOLATED, judged.stderr)
        assert waits.poll() is None, "--timeout 5 was over first, though both began together"
        waits.kill()
