"""What a host reports while its supervisor does not read."""

from __future__ import annotations

import socket
import threading

from lifecycle.codec import from_json
from lifecycle.node.host.control import Event, HostChannel


def read(theirs: socket.socket, until_id: int) -> list[Event]:
    """Read on until the reply with this id."""
    theirs.settimeout(10)
    data, events = b"", []
    while not events or events[-1].id != until_id:
        data += theirs.recv(1 << 16)
        *lines, data = data.split(b"\n")
        events += [from_json(each, Event) for each in lines]
    return events


def test_who_writes_never_waits_and_the_newest_arrives_in_order() -> None:
    ours, theirs = socket.socketpair()
    theirs.send(b"\n")
    channel = HostChannel(ours)
    before = threading.active_count()
    for number in range(20_000):
        channel.write(Event(kind="state", node=f"/n{number % 3}", state=str(number)))
        if number % 5000 == 0:
            channel.write(Event(kind="reply", node="/n0", id=number + 1))
    channel.write(Event(kind="reply", node="/n0", id=30_000))
    assert threading.active_count() <= before + 1
    events = read(theirs, 30_000)
    assert [each.id for each in events if each.kind == "reply"] == [1, 5001, 10_001, 15_001, 30_000]
    assert len(events) < 10_000
    for node in range(3):
        states = [int(each.state) for each in events if each.node == f"/n{node}" and each.state]
        assert states == sorted(states)
        assert states[-1] == max(each for each in range(20_000) if each % 3 == node)
    channel.drain()
    ours.close()
    theirs.close()


def test_a_supervisor_that_has_gone_holds_nobody_up() -> None:
    ours, theirs = socket.socketpair()
    theirs.send(b"\n")
    channel = HostChannel(ours)
    theirs.close()
    channel.write(Event(kind="ready"))
    channel.drain()
    ours.close()
