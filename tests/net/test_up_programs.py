"""`lifecycle up --program nft`: its table is there exactly while the system is active."""

from __future__ import annotations

import re
import shutil
import signal
import socket
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import Any

import pytest

from lifecycle.errors import ExitCode
from tests.net.hosts import Host, Hosts
from tests.net.running import UNIQUE, article, up_on, verb_on
from tests.net.wire import Capture, Packet
from tests.ros.supervisor.running import Up

pytestmark = pytest.mark.skipif(shutil.which("nft") is None, reason="nft is not installed")

_TABLE = "table inet flowqos_article\n"
_BOUND_S = 60
_EF = 46
_LABELLED = re.compile(
    r"→ \[(?P<address>[0-9a-f:]+)\]:(?P<port>\d+), .*flow label (?P<label>0x[0-9a-f]{5})"
)
"""What `up` says of a rule, as `lifecycle flows apply --flow-labels` does."""

_ROUNDS = 4
"""Without the order that is asserted, one restart of three sends its first datagram unmarked."""

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
            assert f"udp dport {port} " in listing(one)
            far.signal(signal.SIGTERM)
            assert far.finish() == ExitCode.OK
        # The rule of a flow that is away for a moment harms nobody.
        assert f"udp dport {port} " in listing(one)

        with other.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
            taken.bind(("0.0.0.0", port))
            with up_on(other, manifest, "--machine", "b", runtime=tmp_path / "b") as far:
                assert "1 updated" in programmed(near, 2)
                assert f"udp dport {port} " not in listing(one)
                assert f"udp dport {video_port(near, other)} " in listing(one)
                far.until("system", reached="active")
                near.signal(signal.SIGINT)
                assert near.finish() == ExitCode.INTERRUPTED
    assert "1 deleted" in programmed(near, 3)
    assert tables(one) == ""
    assert not (tmp_path / "a" / "lifecycle" / "article@7.a" / "programmed.json").exists()
    near.assert_nothing_left()


def ask(host: Host, verb: str, manifest: Path, runtime: Path) -> None:
    """Run a verb that speaks to the supervisor of machine `a`, and see that it succeeds."""
    done = verb_on(host, verb, str(manifest), "--machine", "a", runtime=runtime)
    assert (done.returncode, done.stderr) == (ExitCode.OK, "")


def of_new_writers(wire: Capture, known: AbstractSet[bytes]) -> list[Packet]:
    """Return what writers of the video have sent that are not known yet."""
    return [each for each in wire.data("/video") if not known & set(each.writers)]


def test_after_every_restart_and_resume_the_first_datagram_is_marked_already(
    hosts: Hosts, tmp_path: Path, mapping: str
) -> None:
    one, other = hosts.bridged("A", "B")
    manifest = article(tmp_path, one.ipv4, other.ipv4, edit=_MARKED)
    options = ("--machine", "a", *_PROGRAM, mapping)
    known: set[bytes] = set()
    with (
        Capture(one) as wire,
        up_on(one, manifest, *options, runtime=tmp_path / "a") as near,
        up_on(other, manifest, "--machine", "b", runtime=tmp_path / "b") as far,
    ):
        for run in (near, far):
            run.until("system", reached="active")
        for round_ in range(_ROUNDS):
            known |= wire.writers("/video")
            begun = near.catch_up()
            if round_ % 2:
                ask(one, "pause", manifest, tmp_path / "a")
                ask(one, "restart", manifest, tmp_path / "a")
                ask(one, "resume", manifest, tmp_path / "a")
            else:
                ask(one, "restart", manifest, tmp_path / "a")
            wire.wait(lambda known=frozenset(known): len(of_new_writers(wire, known)) >= 5)
            marks = [each.dscp for each in of_new_writers(wire, known)]
            assert marks == [_EF] * len(marks), f"restart {round_}"
            near.met("system", since=begun, reached="active")
            said = [each.get("event") for each in near.events[begun:]]
            first = next(
                number
                for number, each in enumerate(near.events[begun:])
                if each.get("operation") == "activate"
            )
            assert "gate" in said[:first]
            assert any(
                each.get("message", "").startswith("nft table inet flowqos_article: ")
                for each in near.events[begun : begun + said.index("gate")]
            ), "the gate opened before the new flows had their rules"


def test_the_ipv6_flow_label_that_is_shown_is_on_the_wire(hosts: Hosts, tmp_path: Path) -> None:
    one, other = hosts.bridged("A", "B")
    marked = {"nodes/n1/flows": {"publishers": {"video": {"dscp": "EF"}}}}
    manifest = article(tmp_path, one.ipv6, other.ipv6, edit=marked)
    ipv6 = {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv6"}
    options = ("--machine", "a", "--program", "nft", "--flow-labels")
    with (
        Capture(one) as wire,
        up_on(one, manifest, *options, runtime=tmp_path / "a", variables=ipv6) as near,
        up_on(other, manifest, "--machine", "b", runtime=tmp_path / "b", variables=ipv6) as far,
    ):
        for run in (near, far):
            run.until("system", reached="active")
        wire.wait_data("/video", 10)
        packets = wire.data("/video")
        notice = programmed(near, 1)
        shown = {
            (each["address"], int(each["port"])): int(each["label"], 0)
            for each in _LABELLED.finditer(notice)
        }
        found = {(each.destination, each.destination_port): each.flow_label for each in packets}
        assert found.items() <= shown.items(), notice
        assert 0 not in shown.values()
        assert {each.dscp for each in packets} == {_EF}


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
        ask(one, "down", manifest, tmp_path / "a")
        assert tables(one) == ""


def test_an_ordinary_user_programs_by_an_ambient_capability_that_no_node_has(
    hosts: Hosts, tmp_path: Path, mapping: str
) -> None:
    one, other = hosts.bridged("A", "B")
    manifest = article(tmp_path, one.ipv4, other.ipv4, edit=_MARKED)
    # Besides the capability, those by which a user without a home reads this installation.
    capabilities = "+net_admin,+dac_read_search,+dac_override"
    user = ("--reuid", "54322", "--clear-groups", "--inh-caps", capabilities)
    with up_on(other, manifest, "--machine", "b", runtime=tmp_path / "b"):
        near = Up(
            manifest,
            *("--machine", "a", *_PROGRAM, mapping),
            runtime=tmp_path / "a",
            through=one.command("setpriv", *user, "--ambient-caps", capabilities, guarded=True),
            variables=one.environment(tmp_path / "a", {}),
        )
        try:
            near.until("system", reached="active")
            assert "dscp set ef" in listing(one)
            assert _may_administrate(near.process.pid)
            nodes = [each["pid"] for each in near.of_kind("process") if each.get("pid")]
            assert nodes
            assert not [pid for pid in nodes if _may_administrate(pid)]
            near.signal(signal.SIGTERM)
            assert near.finish() == ExitCode.OK
        finally:
            near.close()
    assert tables(one) == ""


def _may_administrate(pid: int) -> bool:
    status = Path(f"/proc/{pid}/status").read_text()
    sets = [int(each, 16) for each in re.findall(r"Cap(?:Inh|Prm|Eff|Amb):\t(\w+)", status)]
    assert len(sets) == 4
    return any(each >> 12 & 1 for each in sets)


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
