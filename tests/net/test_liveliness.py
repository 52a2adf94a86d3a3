"""Two hosts that lose each other: noticed and healed within a second, and no false alarm."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.net.hosts import Host, Hosts
from tests.net.nine_systems import on_two_hosts_by_tcp
from tests.net.running import DOMAIN, up_on_both
from tests.ros.supervisor.running import Up
from tests.stalls import TRIES, Stalls, assert_in_time, noted_stalls
from tests.unit.middleware.test_sockets import KNOWN

pytestmark = pytest.mark.alone

NODES = "benchmarks.liveliness_nodes"
WITHIN_S = 1.0
"""What is promised."""

BUSY_MACHINE_S = 0.5
"""For work that a busy machine takes longer for, beside the stalls that are noted."""

LIMIT_S = WITHIN_S + BUSY_MACHINE_S

TCP_LIMIT_S = LIMIT_S + 0.5
"""The kernel sends again each second, and no more often; then there is something to answer."""

LEASE_S = 2.0
"""Of the participants in the test of a long outage; Fast DDS's default is 20 s."""

LONG_S = 2 * LEASE_S
HANGS_S = 3.0
LOSS_S = 8.0
STOOD_STILL_S = 0.3
"""A machine that gives us nothing for so long may well look dead to others."""

LOSS_PERCENT = 30
LOSS = f"""table ip liveliness {{
  chain in {{
    type filter hook prerouting priority -300; policy accept;
    iifname "e0" numgen random mod 100 < {LOSS_PERCENT} counter drop
  }}
}}
"""
SHORT_LEASE = f"""<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
  <participant profile_name="short_lease" is_default_profile="true">
    <rtps><builtin><discovery_config>
      <leaseDuration><sec>{LEASE_S:g}</sec></leaseDuration>
      <leaseAnnouncement><sec>0</sec><nanosec>500000000</nanosec></leaseAnnouncement>
    </discovery_config></builtin></rtps>
  </participant>
</profiles></dds>
"""


def manifest(directory: Path, left: Host, right: Host) -> Path:
    """Write a system of two nodes on each machine, of which one hangs when told to."""
    file = directory / "apart.lifecycle.yaml"
    document: dict[str, Any] = {
        "manifest_version": 1,
        "system": "article",
        "discovery": {"domain_id": DOMAIN, "range": "subnet"},
        "machines": {"a": {"address": left.ipv4}, "b": {"address": right.ipv4}},
        "nodes": {
            f"{what}_{machine}": {
                "run": {
                    "python": f"{NODES}:{what.capitalize()}",
                    "environment": {"HANG_FILE": str(directory / f"hang_{machine}")},
                },
                "machine": machine,
            }
            for machine in ("a", "b")
            for what in ("hanging", "quiet")
        },
    }
    file.write_text(yaml.safe_dump(document))
    return file


@contextlib.contextmanager
def two_machines(
    hosts: Hosts, directory: Path, variables: dict[str, str] | None = None
) -> Iterator[tuple[Up, Up, Host, Host]]:
    """Yield both supervisors once they hear each other, and their hosts."""
    left, right = hosts.bridged("a", "b")
    file = manifest(directory, left, right)
    options = ("--keep-going",)
    with up_on_both(left, right, file, *options, runtime=directory, variables=variables) as (
        here,
        there,
    ):
        for each, other in ((here, "b"), (there, "a")):
            each.until("system", reached="active")
            if not [event for event in each.of_kind("connection") if event["established"]]:
                each.until("connection", machine=other, established=True)
        yield here, there, left, right


def names(running: Up, kind: str, since: int) -> list[str]:
    """Return the nodes of which something was said, after the first `since` events."""
    return [event["node"] for event in running.events[since:] if event.get("event") == kind]


@pytest.fixture
def stalls() -> Iterator[Stalls]:
    """What the machine loses during the test."""
    with noted_stalls() as stalls:
        yield stalls


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Outage:
    """An outage that both sides noticed.

    Attributes:
        noticed_s: after the cut, stalls of the machine not counted.
        healed_s: likewise after its end.
        ended: time of its end.
    """

    noticed_s: float
    healed_s: float
    ended: float


def outage(
    here: Up,
    there: Up,
    host: Host,
    seconds: float,
    stalls: Stalls,
    *,
    machine: str = "b",
    nodes: tuple[str, str] = ("/quiet_a", "/quiet_b"),
) -> Outage:
    """Cut the link for so long; each side must notice both, and that the other's node is lost."""
    at_first = (len(here.events), len(there.events))
    began = time.monotonic()
    host.ip("link", "set", "e0", "down")
    here.met("connection", since=at_first[0], machine=machine, established=False)
    here.met("silent", since=at_first[0], node=nodes[1], cause="lost")
    there.met("silent", since=at_first[1], node=nodes[0], cause="lost")
    noticed = time.monotonic()
    time.sleep(max(0.0, seconds - (noticed - began)))  # the outage itself
    ended = time.monotonic()
    host.ip("link", "set", "e0", "up")
    here.met("connection", since=at_first[0], machine=machine, established=True)
    here.met("alive", since=at_first[0], node=nodes[1])
    there.met("alive", since=at_first[1], node=nodes[0])
    healed_s = stalls.taken(ended, time.monotonic())
    return Outage(noticed_s=stalls.taken(began, noticed), healed_s=healed_s, ended=ended)


def until_ok(running: Up) -> float:
    """Read on until the verdict is ok, unless it is, and return when it was."""
    while running.of_kind("verdict")[-1]["verdict"]["verdict"] != "ok":
        running.until("verdict")
    return time.monotonic()


def test_a_cut_link_is_noticed_and_heals_within_a_second(
    hosts: Hosts, tmp_path: Path, stalls: Stalls
) -> None:
    with two_machines(hosts, tmp_path) as (here, there, left, _):

        def late_s() -> float:
            since = (len(here.events), len(there.events))
            cut = outage(here, there, left, 1.5, stalls)
            until_ok(here)
            until_ok(there)
            assert set(names(here, "silent", since[0])) == {"/hanging_b", "/quiet_b"}
            assert set(names(there, "silent", since[1])) == {"/hanging_a", "/quiet_a"}
            return max(cut.noticed_s, cut.healed_s) - LIMIT_S

        assert_in_time(late_s)


@pytest.mark.skipif(not KNOWN, reason="heals as late as the kernel's own pauses, see Linux 6.15")
def test_a_cut_tcp_link_is_noticed_and_heals_within_a_second(
    hosts: Hosts, tmp_path: Path, stalls: Stalls
) -> None:
    options = ("--keep-going",)
    with on_two_hosts_by_tcp(hosts, "client_server_master", tmp_path, *options) as system:
        here, there = system.ups["left"], system.ups["right"]
        here.met("connection", machine="right", established=True)
        there.met("connection", machine="left", established=True)

        def late_s() -> float:
            nodes = ("/talker", "/listener")
            # Left to itself the kernel would send again 12.6 s after the cut, and not before.
            cut = outage(
                *(here, there, system.hosts["left"], 7.0, stalls), machine="right", nodes=nodes
            )
            until_ok(here)
            until_ok(there)
            return max(cut.noticed_s - LIMIT_S, cut.healed_s - TCP_LIMIT_S)

        assert_in_time(late_s)
        system.finish()


def test_after_an_outage_longer_than_the_lease_names_are_in_the_graph_again(
    hosts: Hosts, tmp_path: Path, stalls: Stalls
) -> None:
    profile = tmp_path / "short_lease.xml"
    profile.write_text(SHORT_LEASE)
    variables = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(profile)}
    with two_machines(hosts, tmp_path, variables) as (here, there, left, _):

        def late_s() -> float:
            since = (len(here.events), len(there.events))
            cut = outage(here, there, left, LONG_S, stalls)
            ok = max(until_ok(here), until_ok(there))
            # They had left the graph, so this was more than a missed heartbeat.
            assert {"/hanging_b", "/quiet_b"} <= set(names(here, "left", since[0]))
            assert {"/hanging_a", "/quiet_a"} <= set(names(there, "left", since[1]))
            return max(
                cut.noticed_s - LIMIT_S,
                cut.healed_s - LIMIT_S,
                stalls.taken(cut.ended, ok) - 2 * LIMIT_S,
            )

        assert_in_time(late_s)


def test_loss_alarms_nobody(hosts: Hosts, tmp_path: Path, stalls: Stalls) -> None:
    with two_machines(hosts, tmp_path) as (here, there, left, right):
        for host in (left, right):
            host.run("nft", "-f", "-", stdin=LOSS)
        for _ in range(TRIES):
            at_first = (here.catch_up(), there.catch_up())
            began = time.monotonic()
            time.sleep(LOSS_S)  # the loss itself
            here.catch_up()
            there.catch_up()
            alarms = names(here, "silent", at_first[0]) + names(there, "silent", at_first[1])
            if not alarms:
                break
            # Only a machine that stood still may have alarmed anybody.
            assert stalls.longest(began, time.monotonic()) > STOOD_STILL_S, alarms
        for host in (left, right):
            counted = host.run("nft", "list", "table", "ip", "liveliness")
            assert int(counted.split("packets ")[1].split()[0]) > LOSS_S
            host.run("nft", "delete", "table", "ip", "liveliness")
        for running in (here, there):
            running.signal(signal.SIGINT)
            running.finish()
        for running, since in zip((here, there), at_first, strict=True):
            assert names(running, "silent", since) == []
            lost = [each for each in running.events[since:] if each.get("established") is False]
            assert len(lost) <= 1  # the other one's end


def test_a_hung_executor_is_known_on_the_other_host(
    hosts: Hosts, tmp_path: Path, stalls: Stalls
) -> None:
    with two_machines(hosts, tmp_path) as (here, there, _, _):

        def late_s(way: str) -> float:
            part = tmp_path / "part"
            part.write_text(f"{way} {HANGS_S}", encoding="ascii")
            began = time.monotonic()
            part.rename(tmp_path / "hang_a")
            there.until("silent", node="/hanging_a", cause="told")
            noticed_s = stalls.taken(began, time.monotonic())
            here.until("alive", node="/hanging_a")
            came_back = time.monotonic()
            there.until("alive", node="/hanging_a")
            healed_s = stalls.taken(came_back, time.monotonic())
            return max(noticed_s - LIMIT_S, healed_s - WITHIN_S)

        for way in ("sleep", "locked"):
            assert_in_time(functools.partial(late_s, way))


def test_a_killed_supervisor_is_lost_with_its_nodes(
    hosts: Hosts, tmp_path: Path, stalls: Stalls
) -> None:
    with two_machines(hosts, tmp_path) as (here, there, _, _):
        since = len(there.events)
        began = time.monotonic()
        here.signal(signal.SIGKILL)
        there.met("connection", since=since, machine="a", established=False)
        there.met("silent", since=since, node="/quiet_a", cause="lost")
        # A process dies once, so there is no second try.
        assert stalls.taken(began, time.monotonic()) <= 2 * LIMIT_S
        here.process.wait(10)
