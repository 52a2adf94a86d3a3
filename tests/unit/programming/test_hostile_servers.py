"""Servers that answer with anything: one clear error each, no traceback, no wait past its bound."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import json
import re
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from lifecycle.errors import BringUpError
from lifecycle.programming.programmer import Programmer
from lifecycle.programming.target import Means, PartlyError, read_targets
from lifecycle.supervisor.connections.networks import Networks
from lifecycle.supervisor.run.events import Emitter, Notice
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Verdict
from tests.unit.programming.fakes import Waited
from tests.unit.programming.flow_samples import plan, report
from tests.unit.programming.samples import (
    camara_settings,
    ledger_in,
    nef_settings,
    rule,
    settings_file,
)
from tests.unit.programming.servers import TOKEN

_TIMEOUT_S = 1.0
_BOUND_S = 8.0
"""Far above what any of it takes, far below what a server that drips would take."""

Behave = Callable[[socket.socket, threading.Event], None]


class HostileServer:
    """Reads one request of each connection and then does as it likes; use it in a `with`.

    Attributes:
        asked: request lines and headers of every request.
        came: set by the first.
    """

    def __init__(self, behave: Behave) -> None:
        self.asked: list[str] = []
        self.came = threading.Event()
        self._behave = behave
        self._over = threading.Event()
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._threads = [threading.Thread(target=self._accept)]
        self.url = f"http://127.0.0.1:{self._listening.getsockname()[1]}"

    def __enter__(self) -> HostileServer:  # noqa: PYI034 - typing.Self is not in Python 3.10
        self._threads[0].start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        for each in self._threads:
            each.join(_BOUND_S)
            assert not each.is_alive()

    def _accept(self) -> None:
        while True:
            try:
                taken, _ = self._listening.accept()
            except OSError:
                return
            thread = threading.Thread(target=self._serve, args=(taken,))
            self._threads.append(thread)
            thread.start()

    def _serve(self, taken: socket.socket) -> None:
        with taken, contextlib.suppress(OSError):
            head = b""
            while b"\r\n\r\n" not in head:
                if not (read := taken.recv(65536)):
                    return
                head += read
            # What is left unread when a connection is closed resets it.
            head, _, body = head.partition(b"\r\n\r\n")
            found = re.search(rb"content-length: (\d+)", head, re.IGNORECASE)
            while len(body) < (int(found[1]) if found else 0):
                body += taken.recv(65536)
            self.asked.append(head.decode("latin-1"))
            self.came.set()
            self._behave(taken, self._over)


def sends(*parts: bytes) -> Behave:
    """Send it and close the connection."""

    def behave(taken: socket.socket, over: threading.Event) -> None:
        del over
        for each in parts:
            taken.sendall(each)

    return behave


def answers(body: object, status: str = "201 Created", **headers: str) -> Behave:
    """A well-formed answer."""
    data = body if isinstance(body, bytes) else json.dumps(body).encode()
    lines = "".join(f"{name.replace('_', '-')}: {value}\r\n" for name, value in headers.items())
    head = f"HTTP/1.1 {status}\r\ncontent-length: {len(data)}\r\n{lines}\r\n"
    return sends(head.encode("latin-1"), data)


def drips(begin: bytes) -> Behave:
    """Send a byte now and then, always in time for whoever waits for the next one only."""

    def behave(taken: socket.socket, over: threading.Event) -> None:
        taken.sendall(begin)
        while not over.wait(_TIMEOUT_S / 4):
            taken.sendall(b"x")

    return behave


def floods(begin: bytes, again: bytes) -> Behave:
    def behave(taken: socket.socket, over: threading.Event) -> None:
        taken.sendall(begin)
        while not over.is_set():
            taken.sendall(again)

    return behave


def _silent(taken: socket.socket, over: threading.Event) -> None:
    del taken
    over.wait()


def _resets(taken: socket.socket, over: threading.Event) -> None:
    del over
    taken.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


SESSION = {"sessionId": "s-1", "duration": 3600, "qosStatus": "AVAILABLE"}
BIG = int("9" * 401)
DEEP = b"[" * 200_000 + b"]" * 200_000


def session(**changed: object) -> Behave:
    return answers({**SESSION, **changed})


HOSTILE: dict[str, tuple[str, Behave, str]] = {
    "headers drip": ("camara", drips(b"HTTP/1.1 201 Created\r\nx-a: "), "no whole answer in time"),
    "a body drips": (
        "camara",
        drips(b"HTTP/1.1 201 Created\r\ncontent-length: 9999\r\n\r\n"),
        "no whole answer in time",
    ),
    "a chunked body drips": (
        "nef",
        drips(b"HTTP/1.1 201 Created\r\ntransfer-encoding: chunked\r\n\r\nfff\r\n"),
        "no whole answer in time",
    ),
    "silence": ("nef", _silent, "no whole answer in time"),
    "closed at once": ("nef", sends(), "Server disconnected"),
    "reset": ("nef", _resets, "cannot POST {url}/"),
    "no HTTP": ("camara", sends(b"\x00\xff\x16\x03\x01 hello\r\n\r\n"), "illegal status line"),
    "endless headers": (
        "camara",
        floods(b"HTTP/1.1 200 OK\r\n", b"x-a: b\r\n" * 999),
        "Receive buffer too long",
    ),
    "interim answers without end": (
        "camara",
        floods(b"", b"HTTP/1.1 103 Early Hints\r\n\r\n" * 50),
        "no whole answer in time",
    ),
    "a body shorter than said": (
        "camara",
        sends(b"HTTP/1.1 201 Created\r\ncontent-length: 99\r\n\r\n{}"),
        "peer closed connection",
    ),
    "a body without end": (
        "camara",
        floods(b"HTTP/1.1 201 Created\r\n\r\n", b" " * 65536),
        "characters of JSON; at most 4194304 are read",
    ),
    "gzip, which is not asked for": (
        "nef",
        answers(gzip.compress(b" " * 99_000_000), content_encoding="gzip"),
        "it is packed, which was not asked for",
    ),
    "deep JSON": ("camara", answers(DEEP), "its body: "),
    "no JSON": ("camara", answers(b"<html>"), "its body: JSON is malformed"),
    "no UTF-8": ("camara", answers(b'{"sessionId": "\xff"}'), "its body: "),
    "an array": ("camara", answers([SESSION]), "its body: Expected `object`"),
    "a text": ("nef", answers("made"), "its body: Expected `object`"),
    "no body": ("camara", answers(b""), "its body: "),
    "no id": ("camara", session(sessionId=""), "sessionId: "),
    "an id that is a number": (
        "camara",
        session(sessionId=7),
        "answer 201 to POST {url}/sessions: sessionId: Expected `str`",
    ),
    "an id of other lines": (
        "camara",
        session(sessionId="a\nb"),
        "sessionId: ",
    ),
    "an id of a megabyte": ("camara", session(sessionId="a" * 2**20), "sessionId: "),
    "a duration of 401 digits": (
        "camara",
        session(duration=BIG),
        "duration: Expected `int` <= 2147483647",
    ),
    "a duration below zero": ("camara", session(duration=-5), "duration: Expected `int` >= 1"),
    "no date": ("camara", session(expiresAt="soon"), "expiresAt: Invalid RFC3339"),
    "a state that is a list": (
        "camara",
        session(qosStatus=["AVAILABLE"]),
        "qosStatus: Expected `str`",
    ),
    "a Location that is no URL": (
        "nef",
        answers({}, Location="http://[bad/x"),
        "/v1/robots/subscriptions: 'http://[bad/x' is not a URL",
    ),
    "a Location of other bytes": (
        "nef",
        answers({}, Location="/x/%0d%0aevil"),
        "'/x/%0d%0aevil' is not a URL that ends in an id",
    ),
    "a self that is a number": ("nef", answers({"self": 7}), "self: Expected `str"),
    "another reference that is a number": (
        "nef",
        answers({"appliedQosRef": 7}, Location="/x/1"),
        "appliedQosRef: Expected `str",
    ),
    "a header that is no ASCII": (
        "nef",
        answers({"cause": "K\u00dcHN\u202e"}, "403 N\xf6", x_a="\xe4", Location="\xe4"),
        "403 N: K\u00dcHN",
    ),
    "a redirect to nowhere": ("nef", answers({}, "307 Go", Location="http://[bad"), "307 Go"),
    "no status known": ("nef", answers({}, "999 Odd"), "999 Odd"),
    "a Retry-After beyond any": (
        "nef",
        answers({}, "429 Slow", Retry_After="9" * 4000),
        "it is to be asked again in 1e+09 s",
    ),
    "a Retry-After that is no date": (
        "nef",
        answers({}, "503 Down", Retry_After="Tue, 99 Foo 99999 99:99:99 +9999"),
        "503 Down",
    ),
    "only failures": ("camara", answers({"code": "X"}, "500 Broken"), "500 Broken: X"),
}


@contextlib.contextmanager
def target_at(path: Path, kind: str, server: HostileServer) -> Iterator[tuple[Waited, Means]]:
    targets = Means(ledger_in(path))
    targets.begin(4 * _TIMEOUT_S)
    settings = {"nef": nef_settings, "camara": camara_settings}[kind](
        server.url, timeout_s=_TIMEOUT_S
    )
    file = settings_file(path, **{kind: settings})
    yield Waited(read_targets([kind], {"config": file})[0].open(targets)), targets


@pytest.mark.parametrize("name", HOSTILE)
def test_every_hostile_answer_is_one_clear_error_in_time(name: str, tmp_path: Path) -> None:
    kind, behave, expected = HOSTILE[name]
    with HostileServer(behave) as server, target_at(tmp_path, kind, server) as (target, _):
        began_s = time.monotonic()
        with pytest.raises(PartlyError) as caught:
            target.apply([rule()])
        took_s = time.monotonic() - began_s
        text = str(caught.value)

    assert expected.format(url=server.url) in text
    assert (name == "no UTF-8") is ("utf-8" in text.lower())
    assert took_s < _BOUND_S
    # The list of one flow: its line, and nothing else.
    assert len(text.splitlines()) == 2
    assert server.url in text.splitlines()[1]
    assert all(each.isprintable() for each in text.splitlines())
    assert len(text) < 1000
    assert TOKEN not in text


@pytest.mark.parametrize(
    ("kind", "body", "expected"),
    [
        ("nef", [1], "[0]: Expected `object`"),
        ("nef", {}, "its body: Expected `array`"),
        ("nef", [{"self": []}], "[0].self: Expected `str"),
        ("nef", [{"self": "/x/1", "ueIpv4Addr": 7}], "[0].ueIpv4Addr: Expected `str"),
        ("camara", [{"sessionId": {}}], "[0].sessionId: Expected `str"),
        ("camara", "none", "its body: Expected `array`"),
    ],
)
def test_a_list_that_cannot_be_used_names_the_element_and_the_field(
    kind: str, body: object, expected: str, tmp_path: Path
) -> None:
    """What was asked for and never answered is looked for in a list."""
    with HostileServer(sends()) as server, target_at(tmp_path, kind, server) as (target, _):
        with pytest.raises(PartlyError):
            target.apply([rule()])
        server._behave = answers(body, "200 OK")
        with pytest.raises(PartlyError) as caught:
            target.apply([rule()])

    assert expected in str(caught.value)


def test_a_session_whose_state_cannot_be_read_stays_listed_so_that_it_is_removed(
    tmp_path: Path,
) -> None:
    with (
        HostileServer(session(qosStatus=7)) as server,
        target_at(tmp_path, "camara", server) as (target, targets),
    ):
        with pytest.raises(PartlyError, match="qosStatus: "):
            target.apply([rule()])
        (record,) = targets.ledger.read().targets

    assert [each.id for each in record.entries] == [""]


def _programmer(path: Path, server: HostileServer) -> Programmer:
    """One that would be patient for far longer than any test."""
    ledger = ledger_in(path, "s")
    targets = Means(ledger)
    settings = nef_settings(server.url, devices=["10.77.0.1"], timeout_s=60)
    file = settings_file(path, nef=settings)
    target = read_targets(["nef"], {"config": file})[0].open(targets)
    return Programmer(plan(), [target], targets)


_VERDICT = Verdict(verdict=Outcome.OK, blocking=False, findings=(), flows=(report(),))


@pytest.mark.parametrize(
    "behave",
    [drips(b"HTTP/1.1 201 "), answers({}, "503 Down"), answers({}, "503 Down", Retry_After="300")],
    ids=["drips", "fails", "asks to wait"],
)
def test_a_bring_up_waits_for_no_server_past_its_deadline(behave: Behave, tmp_path: Path) -> None:
    async def run() -> BringUpError:
        networks = Networks("s", tmp_path / "run" / "s@7", Emitter(), _programmer(tmp_path, server))
        with pytest.raises(BringUpError) as caught:
            await networks.begin(_VERDICT, 0.5)
        hurry = asyncio.Event()
        hurry.set()
        await networks.close(hurry)
        return caught.value

    with HostileServer(behave) as server:
        began_s = time.monotonic()
        error = asyncio.run(run())

    assert time.monotonic() - began_s < _BOUND_S
    assert str(error).startswith("cannot program networks for 's': cannot make 1 of 1 changes")
    assert server.url in str(error)


def test_cancelling_a_bring_up_ends_a_request_at_once(tmp_path: Path) -> None:
    async def run() -> None:
        programmer = _programmer(tmp_path, server)
        networks = Networks("s", tmp_path, Emitter(), programmer)
        beginning = asyncio.ensure_future(networks.begin(_VERDICT, 600.0))
        assert await asyncio.to_thread(server.came.wait, _BOUND_S)
        beginning.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.wait_for(beginning, _BOUND_S)

    with HostileServer(drips(b"HTTP/1.1 201 ")) as server:
        asyncio.run(run())


def test_whoever_hurries_waits_for_no_server_and_is_told_that_it_is_still_listed(
    tmp_path: Path,
) -> None:
    notices: list[str] = []

    def note(event: object) -> None:
        if isinstance(event, Notice):
            notices.append(event.message)

    async def run() -> None:
        emit = Emitter()
        emit.listen(note)
        networks = Networks("s", tmp_path / "run" / "s@7", emit, _programmer(tmp_path, server))
        await networks.begin(_VERDICT, 600.0)
        server._behave = _silent
        server.came.clear()
        hurry = asyncio.Event()
        closing = asyncio.ensure_future(networks.close(hurry))
        assert await asyncio.to_thread(server.came.wait, _BOUND_S)
        hurry.set()
        await asyncio.wait_for(closing, _BOUND_S)

    with HostileServer(answers({}, Location="/subscriptions/1")) as server:
        asyncio.run(run())

    assert notices[-1].startswith("ended before everything was removed; what is left is listed")
    assert "'flows remove'" in notices[-1]


def test_the_environment_names_no_proxy_that_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It could read the token."""
    with (
        HostileServer(answers({}, Location="/subscriptions/1")) as server,
        HostileServer(answers({}, "502 Proxy")) as proxy,
    ):
        for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY", "HTTPS_PROXY"):
            monkeypatch.setenv(name, proxy.url)
        with target_at(tmp_path, "nef", server) as (target, _):
            target.apply([rule()])

    assert proxy.asked == []
    assert TOKEN in server.asked[0]
