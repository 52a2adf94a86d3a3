"""What two hosts know of each other by a discovery server, when a link between them was cut."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from lifecycle.middleware.fastdds.discovery import (
    discovery_server_command,
    discovery_server_listens,
)
from lifecycle.plan.model import PlannedServer
from tests.net.hosts import Host, Hosts
from tests.net.nine_systems import DOMAIN
from tests.ros.supervisor.running import BOUND_S

_PORT = 8800


class _Participant:
    """A process on a host, see tests.net.announcing."""

    def __init__(self, host: Host, runtime: Path, url: str) -> None:
        self._process = host.popen(
            *(sys.executable, "-m", "tests.net.announcing", str(DOMAIN), url),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=host.environment(runtime),
        )
        self._answer()  # it is made

    def ask(self, order: str) -> int:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{order}\n")
        self._process.stdin.flush()
        return int(self._answer())

    def until_counts(self, topic: str) -> None:
        deadline = time.monotonic() + BOUND_S
        while not self.ask(f"count {topic}"):
            assert time.monotonic() < deadline, f"{topic} is not seen"
            time.sleep(0.01)

    def close(self) -> None:
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            stream.close()
        self._process.wait(BOUND_S)

    def _answer(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()


@contextlib.contextmanager
def _served(left: Host, right: Host, runtime: Path) -> Iterator[list[_Participant]]:
    """A participant on each host, by a discovery server on the left one."""
    server = PlannedServer(machine="left", address=left.ipv4, port=_PORT)
    argv, environment = discovery_server_command(server)
    running = left.popen(*argv, env={**os.environ, **environment}, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + BOUND_S
    while not discovery_server_listens(server, running.pid):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    with contextlib.ExitStack() as stack:
        stack.callback(running.wait, BOUND_S)
        stack.callback(running.terminate)

        def reaching(host: Host, port: int) -> _Participant:
            url = f"tcpv4://{host.ipv4}:{port}?server={left.ipv4}:{_PORT}"
            made = _Participant(host, runtime / str(port), url)
            stack.callback(made.close)
            return made

        yield [reaching(host, _PORT + 1 + index) for index, host in enumerate((left, right))]


def test_what_is_made_while_a_link_is_cut_is_seen_though_names_are_published_anew(
    hosts: Hosts, tmp_path: Path
) -> None:
    """Both reach the server together: it would tell of an end only, and of nothing before that."""
    left, right = hosts.bridged("left", "right")
    with _served(left, right, tmp_path) as (here, there):
        for number, one in enumerate((here, there)):
            one.ask(f"make /before_{number}")
            for each in (here, there):
                each.until_counts(f"/before_{number}")
        for number in range(5):
            left.ip("link", "set", "e0", "down")
            for each, topic in ((here, f"/here_{number}"), (there, f"/there_{number}")):
                assert each.ask(f"make {topic}") == 1
                each.ask("names")
            assert here.ask(f"count /there_{number}") == 0
            left.ip("link", "set", "e0", "up")
            there.until_counts(f"/here_{number}")
            here.until_counts(f"/there_{number}")
