"""HTTP to a network's exposure interface: one request at a time, with a deadline, retries, checks.

Owns: which answers are tried again and when, that a token goes to one server only and into no log,
that no server holds a request up past its deadline, and how a refusal and an answer that cannot be
used read: every one of them is an `HttpError` that names the request and the field. Knows nothing
of what is asked for.
"""

from __future__ import annotations

import email.utils
import os
import re
from collections.abc import Mapping
from typing import Any, TypeVar
from urllib.parse import quote, unquote, urlsplit

import msgspec

from lifecycle.codec import from_json, to_json
from lifecycle.programming.settings import ServerSettings, readable
from lifecycle.programming.target import HttpError, Means, ProgrammingError, SettingsError

try:
    import httpx
except ModuleNotFoundError:  # an extra: most systems program no network that is reached over HTTP
    httpx = None  # type: ignore[assignment]

ID_PATTERN = r"^[!-~]{1,512}$"
"""The id of a subscription or a session; CAMARA's are UUIDs."""

_IDEMPOTENT = frozenset({"GET", "PUT", "DELETE"})
"""RFC 9110 §9.2.2."""

_ALWAYS_AGAIN = frozenset({409, 429, 503})
_PASSING = frozenset({500, 502, 504})
_MAX_QUOTED = 300
_LARGEST_ANSWER = 4 * 1024 * 1024
"""Bytes: answers are a session or a subscription each, and a list of them all when one was lost."""

_T = TypeVar("_T")


class Reply(msgspec.Struct, frozen=True, kw_only=True):
    """An answer.

    Attributes:
        asked: the request, "GET http://nef.example.net/…".
        reason: beside the status.
        body: as far as it was read.
        headers: by their names in lower case.
    """

    asked: str
    status: int
    reason: str
    body: bytes
    headers: Mapping[str, str]

    @property
    def is_success(self) -> bool:
        """Whether it was done."""
        return 200 <= self.status < 300

    @property
    def gone(self) -> bool:
        """Whether there is no such thing (any more)."""
        return self.status in (404, 410)

    def read(self, type_: type[_T]) -> _T:
        """Return the body, which must be JSON that fits a type.

        Raises:
            HttpError: it does not. The request may have taken effect.
        """
        try:
            return from_json(self.body, type_, longest=_LARGEST_ANSWER)
        except ValueError as error:
            reason = readable(error)
            at_field = reason != str(error)
            raise self.unusable(reason if at_field else f"its body: {reason}") from error

    def unusable(self, reason: str) -> HttpError:
        """Return the error for an answer that is no use; `reason` names the field first."""
        return HttpError(
            f"cannot use the answer {self.status} to {self.asked}: {text_of(reason)}",
            status=self.status,
            # Whatever the answer is worth, the server has taken the request.
            uncertain=True,
            hint="check that the url is that of such a server",
        )

    def linked(self, url: str) -> str:
        """Return the last path segment of an absolute or relative URL: the id of what it names.

        Only the id is taken of a Location: behind a gateway its host is often one that cannot be
        reached from here, and a token must not follow it.

        Raises:
            HttpError: it is no URL, or its end cannot be an id.
        """
        try:
            segment = unquote(urlsplit(url).path.rstrip("/").rpartition("/")[2])
        except ValueError:
            segment = ""
        if segment in (".", "..") or not re.match(ID_PATTERN, segment):
            raise self.unusable(f"{url[:60]!r} is not a URL that ends in an id")
        return segment


class _Problem(msgspec.Struct, frozen=True):
    """Problem+json (RFC 7807; `cause`: TS 29.122), and CAMARA's {status, code, message}."""

    cause: Any = None
    code: Any = None
    detail: Any = None
    message: Any = None
    title: Any = None


class Api:
    """One server's interface.

    Args:
        settings: where it is, its token, and how long one attempt may take, from looking the name
            up to the last byte of the answer.
        means: bound all requests together.

    Attributes:
        url: what every path is appended to.
        patience: with it.

    Raises:
        ProgrammingError: httpx, the extra `networks`, is not installed.
        SettingsError: a proxy that the environment names cannot be used.
    """

    def __init__(self, settings: ServerSettings, means: Means) -> None:
        self.url = settings.scope
        if httpx is None:
            raise ProgrammingError(
                f"cannot reach {self.url}: httpx is not installed",
                hint="install it: pip install 'ros-lifecycle-manifests[networks]'",
            )
        self._is_local = settings.is_local
        self._token = settings.token
        self._timeout_s = settings.timeout_s
        self.patience = means.patience
        self._certificates = httpx.create_ssl_context()
        self._client()  # so that a proxy that cannot be used is an error at once

    def _client(self) -> httpx.AsyncClient:
        try:
            return httpx.AsyncClient(
                # A redirect could carry the token elsewhere, so none is followed.
                follow_redirects=False,
                timeout=None,  # an attempt is bounded as a whole
                verify=self._certificates,
                # What is for this host goes to no proxy: it would read the token, and cannot even
                # reach what it is for.
                trust_env=not self._is_local,
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
        if seconds > self.patience.left_s():
            raise HttpError(f"cannot wait for {self.url}: {self._why_late()}", uncertain=True)
        self.patience.sleep(seconds)

    def request(
        self,
        method: str,
        path: str,
        body: Mapping[str, object] | None = None,
        *,
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
            headers["content-type"] = "application/json"
        content = None if body is None else to_json(body)
        request = httpx.Request(method, f"{self.url}{path}", headers=headers, content=content)
        wait_s, attempt = self.patience.first_s, 1
        with self.patience.within(self.patience.total_s):
            while True:
                try:
                    return self._attempt(request, may_be_gone=may_be_gone)
                except HttpError as error:
                    pause_s = min(wait_s, self.patience.longest_s)
                    pause_s = pause_s if error.after_s is None else error.after_s
                    left_s = self.patience.left_s()
                    if not error.again or attempt == self.patience.attempts:
                        raise
                    if pause_s >= left_s:
                        # What has failed says more than that there is no time to try again.
                        if error.after_s is not None:
                            error.hint = (
                                f"the server asks to wait {pause_s:g} s, more than the "
                                f"{left_s:.0f} s that this waits for; try again then"
                            )
                        raise
                self.pause(pause_s)
                wait_s, attempt = wait_s * 2, attempt + 1

    def _attempt(self, request: httpx.Request, *, may_be_gone: bool) -> Reply:
        """Ask once.

        Raises:
            HttpError: refused, or there is no answer that can be read; says whether to ask again.
        """
        what = f"{request.method} {request.url}"
        limit_s = min(self._timeout_s, self.patience.left_s())
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
        try:
            reply = self.patience.run(self._ask(request), limit_s)
        except TimeoutError:
            reason = f"no {'whole answer' if sent else 'connection'} in time"
            if self.patience.cancelled.is_set():
                reason = self._why_late()
            reason = f"{reason} ({limit_s:.3g} s)"
        except httpx.TransportError as error:
            reason = _why(error)
        except Exception as error:  # noqa: BLE001 - whatever a library makes of unexpected bytes
            # Never its own message, which may quote the request.
            reason = f"its answer is no HTTP that can be read ({type(error).__name__})"
        else:
            if reply.is_success or (may_be_gone and reply.gone):
                return reply
            raise self._refusal(reply, request.method)
        again = request.method in _IDEMPOTENT or not sent
        raise HttpError(f"cannot {what}: {reason}", uncertain=sent, again=again)

    async def _ask(self, request: httpx.Request) -> Reply:
        """Send a request and read its answer, of which no more than can be of use.

        Raises:
            httpx.HTTPError: there is none, or it is packed.
        """
        body = bytearray()
        async with self._client() as client:
            answer = await client.send(request, stream=True)
            try:
                coding = answer.headers.get("content-encoding", "identity")
                if coding.strip().lower() not in ("", "identity"):
                    raise httpx.RemoteProtocolError("it is packed, which was not asked for")
                async for chunk in answer.aiter_raw():
                    body += chunk
                    if len(body) > _LARGEST_ANSWER:
                        break
            finally:
                await answer.aclose()
        return Reply(
            asked=f"{request.method} {request.url}",
            status=answer.status_code,
            reason=answer.reason_phrase,
            body=bytes(body),
            headers=answer.headers,
        )

    def _why_late(self) -> str:
        ended = self.patience.cancelled.is_set()
        return "it was ended before it was done" if ended else "no time left"

    def _refusal(self, answer: Reply, method: str) -> HttpError:
        try:
            found = from_json(answer.body, _Problem, longest=_LARGEST_ANSWER)
        except ValueError:
            found = _Problem()
        # Some servers quote the credentials that they refuse.
        secret = "" if self._token is None else self._token.reveal()

        def first(*values: object) -> str:
            return next(filter(None, (text_of(each, secret) for each in values)), "")

        words = [
            f"{answer.status} {text_of(answer.reason, secret)}".strip(),
            first(found.cause, found.code),
            first(found.detail, found.message, found.title),
        ]
        lost, twice = answer.status in _PASSING, method in _IDEMPOTENT
        forbidden = answer.status in (401, 403)
        return HttpError(
            f"cannot {answer.asked}: {': '.join(filter(None, words))}",
            status=answer.status,
            uncertain=lost and not twice,
            again=answer.status in _ALWAYS_AGAIN or (lost and twice),
            after_s=_retry_after_s(answer.headers.get("retry-after", ""), self.patience.now_s()),
            hint="check the token and what it is allowed to do" if forbidden else "",
        )


def as_segment(identifier: str) -> str:
    """Return an id as one path segment."""
    return quote(identifier, safe="")


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
