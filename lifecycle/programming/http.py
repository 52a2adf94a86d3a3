"""Servers that are reached over HTTP: their settings file, and one request at a time.

A token is read at the moment it is needed, goes to one server only and into no log. No server holds
a request up past its deadline; a refusal, and an answer that cannot be used, is an `HttpError` that
names the request and the field.
"""

from __future__ import annotations

import email.utils
import ipaddress
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote, urlsplit

import msgspec
import yaml
from msgspec.structs import replace

from lifecycle.codec import from_json, to_json
from lifecycle.network.nfe import is_loopback
from lifecycle.programming import TARGETS
from lifecycle.programming.target import (
    HttpError,
    Means,
    ProgrammingError,
    SettingsError,
    target_kind,
)
from lifecycle.run_directory import read_regular

try:
    import httpx
except ModuleNotFoundError:  # an extra: most systems program no network that is reached over HTTP
    httpx = None  # type: ignore[assignment]

_MAX_BYTES = 256 * 1024
_MAX_TOKEN_BYTES = 64 * 1024

IpNetwork = ipaddress.IPv4Network | ipaddress.IPv6Network


class Token(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where a bearer token is: exactly one of the two.

    Attributes:
        env: name of an environment variable.
        file: path of a file; a relative one is beside the settings file.
    """

    env: str = ""
    file: str = ""

    def __post_init__(self) -> None:
        if bool(self.env) == bool(self.file):
            raise ValueError("cannot find the token: give exactly one of env and file")

    def reveal(self) -> str:
        """Return the token itself.

        Raises:
            SettingsError: it is not there, or is no token; its text is never quoted.
        """
        if self.env:
            text = os.environ.get(self.env, "")
            where = f"environment variable {self.env}"
        else:
            where = f"file {self.file!r}"
            try:
                text = read_regular(self.file, _MAX_TOKEN_BYTES).decode("ascii")
            except (OSError, UnicodeDecodeError) as error:
                reason = error.strerror if isinstance(error, OSError) else "it is not ASCII text"
                # The cause is left out on purpose: a decoding error quotes the bytes.
                raise SettingsError(f"cannot read the token from {where}: {reason}") from None
        token = text.strip()
        if not token:
            raise SettingsError(f"cannot read the token from {where}: it is empty or not set")
        # RFC 6750 §2.1: anything else could end the header line.
        if not token.isascii() or any(not 0x21 <= ord(each) <= 0x7E for each in token):
            raise SettingsError(
                f"cannot use the token from {where}: it has characters that no token has"
            )
        return token


class ServerSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How to reach a server; what it is asked for is its target's.

    Attributes:
        url: of its interface.
        devices: addresses or networks of the network's devices, `10.45.0.0/16`.
        token: None sends none.
        timeout_s: of one request, > 0.
    """

    url: str
    devices: tuple[str, ...]
    token: Token | None = None
    timeout_s: float = 10.0

    def __post_init__(self) -> None:
        url, parts = self.url, urlsplit(self.url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise ValueError(f"cannot use url {url!r}; use http:// or https:// and a host")
        if parts.username or parts.password:
            raise ValueError("cannot use a url with a password in it; use token")
        if parts.query or parts.fragment:
            raise ValueError(f"cannot use url {url!r}; leave out what follows '?' or '#'")
        if self.token is not None and parts.scheme == "http" and not self.is_local:
            raise ValueError(f"cannot send a token to {url!r}: anyone could read it; use https://")
        if not 0 < self.timeout_s < float("inf"):
            raise ValueError(f"cannot use timeout_s {self.timeout_s:g}; use a number > 0")
        if not self.networks:
            raise ValueError(
                "cannot tell which ends of flows are devices: devices is empty; name the addresses "
                "or networks of the devices, such as 10.45.0.0/16"
            )

    @property
    def networks(self) -> tuple[IpNetwork, ...]:
        """What `devices` names.

        Raises:
            ValueError: something that is no network.
        """
        try:
            return tuple(ipaddress.ip_network(each, strict=False) for each in self.devices)
        except ValueError as error:
            raise ValueError(
                f"cannot use devices: {error}; use 10.45.0.0/16, for example"
            ) from None

    @property
    def is_local(self) -> bool:
        """Whether it is on this host."""
        host = urlsplit(self.url).hostname or ""
        return host == "localhost" or is_loopback(host)

    @property
    def scope(self) -> str:
        """What the server is told apart from others by, and where it is asked: a URL."""
        return self.url.rstrip("/")


def load_settings(path: str | Path) -> dict[str, ServerSettings]:
    """Read a settings file, YAML or JSON.

    Returns:
        By the names of their targets, those that the file has.

    Raises:
        SettingsError: it cannot be read, or a key or value is not allowed; says which.
    """
    types = {name: target_kind(name).settings_type for name in TARGETS}
    file = Path(path)
    keys = [(name, type_ | None, None) for name, type_ in types.items() if type_ is not None]
    file_type = msgspec.defstruct("Settings", keys, frozen=True, forbid_unknown_fields=True)
    try:
        data = read_regular(file, _MAX_BYTES + 1)
    except OSError as error:
        raise SettingsError(f"cannot read settings {str(path)!r}: {error.strerror}") from error
    if len(data) > _MAX_BYTES:
        raise SettingsError(f"cannot read settings {str(path)!r}: larger than {_MAX_BYTES} bytes")
    try:
        # JSON is YAML, and the keys of a JSON object are converted like those of YAML.
        plain = yaml.safe_load(data)
        found = msgspec.convert(plain, file_type, strict=False)
    except yaml.YAMLError as error:
        # Only where: the library's own text quotes the line, which may hold a pasted token.
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f" at line {mark.line + 1}, column {mark.column + 1}"
        raise SettingsError(f"cannot read settings {str(path)!r}: no YAML{where}") from None
    except msgspec.ValidationError as error:
        raise SettingsError(f"cannot use settings {str(path)!r}: {readable(error)}") from error
    except (ValueError, OverflowError, RecursionError):
        # Dates and numbers that are none, and what is nested deeper than Python goes.
        raise SettingsError(
            f"cannot read settings {str(path)!r}: it is nested too deep, or has a number or date "
            "that is none"
        ) from None
    servers = {name: each for name in types if (each := getattr(found, name, None)) is not None}
    for name, each in servers.items():
        if each.token is not None and each.token.file:
            token = Token(file=str(file.absolute().parent / each.token.file))
            servers[name] = replace(each, token=token)
    return servers


def readable(error: Exception) -> str:
    """Return msgspec's message with the path of the value in front, as we write paths."""
    text, separator, where = str(error).rpartition(" - at `")
    if not separator:
        return str(error)
    whose, _, path = where.strip("`").rpartition("` in `")
    return f"{'a key of ' if whose else ''}{path.lstrip('$.')}: {text}"


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


def is_gone(reply: httpx.Response) -> bool:
    """Whether there is no such thing (any more)."""
    return reply.status_code in (404, 410)


def read_answer(reply: httpx.Response, type_: type[_T]) -> _T:
    """Return the body of an answer, which must be JSON that fits a type.

    Raises:
        HttpError: it does not. The request may have taken effect.
    """
    try:
        return from_json(reply.content, type_, longest=_LARGEST_ANSWER)
    except ValueError as error:
        reason = readable(error)
        at_field = reason != str(error)
        raise unusable(reply, reason if at_field else f"its body: {reason}") from error


def unusable(reply: httpx.Response, reason: str) -> HttpError:
    """Return the error for an answer that is no use; `reason` names the field first."""
    return HttpError(
        f"cannot use the answer {reply.status_code} to {_asked(reply.request)}: {text_of(reason)}",
        status=reply.status_code,
        # Whatever the answer is worth, the server has taken the request.
        uncertain=True,
        hint="check that the url is that of such a server",
    )


def linked(reply: httpx.Response, url: str) -> str:
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
        raise unusable(reply, f"{url[:60]!r} is not a URL that ends in an id")
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
    ) -> httpx.Response:
        """Ask, and ask again where that is right; always back by the deadline.

        429 and 503 are asked again after Retry-After; 409 too, because a server may still be
        deleting what is in the way; other server errors and lost answers only where asking twice
        is the same as asking once. A connection that could not be made is tried again. 404 and 410
        are answers where it `may_be_gone`.

        Raises:
            HttpError: refused, or still not done after all patience.
        """
        headers = {
            "accept": "application/json, application/problem+json",
            # A few bytes packed well may be as many gigabytes unpacked.
            "accept-encoding": "identity",
            **({} if body is None else {"content-type": "application/json"}),
        }
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

    def _attempt(self, request: httpx.Request, *, may_be_gone: bool) -> httpx.Response:
        """Ask once.

        Raises:
            HttpError: refused, or there is no answer that can be read; says whether to ask again.
        """
        what = _asked(request)
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
            if reply.is_success or (may_be_gone and is_gone(reply)):
                return reply
            raise self._refusal(reply)
        again = request.method in _IDEMPOTENT or not sent
        raise HttpError(f"cannot {what}: {reason}", uncertain=sent, again=again)

    async def _ask(self, request: httpx.Request) -> httpx.Response:
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
        return httpx.Response(
            answer.status_code,
            headers=answer.headers,
            content=bytes(body),
            request=request,
            extensions=answer.extensions,
        )

    def _why_late(self) -> str:
        ended = self.patience.cancelled.is_set()
        return "it was ended before it was done" if ended else "no time left"

    def _refusal(self, answer: httpx.Response) -> HttpError:
        status = answer.status_code
        try:
            found = from_json(answer.content, _Problem, longest=_LARGEST_ANSWER)
        except ValueError:
            found = _Problem()
        # Some servers quote the credentials that they refuse.
        secret = "" if self._token is None else self._token.reveal()

        def first(*values: object) -> str:
            return next(filter(None, (text_of(each, secret) for each in values)), "")

        words = [
            f"{status} {text_of(answer.reason_phrase, secret)}".strip(),
            first(found.cause, found.code),
            first(found.detail, found.message, found.title),
        ]
        lost, twice = status in _PASSING, answer.request.method in _IDEMPOTENT
        forbidden = status in (401, 403)
        return HttpError(
            f"cannot {_asked(answer.request)}: {': '.join(filter(None, words))}",
            status=status,
            uncertain=lost and not twice,
            again=status in _ALWAYS_AGAIN or (lost and twice),
            after_s=_retry_after_s(answer.headers.get("retry-after", ""), self.patience.now_s()),
            hint="check the token and what it is allowed to do" if forbidden else "",
        )


def _asked(request: httpx.Request) -> str:
    return f"{request.method} {request.url}"


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
