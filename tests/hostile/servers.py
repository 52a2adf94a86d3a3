"""NEF and CAMARA servers that answer with anything: adapters in this process, and the real command.

Under `up` a server that sends a byte now and then must not outlast a signal; `flows apply` and
`remove` have a bound of their own. The token must be in no node's environment.
"""

from __future__ import annotations

import json
import os
import random
import signal
import tempfile
import time
from pathlib import Path
from typing import Any

from lifecycle.programming.target import PartlyError
from tests.hostile.attack import (
    Attack,
    Attacks,
    Done,
    HostileClass,
    Place,
    Unhandled,
    check,
    ended,
    mutated,
    started,
)
from tests.ros.supervisor.running import Up, marked, pair
from tests.unit.programming.samples import nef_settings, rule, settings_file
from tests.unit.programming.servers import TOKEN
from tests.unit.programming.test_hostile_servers import (
    SESSION,
    Behave,
    HostileServer,
    answers,
    drips,
    floods,
    sends,
    target_at,
)

QUICK_S = 8.0
APPLY_S = 90.0
"""Five attempts and 60 s are promised; the rest is looking at the system first."""

END_S = 20.0
"""Servers have 10 s when a system ends; the rest is the system's own."""

_GOOD = {
    "nef": b"HTTP/1.1 201 Created\r\ncontent-type: application/json\r\nlocation: /subscriptions/1"
    b'\r\ncontent-length: 40\r\n\r\n{"self":"/subscriptions/1","flowInfo":[]}',
    "camara": b"HTTP/1.1 201 Created\r\ncontent-type: application/json\r\ncontent-length: 64\r\n"
    b"\r\n" + json.dumps(SESSION).encode(),
}

SLOW: dict[str, Behave] = {
    "drips its status": drips(b"HTTP/1.1 201 "),
    "drips its body": drips(b"HTTP/1.1 201 Created\r\ncontent-length: 9999\r\n\r\n"),
    "never ends its headers": floods(b"HTTP/1.1 200 OK\r\n", b""),
}


def _adapter(kind: str, behave: Behave, place: Place) -> None:
    del place
    os.environ["TEST_TOKEN"] = TOKEN
    with tempfile.TemporaryDirectory() as folder, HostileServer(behave) as server:
        began_s = time.monotonic()
        with target_at(Path(folder), kind, server) as (target, _):
            try:
                target.apply([rule()])
            except PartlyError as error:
                said = str(error)
                if TOKEN in said or len(said) > 1000 or len(said.splitlines()) != 2:
                    raise Unhandled(repr(said[:600])) from error
                if not all(each.isprintable() for each in said.splitlines()):
                    raise Unhandled(repr(said[:600])) from error
        if (took_s := time.monotonic() - began_s) > QUICK_S:
            raise Unhandled(f"it took {took_s:.1f} s")


def _system(place: Place, folder: Path, **edit: Any) -> Path:
    needs = {
        "machines": {"robot": {"address": os.environ["HOSTILE_HOST"]}},
        "nodes/talker/machine": "robot",
        "nodes/listener/machine": "robot",
        "discovery/range": "subnet",
        "nodes/talker/flows": {"publishers": {"chatter": {"five_qi": 85, "transport": "network"}}},
        **edit,
    }
    return pair(folder, place.domain, edit=needs)


def _config(folder: Path, url: str, timeout_s: float) -> str:
    settings = nef_settings(url, devices=["0.0.0.0/0"], timeout_s=timeout_s)
    return settings_file(folder, nef=settings)


def _up(slow: Behave, number: int, place: Place) -> None:
    folder = place.folder()
    with HostileServer(slow) as server:
        config = _config(folder, server.url, 60.0)
        words = ("up", str(_system(place, folder)), "--program", "nef", "--config", config)
        with started(
            *words, "--timeout", "60", runtime=folder, variables={"TEST_TOKEN": TOKEN}
        ) as (process, mark):
            if not server.came.wait(40.0):
                process.kill()
                raise Unhandled(f"the server was never asked: {process.communicate(timeout=5)}")
            _check_no_token(mark, process.pid)
            process.send_signal(number)
            done = ended_with_ledger(process, mark, folder)
        check(done)
        if TOKEN in done.out + done.err:
            raise Unhandled("it shows the token")


def ended_with_ledger(process: Any, mark: str, folder: Path) -> Any:
    """Wait for the end; what a server never acknowledged may stay listed, and nothing else."""
    try:
        return ended(process, mark, folder, limit_s=END_S)
    except Unhandled as error:
        left = {each.name for each in (folder / "lifecycle").rglob("*") if each.is_file()}
        if not str(error).startswith("it left [") or left - {"programmed.json", "programmed.lock"}:
            raise
        out, err = process.communicate()
        return Done(code=process.returncode, out=out.decode(), err=err.decode())


def _check_no_token(mark: str, supervisor: int) -> None:
    others = [each for each in marked(mark) if each.pid != supervisor]
    if not others:
        raise Unhandled("no process of the system was found")
    for each in others:
        if TOKEN.encode() in Path(f"/proc/{each.pid}/environ").read_bytes():
            raise Unhandled(f"the token is in the environment of {each}")


def _applied(slow: Behave, place: Place) -> None:
    folder = place.folder()
    manifest = _system(place, folder)
    run = Up(manifest, runtime=folder)
    try:
        run.until("system", reached="active")
        with HostileServer(slow) as server:
            config = _config(folder, server.url, 5.0)
            words = ("flows", "apply", str(manifest), "--target", "nef", "--config", config)
            for each in (words, ("flows", "remove", str(manifest))):
                began_s = time.monotonic()
                with started(*each, runtime=folder, variables={"TEST_TOKEN": TOKEN}) as (verb, _):
                    out, err = verb.communicate(timeout=APPLY_S)
                check(Done(code=verb.returncode, out=out.decode(), err=err.decode()))
                if time.monotonic() - began_s > APPLY_S:
                    raise Unhandled(f"{each[1]} took {time.monotonic() - began_s:.0f} s")
            if not server.asked:
                raise Unhandled(f"the server was never asked: {err.decode()}")
        run.signal(signal.SIGINT)
        run.finish()
    finally:
        run.close()


def attacks(rng: random.Random) -> list[Attack]:
    found = Attacks()
    add = found.add
    for index in range(60):
        kind = rng.choice(("nef", "camara"))
        data = mutated(_GOOD[kind], rng)
        add(f"{kind} changed {index}", _adapter, kind, sends(data))
    for index in range(40):
        body = mutated(json.dumps(SESSION).encode(), rng)
        add(f"session changed {index}", _adapter, "camara", answers(body))
    if "HOSTILE_HOST" not in os.environ:
        return found  # a flow within a machine concerns no mobile network
    # The long ones last.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        add(f"up and {number.name}: the server drips", _up, SLOW["drips its status"], number)
    add("up and SIGINT: its body drips", _up, SLOW["drips its body"], signal.SIGINT)
    add("flows apply and remove: the server drips", _applied, SLOW["drips its status"])
    return found


CLASS = HostileClass(name="servers", attacks=attacks, limit_s=420.0, has_host=True)
