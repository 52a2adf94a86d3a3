"""The network in memory: as bad as it is told to be, and the same for the same seed."""

from __future__ import annotations

import pytest

from lifecycle.graph import InMemoryNetwork, InMemoryTransport, ManualScheduler


def network(**options: object) -> tuple[ManualScheduler, InMemoryNetwork]:
    scheduler = ManualScheduler()
    return scheduler, InMemoryNetwork(scheduler, **options)  # type: ignore[arg-type]


def listening(net: InMemoryNetwork) -> tuple[InMemoryTransport, list[bytes]]:
    transport, heard = net.transport(), []
    transport.receive(heard.append)
    return transport, heard


def numbered(count: int) -> list[bytes]:
    return [str(number).encode() for number in range(count)]


def test_everybody_who_receives_hears_the_sender_too() -> None:
    _, net = network()
    (one, heard_by_one), (_, heard_by_other) = listening(net), listening(net)
    one.send(b"hello")
    assert heard_by_one == heard_by_other == [b"hello"]


def test_a_network_without_accidents_loses_and_reorders_nothing() -> None:
    scheduler, net = network(delay_s=(0.1, 0.1))
    _, heard = listening(net)
    sender = net.transport()
    for each in numbered(50):
        sender.send(each)
    assert heard == []
    scheduler.advance(0.1)
    assert heard == numbered(50)


def run(seed: int, **options: object) -> list[bytes]:
    scheduler, net = network(seed=seed, **options)
    _, heard = listening(net)
    sender = net.transport()
    for each in numbered(200):
        sender.send(each)
    scheduler.advance(10.0)
    return heard


def test_loss_duplication_and_reordering_happen_as_asked() -> None:
    lost = run(1, loss=0.3)
    assert 100 < len(lost) < 180
    assert lost == sorted(lost, key=int)
    doubled = run(1, duplication=0.3)
    assert set(doubled) == set(numbered(200))
    assert 220 < len(doubled) < 300
    reordered = run(1, delay_s=(0.0, 1.0))
    assert reordered != numbered(200)
    assert sorted(reordered, key=int) == numbered(200)


def test_the_same_seed_gives_the_same_run() -> None:
    options = {"loss": 0.3, "duplication": 0.3, "delay_s": (0.0, 1.0)}
    assert run(7, **options) == run(7, **options)
    assert run(7, **options) != run(8, **options)


def test_a_partition_parts_until_it_heals_and_then_peers_are_told() -> None:
    _, net = network()
    (one, heard_by_one), (other, heard_by_other) = listening(net), listening(net)
    peers: list[str] = []
    one.on_peer(lambda: peers.append("one"))
    remove = other.on_peer(lambda: peers.append("other"))
    net.partition([one])
    one.send(b"alone")
    other.send(b"likewise")
    assert (heard_by_one, heard_by_other, peers) == ([b"alone"], [b"likewise"], [])
    net.heal()
    assert peers == ["one", "other"]
    remove()
    net.heal()
    one.send(b"together")
    assert heard_by_other == [b"likewise", b"together"]
    assert peers == ["one", "other"]


def test_a_transport_that_closed_neither_hears_nor_sends() -> None:
    scheduler, net = network(delay_s=(0.1, 0.1))
    (closed, heard_by_closed), (other, heard_by_other) = listening(net), listening(net)
    other.send(b"under way")
    closed.close()
    closed.close()
    closed.send(b"too late")
    scheduler.advance(1.0)
    assert (heard_by_closed, heard_by_other) == ([], [b"under way"])


@pytest.mark.parametrize("receivers", [0, 3])
def test_a_new_receiver_is_a_peer_to_all_but_itself(receivers: int) -> None:
    _, net = network()
    told: list[int] = []
    for number, (transport, _) in enumerate([listening(net) for _ in range(receivers)]):
        transport.on_peer(lambda number=number: told.append(number))
    own = net.transport()
    own.on_peer(lambda: told.append(-1))
    own.receive(print)
    assert told == list(range(receivers))
