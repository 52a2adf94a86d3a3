"""Servers that are reached over HTTP: their settings file, and one request at a time.

A token is read at the moment it is needed, goes to one server only and into no log. No server holds
a request up past its deadline; a refusal, and an answer that cannot be used, is an `HttpError` that
names the request and the field.
"""

from __future__ import annotations

import asyncio
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
from lifecycle.programming.target import HttpError, Means, ProgrammingError, SettingsError
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


_S = TypeVar("_S", bound=ServerSettings)


def load_settings(path: str | Path, key: str, type_: type[_S]) -> _S | None:
    """Read what a settings file, YAML or JSON, has of one target; None if nothing.

    Raises:
        SettingsError: it cannot be read, or a key or value is not allowed; says which.
    """
    file = Path(path)
    try:
        data = read_regular(file, _MAX_BYTES + 1)
    except OSError as error:
        raise SettingsError(f"cannot read settings {str(path)!r}: {error.strerror}") from error
    if len(data) > _MAX_BYTES:
        raise SettingsError(f"cannot read settings {str(path)!r}: larger than {_MAX_BYTES} bytes")
    try:
        # JSON is YAML, and the keys of a JSON object are converted like those of YAML.
        found = msgspec.convert(yaml.safe_load(data), dict[str, Any], strict=False).get(key)
        settings = msgspec.convert(found, type_ | None, strict=False)
    except msgspec.ValidationError as error:
        text = readable(error, key)
        raise SettingsError(f"cannot use settings {str(path)!r}: {text}") from error
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        # Only where: the library's own text quotes the line, which may hold a pasted token.
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f" at line {mark.line + 1}, column {mark.column + 1}"
        raise SettingsError(f"cannot read settings {str(path)!r}: no YAML{where}") from None
    if settings is None or settings.token is None or not settings.token.file:
        return settings
    token = Token(file=str(file.absolute().parent / settings.token.file))
    return replace(settings, token=token)


def readable(error: Exception, root: str = "") -> str:
    """Return msgspec's message with the path of the value in front, below `root`."""
    text, separator, where = str(error).rpartition(" - at `")
    if not separator:
        return f"{root}: {error}" if root else str(error)
    whose, _, path = where.strip("`").rpartition("` in `")
    path = path.replace("$", root, 1).lstrip(".")
    return f"{'a key of ' if whose else ''}{path}: {text}"


ID_PATTERN = r"^[!-~]{1,512}$"
"""The id of a subscription or a session; CAMARA's are UUIDs."""

_AGAIN = frozenset({409, 429, 503})
"""In the way of 409 may be what a server still deletes; the others ask to wait."""

_PAUSES_S = (0.5, 1.0, 2.0, 4.0)
"""Before a request is sent again, unless the server says how long."""

_LONGEST_PAUSE_S = 60.0
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

    Raises:
        ProgrammingError: httpx, the extra `networks`, is not installed.
    """

    def __init__(self, settings: ServerSettings, means: Means) -> None:
        self.url = settings.scope
        if httpx is None:
            raise ProgrammingError(
                f"cannot reach {self.url}: httpx is not installed",
                hint="install it: pip install 'ros-lifecycle-manifests[networks]'",
            )
        self._token = settings.token
        self._timeout_s = settings.timeout_s
        self._means = means
        self._certificates = httpx.create_ssl_context()

    async def request(
        self,
        method: str,
        path: str,
        body: Mapping[str, object] | None = None,
        *,
        may_be_gone: bool = False,
    ) -> httpx.Response:
        """Ask, and again after 409, 429 and 503, after Retry-After if the server says it.

        404 and 410 are answers where it `may_be_gone`.

        Raises:
            HttpError: refused, or not answered in time.
        """
        for pause_s in (*_PAUSES_S, None):
            reply = await self._attempt(method, path, body)
            if reply.is_success or (may_be_gone and is_gone(reply)):
                break
            refusal = self._refusal(reply)
            if reply.status_code not in _AGAIN or pause_s is None:
                raise refusal
            after = reply.headers.get("retry-after", "").strip()
            wait_s = float(after[:9]) if after.isascii() and after.isdigit() else pause_s
            left_s = min(_LONGEST_PAUSE_S, self._means.left_s())
            if wait_s > left_s:
                refusal.hint = f"it is to be asked again in {wait_s:g} s, not within {left_s:.0f} s"
                raise refusal
            await asyncio.sleep(wait_s)
        return reply

    async def _attempt(
        self, method: str, path: str, body: Mapping[str, object] | None
    ) -> httpx.Response:
        """Ask once.

        Raises:
            HttpError: there is no answer that can be read.
        """
        headers = {
            "accept": "application/json, application/problem+json",
            # A few bytes packed well may be as many gigabytes unpacked.
            "accept-encoding": "identity",
        }
        # Revealed for this attempt only: a token that is changed meanwhile is taken up.
        if self._token is not None:
            headers["authorization"] = f"Bearer {self._token.reveal()}"
        if body is not None:
            headers["content-type"] = "application/json"
        sent = False

        async def trace(event: str, _: Mapping[str, Any]) -> None:
            """Note that the server may have taken the request, by httpx's extension `trace`."""
            nonlocal sent
            sent = sent or event.endswith("send_request_headers.started")

        request = httpx.Request(
            method,
            f"{self.url}{path}",
            headers=headers,
            content=None if body is None else to_json(body),
            extensions={"trace": trace},
        )
        limit_s = min(self._timeout_s, self._means.left_s())
        try:
            return await asyncio.wait_for(self._answer(request), limit_s)
        except (TimeoutError, asyncio.TimeoutError):
            reason = f"no {'whole answer' if sent else 'connection'} in time ({limit_s:.3g} s)"
        except httpx.TransportError as error:
            reason = _why(error)
        except Exception as error:  # noqa: BLE001 - whatever a library makes of unexpected bytes
            # Never its own message, which may quote the request.
            reason = f"its answer is no HTTP that can be read ({type(error).__name__})"
        raise HttpError(f"cannot {_asked(request)}: {reason}", uncertain=sent)

    async def _answer(self, request: httpx.Request) -> httpx.Response:
        """Send a request and read its answer, of which no more than can be of use.

        Raises:
            httpx.HTTPError: there is none, or it is packed.
        """
        body = bytearray()
        # No redirect and no proxy: either could carry the token elsewhere.
        client = httpx.AsyncClient(
            follow_redirects=False, timeout=None, verify=self._certificates, trust_env=False
        )
        async with client:
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
        forbidden = status in (401, 403)
        return HttpError(
            f"cannot {_asked(answer.request)}: {': '.join(filter(None, words))}",
            status=status,
            uncertain=status >= 500 and status not in _AGAIN,
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


def _why(error: httpx.TransportError) -> str:
    """Return the kernel's reason where there is one: "Connection refused"."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and (cause.errno or 0) > 0:
            return os.strerror(cause.errno or 0)
        cause = cause.__cause__ or cause.__context__
    return text_of(str(error)) or type(error).__name__
