"""What somebody of the same user may write to a supervisor's control socket, or answer on one."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import socket
import threading
from collections.abc import Iterator, Sequence

from lifecycle.codec import to_json, to_plain
from lifecycle.manifest.loading import load
from lifecycle.plan.build import build_plan
from lifecycle.run_directory import connect
from lifecycle.supervisor.control.protocol import ControlRequest, Question, ask
from tests.hostile.attack import (
    Attack,
    Attacks,
    HostileClass,
    Place,
    Unhandled,
    check,
    check_text,
    in_process,
    mutated,
)
from tests.ros.supervisor.running import Up, pair

WAIT_S = 5.0


class Running:
    """A system, and its control socket."""

    def __init__(self, place: Place) -> None:
        self.folder = place.folder()
        self.manifest = pair(self.folder, place.domain)
        self.up = Up(self.manifest, runtime=self.folder)
        self.up.until("system", reached="active")
        (self.run,) = (self.folder / "lifecycle").iterdir()
        self.open: list[socket.socket] = []

    def connect(self) -> socket.socket:
        made = connect(self.run / "control", WAIT_S)
        self.open.append(made)
        return made

    def check(self) -> None:
        """Whoever asks properly is answered at once, whatever others sent before."""
        answer = ask(self.run / "control", Question(ask=ControlRequest.STATUS), WAIT_S)
        if answer is None or answer.status is None:
            raise Unhandled(f"no status any more: {answer}; {self.up.events[-2:]}")


@contextlib.contextmanager
def stage(place: Place, attacks: Sequence[Attack]) -> Iterator[Running]:
    del attacks
    system = Running(place)
    try:
        yield system
        for each in system.open:
            each.close()
        system.up.signal(signal.SIGINT)
        if system.up.finish() != 130:
            raise Unhandled(f"it ended with {system.up.process.returncode}")
        system.up.assert_nothing_left()
        check_text(system.up.said())
    finally:
        system.up.close()


def _sent(data: bytes, then: str, system: Running) -> None:
    made = system.connect()
    # A server that hangs up in the middle is in its right.
    with contextlib.suppress(OSError):
        made.sendall(data)
        if then == "hang up":
            made.shutdown(socket.SHUT_WR)
        elif then == "reset":
            made.close()
        elif then == "read":
            made.settimeout(0.2)
            made.recv(1 << 20)
    system.check()
    made.close()


def _crowd(system: Running) -> None:
    made = [system.connect() for _ in range(200)]
    system.check()
    for each in made:
        each.close()
    system.check()


def _followers_that_do_not_read(system: Running) -> None:
    for _ in range(40):
        system.connect().sendall(to_json(Question(ask=ControlRequest.LOOK)) * 1 + b"\n")
    system.check()


def _other_plan(change: str, verb: str, system: Running) -> None:
    """A plan that fits the types and is none: keys that nobody has, numbers out of range."""
    plain = to_plain(build_plan(load(system.manifest).manifest))
    assert isinstance(plain, dict)
    plan = json.loads(json.dumps(plain))
    if change == "no nodes":
        plan["nodes"] = []
    elif change == "a node that is none":
        plan["processes"][0]["nodes"] = ["nobody"]
    elif change == "levels of nobody":
        plan["levels"] = [["nobody"]]
    elif change == "flows of nobody":
        plan["flows"][0]["publisher"] = "nobody"
    elif change == "domain 9999":
        plan["domain_id"] = 9999
    elif change == "names of a terminal":
        plan["nodes"][0]["name"] = "\x1b[2J\nok"
    elif change == "twice the same":
        plan["nodes"] *= 2
    question = {"ask": verb, "node": "", "plan": plan, "dry_run": True}
    _sent(json.dumps(question).encode() + b"\n", "read", system)


def _ordered(node: str, system: Running) -> None:
    question = Question(ask=ControlRequest.RESTART, node=node)
    answer = ask(system.run / "control", question, 10.0)
    if answer is None or answer.exit_code in {None, 0, 70} or not answer.error:
        raise Unhandled(f"restart of {node!r}: {answer}")
    system.check()


def _answered(data: bytes | None, place_verb: str, system: Running) -> None:
    """Somebody else listens where a supervisor should, and answers with anything."""
    folder = system.folder / f"other{os.urandom(3).hex()}"
    run = folder / "lifecycle" / "fake@7"
    run.mkdir(mode=0o700, parents=True)
    (folder / "lifecycle").chmod(0o700)
    import fcntl

    lock = os.open(run / "lock", os.O_RDWR | os.O_CREAT, 0o600)
    fcntl.flock(lock, fcntl.LOCK_EX)
    server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    here = os.open(run, os.O_PATH)
    server.bind(f"/proc/self/fd/{here}/control")
    server.listen()
    over = threading.Event()

    def serve() -> None:
        with contextlib.suppress(OSError):
            while not over.is_set():
                taken, _ = server.accept()
                with taken, contextlib.suppress(OSError):
                    taken.recv(1 << 16)
                    if data is None:
                        over.wait(30.0)
                    else:
                        taken.sendall(data)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    words = (place_verb, "fake", *(() if place_verb == "status" else ("--timeout", "1")))
    try:
        check(in_process(*words, variables={"XDG_RUNTIME_DIR": str(folder)}, limit_s=12.0))
    finally:
        over.set()
        with contextlib.suppress(OSError):
            server.shutdown(socket.SHUT_RDWR)
        server.close()
        os.close(lock)
        os.close(here)


ANSWERED: dict[str, bytes | None] = {
    "nothing": b"",
    "silence": None,
    "noise": b"\xff\xfe\0\n",
    "half": b'{"status":',
    "a number": b"7\n",
    "null": b"null\n",
    "an empty object": b"{}\n",
    "deep": b"[" * 100_000 + b"\n",
    "a wrong status": b'{"status":{"system":7}}\n',
    "an exit code of 70": b'{"exit_code":70,"error":"\\u001b[2Jx"}\n',
    "an exit code beyond": b'{"exit_code":99999999999999999999}\n',
    "an error of a terminal": b'{"exit_code":2,"error":"\\u001b[2J\\u202e"}\n',
    "no end": b"x" * 3_000_000,
}


def attacks(rng: random.Random) -> list[Attack]:
    found = Attacks()
    add = found.add
    good = to_json(Question(ask=ControlRequest.STATUS)) + b"\n"
    for number in range(40):
        then = rng.choice(("hang up", "reset", "read", "stay"))
        add(f"question changed {number}, {then}", _sent, mutated(good, rng), then)
    for name, data in {
        "nothing": b"",
        "noise": rng.randbytes(5000),
        "newlines": b"\n" * 10_000,
        "deep": b"[" * 1_000_000 + b"\n",
        "half a question": good[:-5],
        "a thousand questions": good * 1000,
        "no newline": b"x" * 1_000_000,
        "HTTP": b"GET / HTTP/1.1\r\nHost: x\r\n\r\n",
        "an unknown ask": b'{"ask":"reboot"}\n',
        "a plan that is none": b'{"ask":"restart","plan":{"nodes":7}}\n',
    }.items():
        for then in ("hang up", "read"):
            add(f"{name}, {then}", _sent, data, then)
    for change in (
        *("no nodes", "a node that is none", "levels of nobody", "flows of nobody"),
        *("domain 9999", "names of a terminal", "twice the same"),
    ):
        add(f"status, {change}", _other_plan, change, "status")
        add(f"apply, {change}", _other_plan, change, "apply")
    for node in ("nobody", "", "\x1b[2J", "/" * 5000, "talker\n"):
        if node:
            add(f"restart of {node[:20]!r}", _ordered, node)
    add("a crowd", _crowd)
    add("followers that do not read", _followers_that_do_not_read)
    for name, answer in ANSWERED.items():
        for verb in ("status", "down", "pause"):
            add(f"{verb} is answered with {name}", _answered, answer, verb)
    return found


CLASS = HostileClass(name="control", attacks=attacks, stage=stage)
