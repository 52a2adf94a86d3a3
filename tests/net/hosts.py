"""Several hosts on this one: network namespaces with interfaces, shared memory and identity.

Owns: making them, running programs and opening sockets in them, and their end. A host is held by
one process that ends when its standard input is closed, which the kernel does for us: whatever
kills this process, namespaces, interfaces, routes, rules and shared memory go with it, and nothing
has a name that could be left behind. Needs root, or `unshare -Ur`; `lacking` says what
else.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import signal
import socket
import subprocess
import threading
import time
import typing
import uuid
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from tests.installation import modules

_CLONE_NEWNET = 0x40000000  # linux/sched.h
_PROGRAMS = ("ip", "unshare", "nsenter", "setpriv")
_UNSHARE = ("unshare", "--net", "--mount", "sh", "-c")
_END_S = 30.0
_SETTLE_S = 30.0
_libc = ctypes.CDLL(None, use_errno=True)

_HOLD = """
mount --make-rprivate / &&
mount -t tmpfs tmpfs /dev/shm &&
mount -t sysfs sysfs /sys &&
echo 0 > /proc/sys/net/ipv6/conf/all/accept_dad &&
echo 0 > /proc/sys/net/ipv6/conf/default/accept_dad &&
ip link set lo up &&
echo held &&
exec cat
"""
"""cat(1) reads until we close the pipe or end. Duplicate address detection (RFC 4862) would keep
IPv6 addresses from being used for a second or two."""

T = typing.TypeVar("T")


def lacking() -> str:
    """Return why no host can be made here, in one line; empty if they can."""
    if os.geteuid() != 0:
        return "hosts are network namespaces: run as root, or where the kernel allows, unshare -Ur"
    absent = [each for each in _PROGRAMS if shutil.which(each) is None]
    if absent:
        return f"hosts need {', '.join(absent)}; install iproute2 and util-linux"
    # The whole of it, with nothing to read: a container may allow one part and refuse another.
    tried = subprocess.run(
        [*_UNSHARE, _HOLD], stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
    )
    return f"hosts cannot be made: {tried.stderr.strip()}" if tried.returncode else ""


class Host:
    """One host.

    Attributes:
        name: as the test calls it.
        addresses: its own, by interface.
        machine_id: what its nodes report as their machine.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.addresses: dict[str, list[str]] = {}
        self.machine_id = uuid.uuid4().hex
        self._started: list[subprocess.Popen[str]] = []
        self._holder = subprocess.Popen(
            [*_UNSHARE, _HOLD],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._holder.stdout is not None
        if self._holder.stdout.readline() != "held\n":
            self.close()
            raise OSError(f"cannot make host {name!r}")

    @property
    def pid(self) -> int:
        """Of the process that holds the namespaces."""
        return self._holder.pid

    @property
    def ipv4(self) -> str:
        """Its first IPv4 address."""
        return next(each for each in self._all() if ":" not in each)

    @property
    def ipv6(self) -> str:
        """Its first IPv6 address."""
        return next(each for each in self._all() if ":" in each)

    def command(self, *argv: str, guarded: bool = False) -> list[str]:
        """Return the command line that runs `argv` here, in the process that is started with it.

        It runs where tests and examples can be imported: entering a host leaves any directory.

        Args:
            guarded: the kernel sends it SIGTERM when the thread that started it ends.
        """
        guard = ["setpriv", "--pdeathsig", "TERM"] if guarded else []
        enter = ["nsenter", "-t", str(self.pid), "-n", "-m", "--"]
        return [*guard, *enter, "env", "-C", str(modules()), *argv]

    def environment(self, runtime: Path, base: Mapping[str, str] | None = None) -> dict[str, str]:
        """Return what sets a program of this host apart from one of another host.

        Args:
            runtime: a directory of the host's own; made if it is not there.
            base: what it otherwise gets; None for this process's environment.
        """
        runtime.mkdir(parents=True, exist_ok=True)
        return {
            **(os.environ if base is None else base),
            "LIFECYCLE_MACHINE_ID": self.machine_id,
            "XDG_RUNTIME_DIR": str(runtime),
            "ROS_LOG_DIR": str(runtime / "log"),
        }

    def popen(self, *argv: str, **options: typing.Any) -> subprocess.Popen[str]:
        """Start a program here; it is told to end if this thread ends first, and ends with us."""
        process = subprocess.Popen(self.command(*argv, guarded=True), text=True, **options)
        self._started.append(process)
        return process

    def run(self, *argv: str, check: bool = True, stdin: str | None = None) -> str:
        """Run a program here to its end and return what it wrote.

        Raises:
            OSError: it failed, and `check` is set.
        """
        done = subprocess.run(
            self.command(*argv), input=stdin, capture_output=True, text=True, check=False
        )
        if check and done.returncode != 0:
            raise OSError(f"{' '.join(argv)} on {self.name}: {done.stderr.strip()}")
        return done.stdout

    def ip(self, *arguments: str) -> str:
        """Run ip(8) here."""
        return self.run("ip", *arguments)

    def sysctl(self, name: str, value: object) -> None:
        """Set a network parameter, `net.ipv4.ip_forward`."""
        # /proc/sys/net shows the namespace of whoever opens it.
        path = Path("/proc/sys") / name.replace(".", "/")
        self.inside(lambda: path.write_text(str(value)))

    def inside(self, do: Callable[[], T]) -> T:
        """Return what `do` returns in a thread inside this host's network.

        A socket belongs for ever to the network it was made in, whoever uses it later.
        """
        result: list[T] = []
        failure: list[BaseException] = []

        def enter() -> None:
            try:
                self._enter()
                result.append(do())
            except BaseException as error:  # noqa: BLE001 - raised again where it is waited for
                failure.append(error)

        thread = threading.Thread(target=enter)
        thread.start()
        thread.join()
        if failure:
            raise failure[0]
        return result[0]

    def socket(self, family: int, kind: int, protocol: int = 0) -> socket.socket:
        """Open a socket of this host."""
        return self.inside(lambda: socket.socket(family, kind, protocol))

    def pids(self) -> list[int]:
        """Return every process of this host but the one that holds it."""
        own = self._network(self.pid)
        pids = (int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdigit())
        return sorted(pid for pid in pids if pid != self.pid and self._network(pid) == own)

    def settle(self) -> None:
        """Wait until every address may be used, the link-local ones too.

        Raises:
            TimeoutError: one may not.
        """
        deadline = time.monotonic() + _SETTLE_S
        while left := self.ip("-6", "-o", "addr", "show", "tentative"):
            if time.monotonic() > deadline:
                raise TimeoutError(f"addresses of {self.name} are still tentative: {left}")
            time.sleep(0.01)

    def close(self) -> None:
        """End every process of this host, and with the last one the host; again is harmless."""
        if self._holder.poll() is None:
            deadline = time.monotonic() + _END_S
            # Only what is in a network that we made: nobody else's process can be.
            while (pids := self.pids()) and time.monotonic() < deadline:
                for pid in pids:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
                time.sleep(0.01)
        for stream in (self._holder.stdin, self._holder.stdout):
            assert stream is not None
            stream.close()
        self._holder.wait(_END_S)
        # A test that failed has left them: what they hold would be held against the next one.
        for process in self._started:
            process.wait(_END_S)
            for pipe in (process.stdin, process.stdout, process.stderr):
                if pipe is not None:
                    with contextlib.suppress(BrokenPipeError):  # what nobody read
                        pipe.close()

    def _enter(self) -> None:
        """Take the calling thread, and it alone, into this host's network."""
        with Path(f"/proc/{self.pid}/ns/net").open("rb") as net:
            # os.setns is Python 3.12's.
            if _libc.setns(net.fileno(), _CLONE_NEWNET) != 0:
                raise OSError(ctypes.get_errno(), f"cannot enter host {self.name!r}")

    def _all(self) -> Iterator[str]:
        for addresses in self.addresses.values():
            yield from addresses

    @staticmethod
    def _network(pid: int) -> int:
        try:
            status = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
            if status.rpartition(")")[2].split()[0] in "ZX":
                return 0  # has left already, and only waits to be buried
            return Path(f"/proc/{pid}/ns/net").stat().st_ino
        except (FileNotFoundError, ProcessLookupError, PermissionError):
            return 0  # gone, or guarded: one of ours is neither


class Hosts:
    """Hosts made together and ended together; use it in a `with`."""

    def __init__(self) -> None:
        self._stack = contextlib.ExitStack()

    def host(self, name: str) -> Host:
        """Make a host with nothing but loopback."""
        host = Host(name)
        self._stack.callback(host.close)
        return host

    def bridged(self, *names: str, number: int = 77) -> tuple[Host, ...]:
        """Make hosts on one switch: `e0` is 10.N.0.1/24 and fdN::1/64 on the first, and so on."""
        switch = self.host("switch")
        # Without a querier, snooping would stop multicast after some minutes.
        switch.ip("link", "add", "br0", "type", "bridge", "mcast_snooping", "0")
        switch.ip("link", "set", "br0", "up")
        hosts = tuple(self.host(name) for name in names)
        for index, host in enumerate(hosts, 1):
            self.cable(host, "e0", switch, f"p{index}")
            switch.ip("link", "set", f"p{index}", "master", "br0")
            address(host, "e0", f"10.{number}.0.{index}/24", f"fd{number}::{index}/64")
        for host in hosts:
            host.settle()
        return hosts

    def routed(self, left: str, right: str, number: int = 78) -> tuple[Host, Host, Host]:
        """Make a host, a router and a host: `left` and `right` are the router's interfaces.

        The left one has 10.N.1.1 and fdN:1::1, the right one 10.N.2.1 and fdN:2::1.
        """
        router = self.host("router")
        ends = []
        for net, (name, port) in enumerate(((left, "left"), (right, "right")), 1):
            host = self.host(name)
            self.cable(host, "e0", router, port)
            prefix4, prefix6 = f"10.{number}.{net}", f"fd{number}:{net}:"
            address(host, "e0", f"{prefix4}.1/24", f"{prefix6}:1/64")
            address(router, port, f"{prefix4}.254/24", f"{prefix6}:254/64")
            host.ip("route", "add", "default", "via", f"{prefix4}.254")
            host.ip("-6", "route", "add", "default", "via", f"{prefix6}:254")
            ends.append(host)
        for host in (*ends, router):
            host.settle()
        router.sysctl("net.ipv4.ip_forward", 1)
        router.sysctl("net.ipv6.conf.all.forwarding", 1)
        return ends[0], router, ends[1]

    @staticmethod
    def cable(one: Host, interface: str, other: Host, port: str) -> None:
        """Join two hosts by a cable."""
        peer = ("peer", "name", port, "netns", str(other.pid))
        one.ip("link", "add", interface, "type", "veth", *peer)
        one.ip("link", "set", interface, "up")
        other.ip("link", "set", port, "up")

    def __enter__(self) -> Hosts:  # noqa: PYI034 - Self is Python 3.11's
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


def address(host: Host, interface: str, *addresses: str) -> None:
    """Give an interface addresses, `10.77.0.1/24`."""
    for each in addresses:
        nodad = ["nodad"] if ":" in each else []
        host.ip("addr", "add", each, "dev", interface, *nodad)
        host.addresses.setdefault(interface, []).append(each.partition("/")[0])
