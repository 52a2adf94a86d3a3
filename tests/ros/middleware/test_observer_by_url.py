"""What an observer with connection URLs sees of a participant of another process."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from free_ports import free_ports

from lifecycle.middleware.fastdds.sockets import open_sockets
from lifecycle.middleware.rcl.graph import GraphObserver
from lifecycle.plan.model import ParticipantConnections

pytestmark = pytest.mark.thorough

WaitUntil = Callable[..., None]


@contextlib.contextmanager
def remote(domain: int, url: str) -> Iterator[subprocess.Popen[str]]:
    """Have the other participant there; it leaves when its standard input is closed."""
    process = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("remote_participant.py")), str(domain), url],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "there\n"
        yield process
    finally:
        process.communicate(timeout=30)
    assert process.returncode == 0


def urls_of(how: str) -> tuple[str, str]:
    """Return the observer's URL and the other participant's."""
    one, other = free_ports(2)
    return {
        "shm": ("shm://", "shm://"),
        "tcp, the observer dials": (
            f"tcpv4://127.0.0.1:{one}?peer=127.0.0.1:{other}",
            f"tcpv4://127.0.0.1:{other}",
        ),
        "tcp, the observer is dialled": (
            f"tcpv4://127.0.0.1:{one}",
            f"tcpv4://127.0.0.1:{other}?peer=127.0.0.1:{one}",
        ),
    }[how]


@pytest.mark.parametrize("how", ["shm", "tcp, the observer dials", "tcp, the observer is dialled"])
@pytest.mark.parametrize("there_before", [True, False], ids=["there before", "there after"])
def test_an_observer_is_told_of_who_comes_and_who_leaves(
    fresh_domain: int, wait_until: WaitUntil, how: str, there_before: bool
) -> None:
    own, other = urls_of(how)
    before = {each.inode for each in open_sockets()}
    changes: list[None] = []
    with contextlib.ExitStack() as gone, contextlib.ExitStack() as left:
        if there_before:
            left.enter_context(remote(fresh_domain, other))
        observer = gone.enter_context(
            GraphObserver(fresh_domain, ParticipantConnections(urls=(own,)))
        )
        observer.on_change(lambda: changes.append(None))
        if not there_before:
            left.enter_context(remote(fresh_domain, other))

        def endpoints() -> list[str]:
            _, found = observer.snapshot(declared=("/_remote",))
            return [each.node for each in found if each.name == "/flow"]

        wait_until(lambda: endpoints() == ["/_remote"])
        kinds = {each.kind for each in open_sockets() if each.inode not in before}
        assert kinds == (set() if how == "shm" else {"tcpv4"})
        wait_until(lambda: changes or there_before)
        changes.clear()
        left.close()
        wait_until(lambda: endpoints() == [])
        wait_until(lambda: changes)


@pytest.mark.parametrize("dials", ["the observer", "who comes again"])
def test_a_tcp_peer_that_comes_again_is_seen_again(
    fresh_domain: int, wait_until: WaitUntil, dials: str
) -> None:
    """On the port it listened on, if it is dialled; one that dials must have let its port free."""
    one, other = free_ports(2)
    own, theirs = f"tcpv4://127.0.0.1:{one}", f"tcpv4://127.0.0.1:{other}"
    if dials == "the observer":
        own += f"?peer=127.0.0.1:{other}"
    else:
        theirs = f"tcpv4://127.0.0.1?peer=127.0.0.1:{one}"
    with GraphObserver(fresh_domain, ParticipantConnections(urls=(own,))) as observer:

        def gids() -> list[str]:
            _, found = observer.snapshot(declared=("/_remote",))
            return [each.gid for each in found if each.name == "/flow"]

        seen = []
        for _ in range(2):
            with remote(fresh_domain, theirs):
                wait_until(lambda: len(gids()) == 1)
                seen += gids()
            wait_until(lambda: gids() == [])
        assert len(set(seen)) == 2
