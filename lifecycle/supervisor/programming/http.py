"""HTTP to a network's exposure interface: one request at a time, bounded, patient where asked.

Owns: which answers are tried again and when, that a token goes to one server only and into no log,
and how a refusal reads. Knows nothing of what is asked for.
"""

from __future__ import annotations

import dataclasses
import email.utils
import json
import ssl
import time
from collections.abc import Mapping
from typing import Any, Protocol
from urllib.parse import quote, unquote, urlsplit

import httpx

from lifecycle.supervisor.programming.errors import HttpError, SettingsError
from lifecycle.supervisor.programming.secret import Token

MERGE_PATCH = "application/merge-patch+json"
"""RFC 7396; what TS 29.122 wants of PATCH."""

_IDEMPOTENT = frozenset({"GET", "PUT", "DELETE", "PATCH"})
"""RFC 9110 §9.2.2, and PATCH: a merge patch that is applied twice gives the same."""

_PASSING = frozenset({500, 502, 503, 504})
_TRANSFER = frozenset({"content-encoding", "content-length", "transfer-encoding"})
_MAX_QUOTED = 300
_LARGEST_ANSWER = 4 * 1024 * 1024
"""Answers are a session or a subscription each, and a list of them all when one was lost."""


class Clock(Protocol):
    """Time, so that tests need not wait."""

    def now_s(self) -> float:
        """Return seconds since the epoch."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait."""
        ...


class SystemClock:
    """The machine's clock."""

    def now_s(self) -> float:
        """Return seconds since the epoch."""
        return time.time()

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Patience:
    """How long to go on asking.

    Attributes:
        attempts: at most so many requests.
        first_s: wait before the second, then doubled each time.
        longest_s: longest single wait of our own choice.
        total_s: all waits of one request together; a Retry-After beyond it is not waited for.
    """

    attempts: int = 5
    first_s: float = 0.5
    longest_s: float = 8.0
    total_s: float = 60.0


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """An answer of status 2xx, or 404 and 410 where those are asked for.

    Attributes:
        body: decoded JSON object or array; None if there was none.
        location: of what was created; empty if there was none.
    """

    status: int
    body: object
    location: str

    @property
    def gone(self) -> bool:
        """Whether there is no such thing (any more)."""
        return self.status in (404, 410)

    def object(self) -> dict[str, Any]:
        """Return the body as a JSON object; an empty one if it is something else."""
        return self.body if isinstance(self.body, dict) else {}


class Api:
    """One server's interface.

    Args:
        url: what every path is appended to.
        token: sent as a bearer token; None sends none.
        timeout_s: of one request.
        ca_file: certificates to check the server against; empty for the system's.
        patience: see Patience.
        clock: see Clock.
    """

    def __init__(
        self,
        url: str,
        *,
        token: Token | None = None,
        timeout_s: float = 10.0,
        ca_file: str = "",
        patience: Patience | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.url = url.rstrip("/")
        self.clock = clock or SystemClock()
        self._token = token
        self._patience = patience or Patience()
        # A redirect could carry the token elsewhere, so none is followed.
        self._client = httpx.Client(
            timeout=timeout_s, follow_redirects=False, verify=_certificates(ca_file)
        )

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    def request(
        self,
        method: str,
        path: str,
        body: Mapping[str, object] | None = None,
        *,
        content_type: str = "application/json",
        may_be_gone: bool = False,
    ) -> Reply:
        """Ask, and ask again where that is right.

        429 and 503 are asked again after Retry-After; 409 too, because a server may still be
        deleting what is in the way; other server errors and lost answers only where asking twice
        is the same as asking once. A connection that could not be made is tried again.

        Args:
            method: HTTP method.
            path: below `url`; starts with a slash.
            body: sent as JSON.
            content_type: of the body.
            may_be_gone: 404 and 410 are answers, not errors.

        Raises:
            HttpError: refused, or still not done after all patience.
        """
        what = f"{method} {self.url}{path}"
        waited_s = 0.0
        wait_s = self._patience.first_s
        for attempt in range(1, self._patience.attempts + 1):
            last = attempt == self._patience.attempts
            try:
                response = self._send(method, path, body, content_type)
            except httpx.TransportError as error:
                unsent = isinstance(error, httpx.ConnectError | httpx.ConnectTimeout)
                if last or not (unsent or method in _IDEMPOTENT):
                    raise HttpError(
                        f"cannot {what}: {_transport_reason(error)}", uncertain=not unsent
                    ) from None
                asked_s = None
            else:
                if response.is_success or (may_be_gone and response.status_code in (404, 410)):
                    return _reply(response)
                failed = _refusal(what, response, method)
                asked_s = _retry_after_s(response, self.clock.now_s())
                if last or not _again(response.status_code, method):
                    raise failed
                if waited_s + (asked_s or 0.0) > self._patience.total_s:
                    raise _with_hint(failed, asked_s or 0.0, self._patience.total_s)
            pause_s = min(wait_s, self._patience.longest_s) if asked_s is None else asked_s
            self.clock.sleep(pause_s)
            waited_s += pause_s
            wait_s *= 2
        raise AssertionError("the last attempt returns or raises")

    def _send(
        self, method: str, path: str, body: Mapping[str, object] | None, content_type: str
    ) -> httpx.Response:
        headers = {"accept": "application/json, application/problem+json"}
        content = None
        if body is not None:
            content = json.dumps(body).encode()
            headers["content-type"] = content_type
        if self._token is not None:
            # Revealed for this request only; the client keeps no copy in its defaults.
            headers["authorization"] = f"Bearer {self._token.reveal()}"
        url = f"{self.url}{path}"
        with self._client.stream(method, url, headers=headers, content=content) as response:
            whole = _read(response, f"{method} {url}")
        # Decoded already, so its headers must not say that it is not.
        kept = [each for each in response.headers.multi_items() if each[0] not in _TRANSFER]
        return httpx.Response(
            response.status_code, headers=kept, content=whole, request=response.request
        )


def _read(response: httpx.Response, what: str) -> bytes:
    """Return the body, unless it is more than any answer of these interfaces can be."""
    whole = bytearray()
    for chunk in response.iter_bytes():
        whole += chunk
        if len(whole) > _LARGEST_ANSWER:
            raise HttpError(
                f"cannot {what}: the answer is larger than {_LARGEST_ANSWER} bytes",
                status=response.status_code,
                uncertain=response.request.method == "POST",
                hint="check that the url is that of such a server",
            )
    return bytes(whole)


def last_segment(location: str) -> str:
    """Return the last path segment of a URL, absolute or relative: the id of what was created.

    Only the id is taken of a Location: behind a gateway its host is often one that cannot be
    reached from here, and a token must not follow it.
    """
    segment = unquote(urlsplit(location).path.rstrip("/").rpartition("/")[2])
    return "" if segment in (".", "..") else segment


def as_segment(identifier: str) -> str:
    """Return an id as one path segment."""
    return quote(identifier, safe="")


def _certificates(ca_file: str) -> ssl.SSLContext | bool:
    if not ca_file:
        return True
    try:
        return ssl.create_default_context(cafile=ca_file)
    except (OSError, ssl.SSLError) as error:
        raise SettingsError(f"cannot use ca_file {ca_file!r}: {error}") from error


def _again(status: int, method: str) -> bool:
    if status in (409, 429, 503):
        return True
    return status in _PASSING and method in _IDEMPOTENT


def _reply(response: httpx.Response) -> Reply:
    body: object = None
    if response.content:
        try:
            body = response.json()
        except ValueError:
            body = None
    return Reply(
        status=response.status_code,
        body=body,
        location=response.headers.get("location", ""),
    )


def _refusal(what: str, response: httpx.Response, method: str) -> HttpError:
    """Read problem+json (RFC 7807; `cause` of TS 29.122) or CAMARA's {status, code, message}."""
    told = _reply(response).object()
    # Some servers quote the credentials that they refuse.
    secret = response.request.headers.get("authorization", "").removeprefix("Bearer ")
    cause = _text(told.get("cause"), secret) or _text(told.get("code"), secret)
    detail = next(
        (text for key in ("detail", "message", "title") if (text := _text(told.get(key), secret))),
        "",
    )
    reason = _text(response.reason_phrase, secret)
    words = [f"{response.status_code} {reason}".strip(), cause, detail]
    hint = ""
    if response.status_code in (401, 403):
        hint = "check the token and what it is allowed to do"
    return HttpError(
        f"cannot {what}: {': '.join(word for word in words if word)}",
        status=response.status_code,
        cause=cause,
        uncertain=response.status_code in _PASSING - {503} and method == "POST",
        hint=hint,
    )


def _with_hint(error: HttpError, asked_s: float, total_s: float) -> HttpError:
    return HttpError(
        error.message,
        status=error.status,
        cause=error.cause,
        hint=f"the server asks to wait {asked_s:g} s, more than the {total_s:g} s that this waits "
        "for; try again then",
    )


def _text(value: object, secret: str = "") -> str:
    """A server's words on one line, printable and short, without `secret`."""
    if not isinstance(value, str):
        return ""
    if secret:
        value = value.replace(secret, "***")
    plain = "".join(each if each.isprintable() else " " for each in value)
    return plain[:_MAX_QUOTED].strip()


def _retry_after_s(response: httpx.Response, now_s: float) -> float | None:
    """Retry-After as seconds from now (RFC 9110 §10.2.3); None if there is none to be read."""
    text = response.headers.get("retry-after", "").strip()
    if text.isascii() and text.isdigit():
        return float(text[:9])
    try:
        when = email.utils.parsedate_to_datetime(text)
    except ValueError:
        return None
    return max(0.0, when.timestamp() - now_s)


def _transport_reason(error: httpx.TransportError) -> str:
    if isinstance(error, httpx.ConnectTimeout):
        return "no connection in time"
    if isinstance(error, httpx.TimeoutException):
        return "no answer in time"
    return _text(str(error)) or type(error).__name__
