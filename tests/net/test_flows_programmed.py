"""Verified flows of real DDS, programmed into a host's nftables and tc, and what the wire shows.

The publisher marks nothing itself: what arrives marked was marked by the rule.
"""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from lifecycle.errors import ExitCode
from tests.net.hosts import Hosts
from tests.net.running import UNIQUE, article, up_on_both, verb_on
from tests.net.wire import Capture, Packet
from tests.ros.supervisor.running import Up

_EF = 46
_BOUND_S = 60
_ENOUGH = 10
"""Packets of one flow."""

_ASKS: Mapping[str, Any] = {
    **UNIQUE,
    "nodes/n1/flows": {
        "publishers": {
            "video": {"unique": "strictly_required", "five_qi": 85},
            "battery": {"unique": "strictly_required"},
        }
    },
}


class Bench:
    """The article's example on two hosts, and `lifecycle flows` on the sender's."""

    def __init__(self, hosts: Hosts, directory: Path) -> None:
        self.one, self.other = hosts.bridged("A", "B")
        self.directory = directory
        self.manifest = article(directory, self.one.ipv4, self.other.ipv4, edit=_ASKS)
        mapping = {"name": "test", "source": "this test", "values": {"85": "EF"}}
        self.mapping = directory / "mapping.json"
        self.mapping.write_text(json.dumps(mapping))

    def flows(self, verb: str, *options: str) -> tuple[int, str]:
        """Run `lifecycle flows VERB`; return its exit code and what it printed."""
        words = ("flows", verb, str(self.manifest), *options)
        done = verb_on(self.one, *words, runtime=self.directory / "a")
        return done.returncode, done.stdout + done.stderr

    def ledger(self) -> list[str]:
        """The kinds of networks in which something of the system is listed."""
        files = list((self.directory / "a").rglob("programmed.json"))
        return [
            each["target"] for file in files for each in json.loads(file.read_text())["targets"]
        ]

    def up(self) -> Iterator[tuple[Up, Up]]:
        """Bring both hosts up until active; end them in order afterwards."""
        with up_on_both(self.one, self.other, self.manifest, runtime=self.directory) as ups:
            for each in ups:
                each.until("system", reached="active")
            yield ups
            for each in ups:
                each.signal(signal.SIGTERM)
            codes = [each.finish() for each in ups]
            assert codes == [ExitCode.OK, ExitCode.OK], [each.verdict for each in ups]

    def marks(self) -> tuple[set[int], set[int]]:
        """The DSCPs with which video and battery leave the host now."""
        # Announcements, which say whose data a packet has, come with every new reader; so flows
        # are told apart by the ports of the last verdict instead.
        with Capture(self.one) as wire:

            def sent_to(port: int) -> list[Packet]:
                sent = (each for each in wire.packets() if each.outgoing)
                return [each for each in sent if each.destination_port == port]

            ports = [self._port(topic) for topic in ("/video", "/battery")]
            wire.wait(lambda: all(len(sent_to(port)) >= _ENOUGH for port in ports))
            video, battery = ({each.dscp for each in sent_to(port)} for port in ports)
        return video, battery

    def queued(self, name: str) -> int:
        """Packets that went through a class until now."""
        lines = iter(self.one.run("tc", "-s", "class", "show", "dev", "e0").splitlines())
        for line in lines:
            if line.startswith(f"class htb {name} "):
                return int(next(lines).split()[3])
        return 0

    def _port(self, topic: str) -> int:
        (flow,) = [each for each in self._verdict["flows"] if each["topic"] == topic]
        return next(
            each["transport_port"]
            for each in flow["destination"]
            if each["internet_address"] == self.other.ipv4
        )

    def take(self, up: Up) -> None:
        """Remember where the flows are."""
        self._verdict = up.of_kind("verdict")[-1]["verdict"]


@pytest.fixture
def bench(hosts: Hosts, tmp_path: Path) -> Bench:
    """Two hosts with nothing running."""
    return Bench(hosts, tmp_path)


def test_flows_are_marked_by_the_rule_and_again_after_a_restart_and_no_more_after_removal(
    bench: Bench,
) -> None:
    nft = ("--target", "nft", "--dscp-from-5qi", str(bench.mapping))
    for ups in bench.up():
        bench.take(ups[0])
        assert bench.marks() == ({0}, {0})

        code, text = bench.flows("apply", *nft, "--dry-run")
        assert code == ExitCode.VIOLATED, text
        assert "1 to create, 0 unchanged" in text
        code, text = bench.flows("apply", *nft)
        assert code == ExitCode.OK, text
        assert "nft table inet flowqos_article: 1 created, 0 unchanged" in text
        assert bench.marks() == ({_EF}, {0})
        code, text = bench.flows("apply", *nft)
        assert (code, "1 unchanged" in text) == (ExitCode.OK, True), text

    for ups in bench.up():
        bench.take(ups[0])
        # A publisher's own participant sends from a port that the kernel chose anew.
        code, text = bench.flows("apply", *nft)
        assert code == ExitCode.OK, text
        assert "1 updated" in text
        assert bench.marks() == ({_EF}, {0})

        code, text = bench.flows("remove")
        assert code == ExitCode.OK, text
        assert "1 deleted" in text
        assert bench.marks() == ({0}, {0})
        assert bench.one.run("nft", "list", "tables") == ""


def test_flows_have_their_queue_by_their_5qi_unless_another_is_in_the_way(bench: Bench) -> None:
    tc = ("--target", "tc", "--device", "e0", "--rate", "20mbit")
    nft = ("--target", "nft", "--dscp-from-5qi", str(bench.mapping))
    for _ in bench.up():
        bench.one.run("tc", "qdisc", "add", "dev", "e0", "root", "handle", "7:", "htb")
        code, text = bench.flows("apply", *nft, *tc)
        assert code == ExitCode.BRING_UP_FAILED, text
        assert "cannot make 1 of 2 changes to targets:\n  cannot use tc on e0: " in text
        assert "\ndone all the same:\nnft table inet flowqos_article: 1 created, 0 unc" in text
        removal = f"\ntake back what was done: lifecycle flows remove {bench.manifest}\n"
        assert text.endswith(removal), text
        assert bench.ledger() == ["nft"]
        code, text = bench.flows("remove")
        assert (code, "1 deleted" in text) == (ExitCode.OK, True), text
        assert bench.ledger() == []
        bench.one.run("tc", "qdisc", "del", "dev", "e0", "root")

        code, text = bench.flows("apply", *tc)
        assert code == ExitCode.OK, text
        assert "tc on e0: 1 created, 0 unchanged" in text
        deadline = time.monotonic() + _BOUND_S
        while not bench.queued("1f10:255") or not bench.queued("1f10:fff"):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        bench.flows("remove")
        assert "noqueue" in bench.one.run("tc", "qdisc", "show", "dev", "e0")
