"""Servers on loopback that behave as NEF and CAMARA do, and misbehave when told to.

The CAMARA one is checked against the interface's own OpenAPI document, request by request and
answer by answer; the NEF one against the fields of TS 29.122 and the filters of TS 29.214.
"""

from __future__ import annotations

import asyncio
import dataclasses
import datetime as dt
import functools
import http.server
import json
import re
import threading
import types
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from openapi_core import OpenAPI
from openapi_core.datatypes import RequestParameters
from openapi_core.exceptions import OpenAPIError
from werkzeug.datastructures import Headers, ImmutableMultiDict

CAMARA = Path(__file__).parents[2] / "data" / "camara" / "quality-on-demand.yaml"
TOKEN = "s3cr3t-t0ken-0f-the-t3sts"
FILTER = re.compile(r"permit (in|out) (6|17|udp|tcp) from [0-9a-f.:]+ [0-9]+ to [0-9a-f.:]+ [0-9]+")
PROBLEM = "application/problem+json"


@dataclasses.dataclass(frozen=True)
class Asked:
    """One request."""

    method: str
    path: str
    headers: dict[str, str]
    body: Any


@dataclasses.dataclass(frozen=True)
class Answer:
    """One answer."""

    status: int
    body: object = None
    headers: dict[str, str] = dataclasses.field(default_factory=dict)
    type: str = "application/json"


class Clock:
    """Time that passes only while targets sleep; `is_set_s` is what the wall clock was set by."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1_700_000_000.0
        self.is_set_s = 0.0
        self.slept: list[float] = []
        really = asyncio.sleep

        async def sleep(seconds: float) -> None:
            if seconds > 0:
                self.slept.append(seconds)
                self.now += seconds
            await really(0)

        wall = types.SimpleNamespace(time=lambda: self.now + self.is_set_s)
        monkeypatch.setattr(asyncio, "sleep", sleep)
        for module in ("camara", "server"):
            monkeypatch.setattr(f"lifecycle.programming.{module}.steady_s", lambda: self.now)
        monkeypatch.setattr("lifecycle.programming.camara.time", wall)


class Server:
    """Serves `answer` on loopback; use it in a `with`.

    Attributes:
        asked: every request.
        failures: what is answered in place of the next requests of a method. `before` runs first,
            and None as answer means: close the connection after it.
        complaints: what a check found wrong with a request or an answer.
    """

    root = ""

    def __init__(self) -> None:
        self.asked: list[Asked] = []
        self.failures: list[tuple[str, Answer | None]] = []
        self.complaints: list[str] = []
        self.lose_answers = False
        outer = self

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do(self) -> None:
                outer._serve(self)

            do_GET = do_POST = do_DELETE = do  # noqa: N815

            def log_message(self, *_: object) -> None:
                pass

        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self._thread = threading.Thread(
            target=functools.partial(self._server.serve_forever, poll_interval=0.01)
        )

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_address[1]}{self.root}"

    def answer(self, asked: Asked) -> Answer:
        raise NotImplementedError

    def methods(self) -> list[str]:
        return [each.method for each in self.asked]

    def __enter__(self) -> Any:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
        assert self.complaints == []

    def _serve(self, handler: http.server.BaseHTTPRequestHandler) -> None:
        length = int(handler.headers.get("content-length", 0))
        text = handler.rfile.read(length)
        asked = Asked(
            handler.command,
            handler.path,
            {name.lower(): value for name, value in handler.headers.items()},
            json.loads(text) if text else None,
        )
        self.asked.append(asked)
        answer: Answer | None
        if self.failures and self.failures[0][0] == asked.method:
            answer = self.failures.pop(0)[1]
        elif asked.headers.get("authorization") != f"Bearer {TOKEN}":
            answer = self.unauthorized()
        else:
            answer = self.answer(asked)
            if self.lose_answers and asked.method == "POST":
                self.lose_answers, answer = False, None
        if answer is None:
            handler.close_connection = True
            return
        data = b"" if answer.body is None else json.dumps(answer.body).encode()
        handler.send_response(answer.status)
        for name, value in answer.headers.items():
            handler.send_header(name, value)
        if data:
            handler.send_header("content-type", answer.type)
        if answer.status != 204:
            handler.send_header("content-length", str(len(data)))
        handler.end_headers()
        handler.wfile.write(data)

    def unauthorized(self) -> Answer:
        return Answer(401, {"status": 401, "code": "UNAUTHENTICATED", "message": "no token"})


class NefServer(Server):
    """3GPP NEF AsSessionWithQoS.

    Attributes:
        subscriptions: by id.
        absolute_locations: Location as some gateways write it: with a host nobody can reach.
        deletes_with_200: as some servers answer.
    """

    def __init__(self) -> None:
        super().__init__()
        self.subscriptions: dict[str, dict[str, Any]] = {}
        self.absolute_locations = False
        self.deletes_with_200 = False
        self._next = 1

    def answer(self, asked: Asked) -> Answer:
        prefix = "/3gpp-as-session-with-qos/v1/robots/subscriptions"
        if not asked.path.startswith(prefix):
            return _problem(404, "RESOURCE_URI_STRUCTURE_NOT_FOUND")
        id_ = asked.path[len(prefix) :].strip("/")
        if not id_:
            return self._collection(asked)
        if id_ not in self.subscriptions:
            return _problem(404, "RESOURCE_NOT_FOUND")
        return self._one(asked, id_)

    def _collection(self, asked: Asked) -> Answer:
        if asked.method == "GET":
            return Answer(200, list(self.subscriptions.values()))
        self._check(asked.body, asked)
        id_ = f"sub-{self._next}"
        self._next += 1
        path = f"/3gpp-as-session-with-qos/v1/robots/subscriptions/{id_}"
        location = f"http://nef.internal:8080{path}" if self.absolute_locations else path
        self.subscriptions[id_] = {**asked.body, "self": location}
        return Answer(201, self.subscriptions[id_], {"location": location})

    def _one(self, asked: Asked, id_: str) -> Answer:
        if asked.method == "GET":
            return Answer(200, self.subscriptions[id_])
        del self.subscriptions[id_]
        return Answer(200, {}) if self.deletes_with_200 else Answer(204)

    def _check(self, body: dict[str, Any], asked: Asked) -> None:
        """What the interface's schema checks, and the filters, which it does not look into."""
        required = {"notificationDestination", "qosReference", "flowInfo", "supportedFeatures"}
        addresses = {"ueIpv4Addr", "ueIpv6Addr"} & body.keys()
        (flow,) = body.get("flowInfo", [{}])
        texts = flow.get("flowDescriptions", [])
        if (
            body.keys() != required | addresses
            or len(addresses) != 1
            or flow.keys() != {"flowId", "flowDescriptions"}
            or not 1 <= len(texts) <= 2
            or not all(map(FILTER.fullmatch, texts))
        ):
            self.complaints.append(f"{asked.method}: {body}")


class CamaraServer(Server):
    """CAMARA QualityOnDemand 1.1.0.

    Attributes:
        sessions: by id.
        longest_s: no session is longer; later extensions are capped to it.
        asks_until_available: so many GETs answer REQUESTED before AVAILABLE.
    """

    root = "/quality-on-demand/v1"

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self.clock = clock
        self.sessions: dict[str, dict[str, Any]] = {}
        self.longest_s = 86_400
        self.asks_until_available = 0

    def answer(self, asked: Asked) -> Answer:
        request = _Request(asked)
        self._validate(lambda: _openapi().validate_request(request), asked)
        answer = self._answered(asked)
        self._validate(lambda: _openapi().validate_response(request, _Response(answer)), asked)
        return answer

    def expire(self, id_: str, why: str = "DURATION_EXPIRED") -> None:
        """The network ends a session."""
        self.sessions[id_].update(qosStatus="UNAVAILABLE", statusInfo=why)

    def _answered(self, asked: Asked) -> Answer:
        rest = asked.path[len(self.root) :]
        if rest == "/sessions":
            return self._create(asked.body)
        if rest == "/retrieve-sessions":
            device = asked.body.get("device")
            return Answer(200, [e for e in self.sessions.values() if e.get("device") == device])
        id_, _, extend = rest.removeprefix("/sessions/").partition("/")
        if id_ not in self.sessions:
            return _error(404, "NOT_FOUND")
        session = self.sessions[id_]
        if extend:
            return self._extend(session, asked.body["requestedAdditionalDuration"])
        if asked.method == "DELETE":
            del self.sessions[id_]
            return Answer(204)
        if session["qosStatus"] == "REQUESTED":
            self.asks_until_available -= 1
            if self.asks_until_available <= 0:
                self._available(session)
        return Answer(200, session)

    def _create(self, body: dict[str, Any]) -> Answer:
        for other in self.sessions.values():
            same = ("device", "applicationServer", "devicePorts", "applicationServerPorts")
            if all(other.get(key) == body.get(key) for key in same):
                return _error(409, "CONFLICT")
        id_ = str(uuid.uuid4())
        session = {key: value for key, value in body.items() if key != "sinkCredential"}
        session |= {"sessionId": id_, "duration": min(body["duration"], self.longest_s)}
        session["qosStatus"] = "REQUESTED"
        if not self.asks_until_available:
            self._available(session)
        self.sessions[id_] = session
        return Answer(201, session)

    def _available(self, session: dict[str, Any]) -> None:
        session["qosStatus"] = "AVAILABLE"
        session["startedAt"] = _time(self.clock.now)
        session["expiresAt"] = _time(self.clock.now + session["duration"])

    def _extend(self, session: dict[str, Any], more_s: int) -> Answer:
        if session["qosStatus"] != "AVAILABLE":
            return _error(409, "QUALITY_ON_DEMAND.SESSION_EXTENSION_NOT_ALLOWED")
        session["duration"] = min(session["duration"] + more_s, self.longest_s)
        started = dt.datetime.fromisoformat(session["startedAt"].replace("Z", "+00:00"))
        session["expiresAt"] = _time(started.timestamp() + session["duration"])
        return Answer(200, session)

    def _validate(self, check: Callable[[], object], asked: Asked) -> None:
        try:
            check()
        except OpenAPIError as error:
            self.complaints.append(f"{asked.method} {asked.path}: {error!r} {error.__cause__!r}")


class _Request:
    """A request as openapi-core sees it."""

    host_url = "http://localhost:9091"

    def __init__(self, asked: Asked) -> None:
        self.parameters = RequestParameters(
            query=ImmutableMultiDict([]),
            header=Headers(asked.headers),
            cookie=ImmutableMultiDict([]),
        )
        self.path = asked.path
        self.method = asked.method.lower()
        self.body = None if asked.body is None else json.dumps(asked.body).encode()
        self.content_type = asked.headers.get("content-type", "")


class _Response:
    """An answer as openapi-core sees it."""

    def __init__(self, answer: Answer) -> None:
        self.status_code = answer.status
        self.data = None if answer.body is None else json.dumps(answer.body).encode()
        self.content_type = answer.type
        self.headers: dict[str, str] = answer.headers


@functools.cache
def _openapi() -> OpenAPI:
    document = yaml.safe_load(CAMARA.read_text(encoding="utf-8"))
    # openapi-core knows no openIdConnect; what arrives is a bearer token, and that it can check.
    document["components"]["securitySchemes"]["openId"] = {"type": "http", "scheme": "bearer"}
    return OpenAPI.from_dict(document)


def _problem(status: int, cause: str) -> Answer:
    return Answer(status, {"status": status, "cause": cause}, type=PROBLEM)


def _error(status: int, code: str) -> Answer:
    return Answer(status, {"status": status, "code": code, "message": f"no: {code.lower()}"})


def _time(epoch_s: float) -> str:
    return dt.datetime.fromtimestamp(epoch_s, dt.timezone.utc).isoformat().replace("+00:00", "Z")
