"""Threads that leave unread what they receive, in processes of our own that play them."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import pytest

from lifecycle.middleware import Reception
from lifecycle.middleware.process import reception as module

_PLAYS = """
import ctypes, socket, sys, threading
receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
receiver.bind(("127.0.0.1", 0))
port = receiver.getsockname()[1]
locked = threading.Lock()
locked.acquire()

def play(how):
    ctypes.CDLL(None).prctl(15, f"dds.udp.{port}".encode(), 0, 0, 0)  # PR_SET_NAME
    while how == "reads":
        receiver.recv(100)
    if how == "late":
        sys.stdin.readline()
        receiver.recv(100)
    locked.acquire()

for how in sys.argv[1:]:
    threading.Thread(target=play, args=(how,), daemon=True).start()
print(port, flush=True)
locked.acquire()
"""

Play = Callable[..., tuple[subprocess.Popen[str], int]]


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "STUCK_S", 3.0)


@pytest.fixture
def play() -> Iterator[Play]:
    players = []

    def start(*how: str) -> tuple[subprocess.Popen[str], int]:
        words = [sys.executable, "-c", _PLAYS, *how]
        player = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        players.append(player)
        assert player.stdout is not None
        return player, int(player.stdout.readline())

    yield start
    for each in players:
        each.send_signal(signal.SIGCONT)
        each.kill()
        each.communicate()


def _send(port: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(b"hello", ("127.0.0.1", port))


def _deadlocked(reception: Reception, pid: int, within_s: float = 8.0) -> str:
    """Look again and again until a process is deadlocked; empty if it never is."""
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        if found := reception.deadlocked([pid]).get(pid, ""):
            return found
        time.sleep(0.2)
    return ""


def test_who_does_not_read_is_deaf_until_it_does(play: Play) -> None:
    player, port = play("late")
    _send(port)
    reception = Reception()
    assert f"UDP port {port}" in _deadlocked(reception, player.pid)
    assert player.stdin is not None
    player.stdin.write("\n")
    player.stdin.flush()
    deadline = time.monotonic() + 8.0
    while reception.deadlocked([player.pid]):
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize("how", [("reads",), ("locked", "reads"), ()])
def test_who_reads_or_is_no_thread_of_fast_dds_is_not_deadlocked(
    play: Play, how: tuple[str, ...]
) -> None:
    """Two threads may have one name: of a group's socket, and of an address."""
    player, port = play(*how)
    reception = Reception()
    deadline = time.monotonic() + 4.5
    while time.monotonic() < deadline:
        _send(port)
        assert reception.deadlocked([player.pid]) == {}
        time.sleep(0.05)


def test_who_was_stopped_is_not_deadlocked(play: Play) -> None:
    player, port = play("locked")
    _send(port)
    player.send_signal(signal.SIGSTOP)
    assert _deadlocked(Reception(), player.pid, within_s=4.5) == ""


def test_who_is_not_asked_for_or_gone_is_not_found(play: Play) -> None:
    player, port = play("locked")
    _send(port)
    reception = Reception()
    assert _deadlocked(reception, player.pid)
    assert reception.deadlocked([]) == {}
    player.kill()
    player.wait()
    assert reception.deadlocked([player.pid]) == {}
