"""Runs one of the nine systems of manifests/ on one host or two, with everything captured.

Owns: `on_two_hosts`, `on_one_host` and `System`, what runs and what was seen of it. What a system
sent and opened is asked of packets and of the kernel, never of the product.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.installation import PYTHON, ROOT
from tests.net.hosts import Host, Hosts
from tests.net.running import up_on
from tests.net.sockets import Socket, ip_sockets
from tests.net.wire import Capture, Packet
from tests.ros.supervisor.contacts import TRIES, reaches_active
from tests.ros.supervisor.running import Event, Up

DOMAIN = 7
"""Nobody else is in a network of our own."""

CUT_S = 3.0
"""Long enough to be noticed and for everything that is sent meanwhile; the lease is 20 s."""

_MANIFESTS = ROOT / "manifests"
_SUFFIX = ".lifecycle.yaml"
_HELLO = b"hello "
_NEWS = b"news at last"


@dataclasses.dataclass(frozen=True, kw_only=True)
class System:
    """One of the nine, running.

    Attributes:
        hosts: by machine, `left` and `right`; one host is `left` alone.
        ups: its supervisors, likewise.
        outside: what passes a host's cable, likewise; nothing with one host.
        inside: what passes a host's loopback interface, likewise.
        directory: where the supervisors keep what they keep.
    """

    hosts: dict[str, Host]
    ups: dict[str, Up]
    outside: dict[str, Capture]
    inside: dict[str, Capture]
    directory: Path

    def until_active(self) -> None:
        """Wait until every supervisor has activated its own."""
        for up in self.ups.values():
            up.until("system", reached="active")

    def reaches_active(self) -> bool:
        """Like `until_active`; False if one ended because somebody was not heard, see contacts."""
        return all(reaches_active(up) for up in self.ups.values())

    def until_says(self, machine: str, process: str, line: str) -> None:
        """Wait until a process has said something; it may have been read already."""
        self.ups[machine].met("log", process=process, line=line)

    def until_event(self, machine: str, kind: str, **fields: object) -> Event:
        """Wait for an event of a supervisor; it may have been read already."""
        return self.ups[machine].met(kind, **fields)

    def sockets(self, machine: str, process: str) -> list[Socket]:
        """Return the IP sockets that a process has now."""
        return ip_sockets(self.ups[machine].pid_of(process))

    def hellos(self) -> list[Packet]:
        """Return every packet with the talker's data on any interface, each once, as sent."""
        return [each for each in self._sent() if _HELLO in each.payload]

    def until_said(self) -> None:
        """Wait until the talker's data is among the packets: they are read beside everything."""
        first = next(iter((*self.outside.values(), *self.inside.values())))
        first.wait(self.hellos)

    def news(self) -> list[Packet]:
        """Return every packet with data of endpoints that were made while running."""
        return [each for each in self._sent() if _NEWS in each.payload]

    def left_the_hosts(self) -> list[Packet]:
        """Return every packet that went out of a host."""
        return [each for wire in self.outside.values() for each in wire.packets() if each.outgoing]

    def start(self, machine: str, module: str) -> subprocess.Popen[str]:
        """Start a module in a process that the system knows nothing of; it ends with its host."""
        return self.hosts[machine].popen(
            *self._python(machine, PYTHON), "-m", module, stdout=subprocess.PIPE
        )

    def ask(self, machine: str, *words: str) -> list[str]:
        """Ask something over shared memory, see tests.net.asking; return the lines.

        It is this checkout that asks, whichever installation runs the system.
        """
        asking = ("-m", "tests.net.asking", str(DOMAIN), "shm://", *words)
        mine = self._python(machine, Path(sys.executable))
        return self.hosts[machine].run(*mine, *asking).splitlines()

    def cut(self, seconds: float = CUT_S) -> None:
        """Take the cable out for so long; both sides must notice, and be well again afterwards."""
        since = {name: up.catch_up() for name, up in self.ups.items()}
        others = dict(zip(self.ups, reversed(self.ups), strict=True))
        for name, other in others.items():
            self.ups[name].met("connection", machine=other, established=True)
        began = time.monotonic()
        self.hosts["left"].ip("link", "set", "e0", "down")
        for name, other in others.items():
            lost = {"machine": other, "established": False}
            self.ups[name].met("connection", since=since[name], **lost)
        time.sleep(max(0.0, seconds - (time.monotonic() - began)))  # the outage itself
        self.hosts["left"].ip("link", "set", "e0", "up")
        for name, other in others.items():
            found = {"machine": other, "established": True}
            self.ups[name].met("connection", since=since[name], **found)
        for up in self.ups.values():
            while up.of_kind("verdict")[-1]["verdict"]["verdict"] != "ok":
                up.until("verdict")

    def finish(self) -> None:
        """End all supervisors; each must end well, with its gate held and nothing left."""
        for up in self.ups.values():
            up.signal(signal.SIGTERM)
        codes = {name: up.finish() for name, up in self.ups.items()}
        said = {name: (up.verdict["run"], up.said()) for name, up in self.ups.items()}
        assert codes == dict.fromkeys(self.ups, 0), (codes, said)
        for up in self.ups.values():
            up.assert_gate_held()
            up.assert_nothing_left()

    def _python(self, machine: str, python: Path) -> list[str]:
        runtime = self.directory / f"{machine}-others"
        variables = {
            **self.hosts[machine].environment(runtime, {}),
            "ROS_DOMAIN_ID": str(DOMAIN),
            "PYTHONUNBUFFERED": "1",
        }
        return ["env", *(f"{name}={value}" for name, value in variables.items()), str(python)]

    def _sent(self) -> Iterator[Packet]:
        for wire in (*self.outside.values(), *self.inside.values()):
            yield from (each for each in wire.packets() if each.outgoing)


def edited(directory: Path, name: str, old: str, new: str) -> str:
    """Write one of the manifests with a text in it replaced; return what it is called here."""
    shipped = (_MANIFESTS / f"{name}{_SUFFIX}").read_text(encoding="utf-8")
    assert shipped.count(old) == 1
    changed = directory / f"{name}{_SUFFIX}"
    changed.write_text(shipped.replace(old, new), encoding="utf-8")
    return os.path.relpath(changed, _MANIFESTS).removesuffix(_SUFFIX)


@contextlib.contextmanager
def on_two_hosts(hosts: Hosts, name: str, directory: Path, *options: str) -> Iterator[System]:
    """Run `manifests/NAME.lifecycle.yaml` on two hosts on one switch."""
    left, right = hosts.bridged("left", "right")
    addresses = (f"left_address:={left.ipv4}", f"right_address:={right.ipv4}")
    with _running({"left": left, "right": right}, name, directory, *addresses, *options) as system:
        yield system


@contextlib.contextmanager
def on_two_hosts_by_tcp(
    hosts: Hosts, name: str, directory: Path, *options: str
) -> Iterator[System]:
    """Likewise, of a system whose hosts are connected by TCP; it is active then."""
    for number in range(TRIES):
        with on_two_hosts(hosts, name, directory / str(number), *options) as system:
            if system.reaches_active():
                yield system
                return
    pytest.fail(f"no first contact in {TRIES} tries")


@contextlib.contextmanager
def on_one_host(hosts: Hosts, name: str, directory: Path, *options: str) -> Iterator[System]:
    """Run `manifests/NAME.lifecycle.yaml` on a host that has nothing but loopback."""
    with _running({"left": hosts.host("left")}, name, directory, *options) as system:
        yield system


@contextlib.contextmanager
def _running(on: dict[str, Host], name: str, directory: Path, *options: str) -> Iterator[System]:
    manifest = _MANIFESTS / f"{name}{_SUFFIX}"
    with contextlib.ExitStack() as stack:
        # The captures are there before any process: nothing that is sent escapes them.
        inside = {each: stack.enter_context(Capture(host, "lo")) for each, host in on.items()}
        outside = {}
        if len(on) > 1:
            outside = {each: stack.enter_context(Capture(host)) for each, host in on.items()}
        ups = {}
        for machine, host in on.items():
            mine = ("--machine", machine) if len(on) > 1 else ()
            ups[machine] = stack.enter_context(
                up_on(
                    host,
                    manifest,
                    f"domain:={DOMAIN}",
                    *options,
                    *mine,
                    runtime=directory / machine,
                )
            )
        yield System(hosts=on, ups=ups, outside=outside, inside=inside, directory=directory)
