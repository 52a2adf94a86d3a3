"""HTTP to a network's exposure interface: one request at a time, with a deadline, retries, checks.

Owns: which answers are tried again and when, that a token goes to one server only and into no log,
that no server holds a request up past its deadline, and how a refusal and an answer that cannot be
used read: every one of them is an `HttpError` that names the request and the field. Knows nothing
of what is asked for.
"""

from __future__ import annotations

import asyncio
import email.utils
import json
import os
import ssl
import threading
import time
import zlib
from collections.abc import Collection, Mapping
from typing import Any, NoReturn
from urllib.parse import quote, unquote, urlsplit

from lifecycle import dataclasses
from lifecycle.network.nfe import is_loopback
from lifecycle.programming.apply.settings import Token
from lifecycle.programming.apply.target import HttpError, MissingFeatureError, SettingsError
from lifecycle.programming.apply.tool import Deadline

try:
    import httpx
except ModuleNotFoundError:  # an extra: most systems program no network that is reached over HTTP
    httpx = None  # type: ignore[assignment]

MERGE_PATCH = "application/merge-patch+json"
"""RFC 7396; what TS 29.122 wants of PATCH."""

_IDEMPOTENT = frozenset({"GET", "PUT", "DELETE", "PATCH"})
"""RFC 9110 §9.2.2, and PATCH: a merge patch that is applied twice gives the same."""

_PASSING = frozenset({500, 502, 503, 504})
_MAX_QUOTED = 300
_LARGEST_ANSWER = 4 * 1024 * 1024
"""Bytes, unpacked: answers are a session or a subscription each, and a list of them all when one
was lost."""

_LONGEST_ID = 512
"""Characters of the id of a subscription or a session; CAMARA's are UUIDs."""

_GZIP_OR_ZLIB = 32 + zlib.MAX_WBITS
"""zlib finds out by itself which of the two headers there is."""


class Clock:
    """The machine's clock; tests have one that need not wait."""

    def now_s(self) -> float:
        """Return seconds since the epoch."""
        return time.time()

    def steady_s(self) -> float:
        """Return seconds, on a clock that only goes forward."""
        return time.monotonic()

    def sleep(self, seconds: float, woken: threading.Event) -> None:
        """Wait, or until `woken` is set."""
        woken.wait(seconds)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Patience:
    """How long to go on asking.

    Attributes:
        attempts: at most so many requests.
        first_s: wait before the second, then doubled each time.
        longest_s: longest single wait of our own choice.
        total_s: one request with all its attempts, and all waits between them; a Retry-After
            beyond it is not waited for.
    """

    attempts: int = 5
    first_s: float = 0.5
    longest_s: float = 8.0
    total_s: float = 60.0


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Fields:
    """A JSON object of an answer; what is read of it is checked first.

    Attributes:
        reply: the answer.
        values: the object.
        where: of the object in the answer, "[2]."; empty for the whole.
    """

    reply: Reply
    values: Mapping[str, Any]
    where: str = ""

    def text(self, key: str, *, required: bool = False) -> str:
        """Return a string; empty if there is none.

        Raises:
            HttpError: it is something else, or is required and not there.
        """
        value = self.values.get(key)
        if value is None and not required:
            return ""
        if not isinstance(value, str) or (required and not value):
            self.refuse(key, "a string" if value is not None else "", value)
        return value

    def one_of(self, key: str, allowed: Collection[str]) -> str:
        """Return a string that is one of a few.

        Raises:
            HttpError: it is not.
        """
        value = self.values.get(key)
        if not isinstance(value, str) or value not in allowed:
            self.refuse(key, f"one of {', '.join(allowed)}", value)
        return value

    def whole(self, key: str, least: int, most: int) -> int | None:
        """Return a whole number; None if there is none.

        Raises:
            HttpError: it is something else, or less than `least`, or more than `most`.
        """
        value = self.values.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
            self.refuse(key, f"a whole number from {least} to {most}", value)
        return value

    def identifier(self, key: str) -> str:
        """Return an id that can be a path segment of a URL; empty if there is none.

        Raises:
            HttpError: it cannot be one.
        """
        value = self.text(key)
        if value and not _is_identifier(value):
            self.refuse(key, _IDENTIFIER, value)
        return value

    def link(self, key: str) -> str:
        """Return the id at the end of a URL, see `last_segment`; empty if there is none.

        Raises:
            HttpError: it is no URL, or its end cannot be an id.
        """
        value = self.text(key)
        try:
            found = last_segment(value)
        except ValueError:
            self.refuse(key, "a URL", value)
        if found and not _is_identifier(found):
            self.refuse(key, f"a URL that ends in {_IDENTIFIER}", value)
        return found

    def refuse(self, key: str, allowed: str, value: object = None) -> NoReturn:
        """Raise for a field that cannot be used.

        Args:
            key: of the field.
            allowed: what it must be, "a string".
            value: what it is; None if it is missing.

        Raises:
            HttpError: always. The request may have taken effect.
        """
        is_there = f"{show(value)} is not {allowed}" if value is not None else "is missing"
        raise self.reply.unusable(f"{self.where}{key}", is_there)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """An answer.

    Attributes:
        asked: the request, "GET http://nef.example.net/…".
        reason: beside the status.
        body: decoded JSON object or array; None if there was none.
        flaw: why there is no body that can be used; empty if there is one, or was none.
        location: of what was created; empty if there was none.
        retry_after: as it was sent; empty if it was not.
    """

    asked: str
    status: int
    reason: str
    body: object
    flaw: str
    location: str
    retry_after: str

    @property
    def is_success(self) -> bool:
        """Whether it was done."""
        return 200 <= self.status < 300

    @property
    def gone(self) -> bool:
        """Whether there is no such thing (any more)."""
        return self.status in (404, 410)

    def object(self, *, may_be_empty: bool = False) -> Fields:
        """Return the body, which must be a JSON object.

        Args:
            may_be_empty: an answer without a body is an object without fields.

        Raises:
            HttpError: it is something else.
        """
        body = self.body
        if may_be_empty and body is None and not self.flaw:
            body = {}
        if self.flaw or not isinstance(body, dict):
            raise self._no_body("a JSON object")
        return Fields(reply=self, values=body)

    def objects(self) -> tuple[Fields, ...]:
        """Return the body, which must be an array of JSON objects; none of it if it is gone.

        Raises:
            HttpError: it is something else.
        """
        if self.gone:
            return ()
        if self.flaw or not isinstance(self.body, list):
            raise self._no_body("a JSON array")
        found = []
        for index, each in enumerate(self.body):
            if not isinstance(each, dict):
                raise self.unusable(f"[{index}]", f"{show(each)} is not a JSON object")
            found.append(Fields(reply=self, values=each, where=f"[{index}]."))
        return tuple(found)

    def created(self) -> str:
        """Return the id at the end of Location; empty if there is no Location.

        Raises:
            HttpError: it is no URL, or its end cannot be an id.
        """
        return Fields(reply=self, values={"Location": self.location}).link("Location")

    def _no_body(self, allowed: str) -> HttpError:
        there = "" if self.body is None else f"{show(self.body)} "
        return self.unusable("its body", self.flaw or f"{there}is not {allowed}")

    def unusable(self, field: str, reason: str) -> HttpError:
        """Return the error for an answer that was understood as far as `field`.

        Args:
            field: "duration", "[2].self", "Location".
            reason: follows the field, "'x' is not a string".
        """
        return HttpError(
            f"cannot use the answer {self.status} to {self.asked}: {field}: {reason}",
            status=self.status,
            # Whatever the answer is worth, the server has taken the request.
            uncertain=True,
            hint="check that the url is that of such a server",
        )


def show(value: object) -> str:
    """Spell a value of an answer on one line, printable and short."""
    if isinstance(value, dict):
        return "a JSON object"
    if isinstance(value, list):
        return "a JSON array"
    if value is None:
        return "null"
    spelled = str(value).lower() if isinstance(value, bool) else repr(value)
    return spelled if len(spelled) <= _SHOWN else f"{spelled[: _SHOWN - 2]}…{spelled[-1]}"


_SHOWN = 60
_IDENTIFIER = f"an id of 1 to {_LONGEST_ID} printable characters"


def _is_identifier(text: str) -> bool:
    return 0 < len(text) <= _LONGEST_ID and text.isprintable() and text not in (".", "..")


class Api:
    """One server's interface.

    Args:
        url: what every path is appended to.
        token: sent as a bearer token; None sends none.
        timeout_s: of one attempt, from looking the name up to the last byte of the answer.
        ca_file: certificates to check the server against; empty for the system's.
        patience: see Patience.
        clock: see Clock.
        deadline: bounds all requests together; None does not.

    Raises:
        MissingFeatureError: httpx, the extra `networks`, is not installed.
        SettingsError: `ca_file`, or a proxy that the environment names, cannot be used.
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
        deadline: Deadline | None = None,
    ) -> None:
        self.url = url.rstrip("/")
        if httpx is None:
            raise MissingFeatureError(
                f"cannot reach {self.url}: httpx is not installed",
                hint="install it: pip install 'ros-lifecycle-manifests[networks]'",
            )
        self.clock = clock or Clock()
        self._token = token
        self._timeout_s = timeout_s
        self._patience = patience or Patience()
        self._deadline = deadline or Deadline()
        self._certificates = _certificates(ca_file)
        self._client()  # so that a proxy that cannot be used is an error at once

    def _client(self) -> httpx.AsyncClient:
        host = urlsplit(self.url).hostname or ""
        try:
            return httpx.AsyncClient(
                # A redirect could carry the token elsewhere, so none is followed.
                follow_redirects=False,
                verify=self._certificates,
                # What is for this host goes to no proxy: it would read the token, and cannot even
                # reach what it is for.
                trust_env=not (host == "localhost" or is_loopback(host)),
            )
        except (ValueError, ImportError, httpx.InvalidURL):
            # Not quoted: it may hold a password.
            raise SettingsError(
                f"cannot reach {self.url} through the proxy that the environment names: it is not "
                "http:// or https:// with a host",
                hint="see HTTPS_PROXY, HTTP_PROXY, ALL_PROXY and NO_PROXY",
            ) from None

    def pause(self, seconds: float) -> None:
        """Wait, unless the deadline comes first or is cancelled.

        Raises:
            HttpError: it does.
        """
        if seconds > self._deadline.left_s():
            raise HttpError(f"cannot wait for {self.url}: {self._why_late()}", uncertain=True)
        woken = threading.Event()
        with self._deadline.waking(woken.set):
            self.clock.sleep(seconds, woken)

    def request(
        self,
        method: str,
        path: str,
        body: Mapping[str, object] | None = None,
        *,
        content_type: str = "application/json",
        may_be_gone: bool = False,
    ) -> Reply:
        """Ask, and ask again where that is right; always back by the deadline.

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
        headers = {
            "accept": "application/json, application/problem+json",
            # A few bytes packed well may be as many gigabytes unpacked.
            "accept-encoding": "identity",
        }
        if body is not None:
            headers["content-type"] = content_type
        request = httpx.Request(
            method,
            f"{self.url}{path}",
            headers=headers,
            content=None if body is None else json.dumps(body).encode(),
        )
        with self._deadline.within(self._patience.total_s):
            return self._patiently(request, may_be_gone=may_be_gone)

    def _patiently(self, request: httpx.Request, *, may_be_gone: bool) -> Reply:
        method = request.method
        waited_s = 0.0
        wait_s = self._patience.first_s
        for attempt in range(1, self._patience.attempts + 1):
            last = attempt == self._patience.attempts
            asked_s = None
            found = self._attempt(request)
            if isinstance(found, HttpError):
                failed = found
                if last or (failed.uncertain and method not in _IDEMPOTENT):
                    raise failed
            else:
                if found.is_success or (may_be_gone and found.gone):
                    return found
                failed = self._refusal(found, method)
                asked_s = _retry_after_s(found.retry_after, self.clock.now_s())
                if last or not _again(found.status, method):
                    raise failed
                if waited_s + (asked_s or 0.0) > self._patience.total_s:
                    raise _with_hint(failed, asked_s or 0.0, self._patience.total_s)
            pause_s = min(wait_s, self._patience.longest_s) if asked_s is None else asked_s
            left_s = self._deadline.left_s()
            if pause_s >= left_s:
                # What has failed says more than that there is no time to try again.
                raise failed if asked_s is None else _with_hint(failed, asked_s, left_s)
            self.pause(pause_s)
            waited_s += pause_s
            wait_s *= 2
        raise AssertionError("the last attempt returns or raises")

    def _attempt(self, request: httpx.Request) -> Reply | HttpError:
        """Ask once; return the error if there was no answer, which may be worth another try.

        Raises:
            HttpError: there is no answer that another try could make better.
        """
        what = f"{request.method} {request.url}"
        limit_s = min(self._timeout_s, self._deadline.left_s())
        if limit_s <= 0:
            raise HttpError(f"cannot {what}: {self._why_late()}")
        sent = False

        async def trace(event: str, _: Mapping[str, Any]) -> None:
            """Note that the server may have taken the request, by httpx's extension `trace`."""
            nonlocal sent
            sent = sent or event.endswith("send_request_headers.started")

        request.extensions = {"trace": trace}
        # Revealed for this attempt only: a token that is changed meanwhile is taken up.
        if self._token is not None:
            request.headers["authorization"] = f"Bearer {self._token.reveal()}"
        # Not asyncio.run, which waits for names that are still looked up.
        loop = asyncio.new_event_loop()
        asking = loop.create_task(asyncio.wait_for(self._ask(request), limit_s))
        try:
            with self._deadline.waking(lambda: loop.call_soon_threadsafe(asking.cancel)):
                return loop.run_until_complete(asking)
        except (asyncio.TimeoutError, asyncio.CancelledError):
            reason = self._why_late() if self._deadline.is_cancelled else ""
            reason = reason or f"no {'whole answer' if sent else 'connection'} in time"
            return HttpError(f"cannot {what}: {reason} ({limit_s:.3g} s)", uncertain=sent)
        except httpx.TransportError as error:
            return HttpError(f"cannot {what}: {_why(error)}", uncertain=sent)
        except Exception as error:  # noqa: BLE001 - whatever a library raises
            # What a library makes of bytes that it did not expect; never its own message, which
            # may quote the request.
            raise HttpError(
                f"cannot {what}: its answer is no HTTP that can be read ({type(error).__name__})",
                uncertain=sent,
                hint="check that the url is that of such a server",
            ) from None
        finally:
            if asking.cancel():  # whatever ended this, such as Ctrl-C, before it was done
                loop.run_until_complete(asyncio.wait([asking]))
            loop.close()

    async def _ask(self, request: httpx.Request) -> Reply:
        """Send a request and read its answer, of which no more than can be of use.

        Raises:
            httpx.HTTPError: there is none.
        """
        packed = bytearray()
        async with self._client() as client:
            answer = await client.send(request, stream=True)
            try:
                async for chunk in answer.aiter_raw():
                    packed += chunk
                    if len(packed) > _LARGEST_ANSWER:
                        break
            finally:
                await answer.aclose()
        flaw = _TOO_LARGE if len(packed) > _LARGEST_ANSWER else ""
        body = bytes(packed)
        if not flaw:
            body, flaw = _unpacked(body, answer.headers.get("content-encoding", ""))
        decoded, flaw = _decoded(body) if body and not flaw else (None, flaw)
        return Reply(
            asked=f"{request.method} {request.url}",
            status=answer.status_code,
            reason=answer.reason_phrase,
            body=decoded,
            flaw=flaw,
            location=answer.headers.get("location", ""),
            retry_after=answer.headers.get("retry-after", ""),
        )

    def _why_late(self) -> str:
        return "it was ended before it was done" if self._deadline.is_cancelled else "no time left"

    def _refusal(self, answer: Reply, method: str) -> HttpError:
        """Read problem+json (RFC 7807; `cause`: TS 29.122) or CAMARA's {status, code, message}."""
        found = answer.body if isinstance(answer.body, dict) else {}
        # Some servers quote the credentials that they refuse.
        secret = "" if self._token is None else self._token.reveal()
        cause = text_of(found.get("cause"), secret) or text_of(found.get("code"), secret)
        detail = next(
            (
                text
                for key in ("detail", "message", "title")
                if (text := text_of(found.get(key), secret))
            ),
            "",
        )
        reason = text_of(answer.reason, secret)
        words = [f"{answer.status} {reason}".strip(), cause, detail]
        hint = ""
        if answer.status in (401, 403):
            hint = "check the token and what it is allowed to do"
        return HttpError(
            f"cannot {answer.asked}: {': '.join(word for word in words if word)}",
            status=answer.status,
            uncertain=answer.status in _PASSING - {503} and method == "POST",
            hint=hint,
        )


_TOO_LARGE = f"is larger than {_LARGEST_ANSWER} bytes"


def _unpacked(body: bytes, encoding: str) -> tuple[bytes, str]:
    """Return a body unpacked, and what is wrong with it; some servers pack what was not to be."""
    coding = encoding.strip().lower()
    if not body or coding in ("", "identity"):
        return body, ""
    if coding not in ("gzip", "x-gzip", "deflate"):
        return b"", f"is packed as {show(encoding)}, which was not asked for"
    unpacking = zlib.decompressobj(_GZIP_OR_ZLIB)
    try:
        plain = unpacking.decompress(body, _LARGEST_ANSWER + 1)
    except zlib.error:
        return b"", f"is no {coding}, as its Content-Encoding says"
    if len(plain) > _LARGEST_ANSWER:
        return b"", _TOO_LARGE
    return (plain, "") if unpacking.eof else (b"", f"is {coding} that ends in the middle")


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


def _certificates(ca_file: str) -> ssl.SSLContext:
    if not ca_file:
        return httpx.create_ssl_context()
    try:
        return ssl.create_default_context(cafile=ca_file)
    except (OSError, ssl.SSLError) as error:
        raise SettingsError(f"cannot use ca_file {ca_file!r}: {error}") from error


def _again(status: int, method: str) -> bool:
    if status in (409, 429, 503):
        return True
    return status in _PASSING and method in _IDEMPOTENT


def _decoded(body: bytes) -> tuple[object, str]:
    """Return what JSON says, and what is wrong with it."""
    try:
        return json.loads(body, parse_constant=_no_number), ""
    except RecursionError:
        return None, "is JSON that is nested too deeply"
    except ValueError:  # no JSON, no UTF-8, or a number of thousands of digits
        return None, "is no JSON"


def _no_number(text: str) -> NoReturn:
    """NaN and Infinity, which are no JSON (RFC 8259 §6)."""
    raise ValueError(text)


def _with_hint(error: HttpError, asked_s: float, total_s: float) -> HttpError:
    error.hint = (
        f"the server asks to wait {asked_s:g} s, more than the {total_s:g} s that this waits for; "
        "try again then"
    )
    return error


def text_of(value: object, secret: str = "") -> str:
    """A server's text on one line, printable and short, without `secret`."""
    if not isinstance(value, str):
        return ""
    if secret:
        value = value.replace(secret, "***")
    plain = "".join(each if each.isprintable() else " " for each in value)
    return plain[:_MAX_QUOTED].strip()


def _retry_after_s(text: str, now_s: float) -> float | None:
    """Retry-After as seconds from now (RFC 9110 §10.2.3); None if there is none to be read."""
    text = text.strip()
    if text.isascii() and text.isdigit():
        return float(text[:9])
    try:
        ends_s = email.utils.parsedate_to_datetime(text).timestamp()
    except (ValueError, TypeError, IndexError, OverflowError, OSError):  # whatever is no date
        return None
    return max(0.0, ends_s - now_s)


def _why(error: httpx.TransportError) -> str:
    """Return the kernel's reason where there is one: "Connection refused"."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and (cause.errno or 0) > 0:
            return os.strerror(cause.errno or 0)
        cause = cause.__cause__ or cause.__context__
    return text_of(str(error)) or type(error).__name__
