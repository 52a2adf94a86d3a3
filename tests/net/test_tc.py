"""The owned qdisc in real network namespaces: made, idempotent, queueing by flow, removed."""

from __future__ import annotations

import dataclasses
import re
import shutil
import socket
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from lifecycle.programming.host import HostTool, Output
from lifecycle.programming.ledger import Ledger
from lifecycle.programming.rules import FlowRule
from lifecycle.programming.target import ChangeKind, Means, ProgrammingError, TargetChanges
from lifecycle.programming.tc import TcSettings, TcTarget
from tests.net.hosts import Host
from tests.unit.programming.fakes import Waited
from tests.unit.programming.samples import ledger_in, rule

pytestmark = pytest.mark.skipif(
    not all(map(shutil.which, ("tc", "nft"))), reason="tc or nft is not installed"
)

EF, AF11, REST = "12e", "10a", "fff"
"""Minor numbers of the classes."""


@dataclasses.dataclass
class Bench:
    """Two hosts on one switch, and a device of the first one."""

    one: Host
    other: Host
    ledger: Ledger

    def target(self, device: str = "e0", **settings: object) -> Waited:
        chosen = TcSettings(device=device, **{"link_kbit": 20_000, **settings})
        return Waited(TcTarget(chosen, Means(self.ledger), HostTool(self.one.command())))

    def rule(
        self, topic: str = "/video", port: int = 17900, dscp: int = 46, **ends: str
    ) -> FlowRule:
        every = {"source": self.one.ipv4, "destination": self.other.ipv4, **ends}
        return rule(topic, port, dscp=dscp, five_qi=None, **every)

    def root(self) -> str:
        return self.one.run("tc", "qdisc", "show", "dev", "e0").partition(" root")[0]

    def sent(self, minor: str) -> int:
        """Packets that went through a class."""
        text = self.one.run("tc", "-s", "class", "show", "dev", "e0")
        found = re.search(rf"class htb 1f10:{minor} .*\n Sent \d+ bytes (\d+) pkt", text)
        return int(found[1]) if found else 0

    def classes(self) -> list[str]:
        text = self.one.run("tc", "class", "show", "dev", "e0")
        return sorted(re.findall(r"class htb 1f10:([0-9a-f]+) ", text))

    def send(self, *, port: int, count: int = 3, size: int = 1) -> None:
        """Send datagrams from `port`, and know that the device has them."""
        address = (self.other.ipv4, 17910)
        with (
            self.other.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
            self.one.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        ):
            receiver.settimeout(30)
            receiver.bind(address)
            sender.bind(("", port))
            for _ in range(count):
                sender.sendto(b"x" * size, address)
                receiver.recv(65536)


@pytest.fixture
def bench(switched: tuple[Host, Host], tmp_path: Path) -> Iterator[Bench]:
    """The hosts, their device as the kernel made it."""
    one, other = switched
    yield Bench(one, other, ledger_in(tmp_path))
    one.run("tc", "qdisc", "del", "dev", "e0", "root", check=False)
    one.run("nft", "flush", "ruleset")


def kinds(changes: TargetChanges) -> list[str]:
    return [each.kind.value for each in changes.changes]


def everything(host: Host) -> str:
    """All settings of tc and nft; not counts of packets, which the kernel's own raise."""
    shown = "".join(host.run("tc", kind, "show", "dev", "e0") for kind in ("qdisc", "class"))
    shown += host.run("nft", "list", "ruleset")
    return re.sub(r"direct_packets_stat \d+ |packets \d+ bytes \d+", "", shown)


def test_each_flow_has_its_queue_and_a_second_apply_changes_nothing(bench: Bench) -> None:
    rules = [bench.rule(), bench.rule("/lidar", 17901, dscp=10)]
    bench.target().apply(rules)
    before = everything(bench.one)

    again = bench.target().apply(rules)

    assert kinds(again) == ["keep", "keep"]
    assert everything(bench.one) == before
    assert bench.root() == "qdisc htb 1f10:"
    assert bench.classes() == ["1", AF11, EF, REST]


def test_every_fragment_of_a_datagram_goes_through_the_class_of_its_flow(bench: Bench) -> None:
    bench.target().apply([bench.rule()])

    bench.send(port=17900, count=1, size=5000)

    assert bench.sent(EF) == 4


def test_a_port_that_changed_moves_its_rule_and_drops_no_queue(bench: Bench) -> None:
    bench.target().apply([bench.rule(port=17900)])
    bench.send(port=17900)

    changes = bench.target().apply([bench.rule(port=18000)])
    bench.send(port=17900)
    bench.send(port=18000)

    assert kinds(changes) == ["update"]
    # The class and its counter have outlived the change.
    assert bench.sent(EF) == 6


def test_a_class_that_nothing_needs_any_more_is_deleted_with_its_rule(bench: Bench) -> None:
    bench.target().apply([bench.rule(), bench.rule("/lidar", 17901, dscp=10)])

    changes = bench.target().apply([bench.rule()])

    assert "delete" in kinds(changes)
    assert bench.classes() == ["1", EF, REST]
    bench.send(port=17901)
    assert bench.sent(EF) == 0
    assert kinds(bench.target().plan([bench.rule()])) == ["keep"]


def test_a_rate_that_changed_is_a_change(bench: Bench) -> None:
    bench.target(link_kbit=20_000).apply([bench.rule()])

    target = bench.target(link_kbit=10_000)
    changes = target.apply([bench.rule()])

    assert [(each.kind, each.detail) for each in changes.changes] == [
        (ChangeKind.UPDATE, "the classes change")
    ]
    assert "ceil 10Mbit" in bench.one.run("tc", "class", "show", "dev", "e0")
    assert not target.plan([bench.rule()]).pending


def test_a_qdisc_that_is_gone_is_made_again(bench: Bench) -> None:
    bench.target().apply([bench.rule()])
    bench.one.run("tc", "qdisc", "del", "dev", "e0", "root")

    (change,) = bench.target().apply([bench.rule()]).changes

    assert (change.kind, change.detail) == (ChangeKind.CREATE, "it was gone")
    assert bench.root() == "qdisc htb 1f10:"


def test_removal_leaves_the_device_as_the_kernel_made_it(bench: Bench) -> None:
    before = everything(bench.one)
    bench.target().apply([bench.rule()])

    changes = bench.target().remove()

    assert kinds(changes) == ["delete"]
    assert everything(bench.one) == before
    assert bench.ledger.read().targets == ()
    assert kinds(bench.target().remove()) == []


def test_a_root_qdisc_of_somebody_else_is_refused_and_stays(bench: Bench) -> None:
    bench.one.run("tc", "qdisc", "add", "dev", "e0", "root", "handle", "7:", "htb")
    before = everything(bench.one)

    with pytest.raises(ProgrammingError) as caught:
        bench.target().apply([bench.rule()])

    assert str(caught.value) == (
        "cannot use tc on e0: it has a root qdisc of another owner, htb 7:; "
        "use another device, or remove it: tc qdisc del dev e0 root"
    )
    assert kinds(bench.target().remove()) == []
    assert everything(bench.one) == before


def test_two_systems_do_not_share_a_device(bench: Bench, tmp_path: Path) -> None:
    bench.target().apply([bench.rule()])
    other = Bench(bench.one, bench.other, ledger_in(tmp_path, "arm"))

    with pytest.raises(ProgrammingError, match="made by lifecycle, but not for system 'arm'"):
        other.target().apply([bench.rule()])
    other.target().remove()

    assert bench.root() == "qdisc htb 1f10:"


def test_a_device_that_does_not_exist_is_one_clear_error(bench: Bench) -> None:
    with pytest.raises(ProgrammingError) as caught:
        bench.target("nope0").plan([bench.rule()])

    assert str(caught.value) == "cannot find device 'nope0' on this host; see: ip link"


@pytest.mark.parametrize(
    "without",
    [
        ("--reuid=65534", "--regid=65534", "--clear-groups"),
        # Root, as in a container that was not given it.
        ("--bounding-set=-net_admin", "--inh-caps=-net_admin"),
    ],
)
def test_without_privilege_one_line_says_what_is_needed(
    bench: Bench, without: tuple[str, ...]
) -> None:
    settings = TcSettings(device="e0", link_kbit=20_000)
    tool = HostTool(bench.one.command("setpriv", *without, "--"))
    target = Waited(TcTarget(settings, Means(bench.ledger), tool))

    # Looking needs no privilege.
    assert kinds(target.plan([bench.rule()])) == ["create"]
    with pytest.raises(ProgrammingError) as caught:
        target.apply([bench.rule()])

    assert str(caught.value) == (
        "cannot program tc on e0: 'tc -batch -' needs CAP_NET_ADMIN in this network namespace; "
        "run this command as root, or give it that capability: in a container --cap-add "
        "NET_ADMIN, in a systemd unit AmbientCapabilities=CAP_NET_ADMIN"
    )
    # Nothing was made, and nothing is listed that would have to be removed.
    assert bench.ledger.read().targets == ()


def test_each_class_has_a_queue_of_its_own_that_is_short(bench: Bench) -> None:
    bench.target(queue_ms=40).apply([bench.rule()])

    listed = bench.one.run("tc", "qdisc", "show", "dev", "e0")
    queues = re.findall(r"qdisc bfifo (\w+:) parent 1f10:(\w+) limit (\w+)", listed)

    # 40 ms of 20 Mbit/s: a bound on what waits, whatever the device's txqueuelen is.
    assert sorted(queues) == [("212e:", EF, "100000b"), ("2fff:", REST, "100000b")]
    assert kinds(bench.target(queue_ms=40).apply([bench.rule()])) == ["keep"]


def test_another_length_of_the_queues_is_a_change(bench: Bench) -> None:
    bench.target().apply([bench.rule()])
    assert "limit 125000b" in bench.one.run("tc", "qdisc", "show", "dev", "e0")

    changes = bench.target(queue_ms=100).apply([bench.rule()])

    assert [each.detail for each in changes.changes] == ["the classes change"]
    assert bench.one.run("tc", "qdisc", "show", "dev", "e0").count("limit 250000b") == 2


class StopsAt:
    """Runs the programs of a host, but for batches, which stop at a line as tc would."""

    def __init__(self, host: Host, line: str) -> None:
        self._tool = HostTool(host.command())
        self._line = line

    async def run(self, argv: Sequence[str], *, stdin: str = "") -> Output:
        broken = stdin.replace(self._line, f"{self._line} nonsense", 1)
        return await self._tool.run(argv, stdin=broken)


def test_a_batch_that_stops_half_way_is_taken_back_and_leaves_no_entry(bench: Bench) -> None:
    settings = TcSettings(device="e0", link_kbit=20_000)
    before = everything(bench.one)
    tool = StopsAt(bench.one, "parent 1f10:1 classid 1f10:fff htb")

    with pytest.raises(ProgrammingError, match="cannot program tc on e0"):
        Waited(TcTarget(settings, Means(bench.ledger), tool)).apply([bench.rule()])

    assert everything(bench.one) == before
    assert bench.ledger.read().targets == ()


@pytest.mark.parametrize("line", ["parent 1f10:1 classid 1f10:10a htb", "chain post {"])
def test_a_change_that_stops_half_way_leaves_nothing_and_is_made_the_next_time(
    bench: Bench, line: str
) -> None:
    settings = TcSettings(device="e0", link_kbit=20_000)
    before = everything(bench.one)
    bench.target().apply([bench.rule()])
    rules = [bench.rule(), bench.rule("/lidar", 17901, dscp=10)]

    with pytest.raises(ProgrammingError):
        Waited(TcTarget(settings, Means(bench.ledger), StopsAt(bench.one, line))).apply(rules)

    assert everything(bench.one) == before
    assert bench.ledger.read().targets == ()
    bench.target().apply(rules)
    assert bench.classes() == ["1", AF11, EF, REST]
