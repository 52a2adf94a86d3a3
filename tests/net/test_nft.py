"""The owned nftables table in real network namespaces: present, idempotent, marking, removed."""

from __future__ import annotations

import dataclasses
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from lifecycle.programming.host import HostTool
from lifecycle.programming.ledger import Ledger
from lifecycle.programming.nft import NftTarget
from lifecycle.programming.rules import FlowRule
from lifecycle.programming.target import ChangeKind, Means, ProgrammingError
from tests.net.hosts import Host
from tests.unit.programming.fakes import Waited
from tests.unit.programming.samples import ledger_in, rule

pytestmark = pytest.mark.skipif(shutil.which("nft") is None, reason="nft is not installed")

IP_RECVTOS = 13  # linux/in.h
FOREIGN = "table inet theirs {\n\tchain c {\n\t\tcounter packets 0 bytes 0\n\t}\n}\n"


@dataclasses.dataclass
class Bench:
    """Two hosts on one switch, the first one programmed."""

    one: Host
    other: Host
    ledger: Ledger
    target: Waited

    def tables(self) -> list[str]:
        return self.one.run("nft", "list", "tables").split("\n")[:-1]

    def send(self, *, port: int) -> int:
        """Send one datagram from `port` to the other host; return the TOS byte that arrives."""
        address = (self.other.ipv4, 17910)
        with (
            self.other.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
            self.one.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        ):
            receiver.setsockopt(socket.IPPROTO_IP, IP_RECVTOS, 1)
            receiver.settimeout(30)
            receiver.bind(address)
            sender.bind(("", port))
            sender.sendto(b"x", address)
            _, ancillary, _, _ = receiver.recvmsg(16, 64)
        return ancillary[0][2][0]


@pytest.fixture
def bench(switched: tuple[Host, Host], tmp_path: Path) -> Iterator[Bench]:
    """The hosts, without any table."""
    one, other = switched
    ledger = ledger_in(tmp_path)
    yield Bench(one, other, ledger, Waited(NftTarget(None, Means(ledger), HostTool(one.command()))))
    one.run("nft", "flush", "ruleset")


def flow(bench: Bench, *, port: int = 17900, dscp: int = 46, **ends: str) -> FlowRule:
    """A rule from one host to the other."""
    every = {"source": bench.one.ipv4, "destination": bench.other.ipv4, **ends}
    return rule("/video", port, dscp=dscp, five_qi=None, **every)


def test_the_table_is_there_marked_as_ours_and_a_second_apply_writes_nothing(bench: Bench) -> None:
    bench.target.apply([flow(bench)])
    handle = bench.one.run("nft", "-a", "list", "table", "inet", "flowqos_robot")

    again = bench.target.apply([flow(bench)])

    assert [each.kind for each in again.changes] == [ChangeKind.KEEP]
    # Handles count up with each object that is made: equal ones are the same objects.
    assert bench.one.run("nft", "-a", "list", "table", "inet", "flowqos_robot") == handle
    assert 'comment "managed-by=lifecycle"' in handle


def test_tables_of_others_are_untouched_and_only_ours_is_removed(bench: Bench) -> None:
    bench.one.run("nft", "-f", "-", stdin=FOREIGN)

    bench.target.apply([flow(bench)])
    assert bench.tables() == ["table inet theirs", "table inet flowqos_robot"]
    bench.target.remove()

    assert bench.one.run("nft", "list", "ruleset") == FOREIGN
    assert bench.ledger.read().targets == ()


def test_a_verified_flow_is_marked_on_the_wire_and_counted_and_others_are_not(
    bench: Bench,
) -> None:
    bench.target.apply([flow(bench)])

    assert bench.send(port=17900) == 0xB8
    assert bench.send(port=17901) == 0
    listing = bench.one.run("nft", "list", "table", "inet", "flowqos_robot")
    assert "ip dscp set ef counter packets 1 bytes 29" in listing


def test_a_rule_without_source_address_matches_port_and_destination(bench: Bench) -> None:
    bench.target.apply([flow(bench, source="")])

    assert bench.send(port=17900) == 0xB8
    assert bench.send(port=17901) == 0


def test_a_port_that_changed_after_a_restart_is_marked_and_the_old_one_no_more(
    bench: Bench,
) -> None:
    bench.target.apply([flow(bench, port=17900)])

    changes = bench.target.apply([flow(bench, port=18000)])

    assert [each.kind for each in changes.changes] == [ChangeKind.UPDATE]
    assert (bench.send(port=17900), bench.send(port=18000)) == (0, 0xB8)


def test_a_table_that_is_gone_is_made_again(bench: Bench) -> None:
    bench.target.apply([flow(bench)])
    bench.one.run("nft", "flush", "ruleset")

    (change,) = bench.target.apply([flow(bench)]).changes

    assert (change.kind, change.detail) == (ChangeKind.CREATE, "it was gone")


def test_packets_that_were_counted_are_no_change(bench: Bench) -> None:
    bench.target.apply([flow(bench)])
    bench.send(port=17900)

    assert not bench.target.plan([flow(bench)]).pending


def test_a_table_of_this_name_that_is_not_ours_is_refused_and_stays(bench: Bench) -> None:
    theirs = FOREIGN.replace("theirs", "flowqos_robot")
    bench.one.run("nft", "-f", "-", stdin=theirs)

    with pytest.raises(ProgrammingError) as caught:
        bench.target.apply([flow(bench)])
    assert str(caught.value) == (
        "cannot use nft table inet flowqos_robot: it exists and is not marked as managed by "
        "lifecycle; look at it: nft list table inet flowqos_robot"
    )
    assert bench.target.remove().changes == ()
    assert bench.one.run("nft", "list", "ruleset") == theirs


def test_no_flow_to_mark_means_no_table(bench: Bench) -> None:
    bench.target.apply([flow(bench)])

    changes = bench.target.apply([rule(dscp=None)])

    assert [each.kind for each in changes.changes] == [ChangeKind.DELETE]
    assert changes.left_out == (
        "/video /camera → /viewer: it has no DSCP and no flow label to set",
    )
    assert bench.tables() == []


def test_a_plan_writes_nothing(bench: Bench) -> None:
    assert bench.target.plan([flow(bench)]).pending
    assert bench.tables() == []


def test_without_privilege_an_apply_says_what_it_needs(bench: Bench) -> None:
    nobody = ("setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "--")
    tool = HostTool(bench.one.command(*nobody))
    target = Waited(NftTarget(None, Means(bench.ledger), tool))

    with pytest.raises(ProgrammingError) as caught:
        target.apply([flow(bench)])

    assert str(caught.value) == (
        "cannot read nft table inet flowqos_robot: 'nft list table inet flowqos_robot' "
        "needs CAP_NET_ADMIN in this network namespace; run this command as root, or give it that "
        "capability: in a container --cap-add NET_ADMIN, in a systemd unit "
        "AmbientCapabilities=CAP_NET_ADMIN"
    )
