"""The settings file of the targets that are reached over HTTP.

Owns: the keys that all of them have, and how it is read; the others are their targets'. Never
holds a credential, only where one is: tokens are read from the environment or a file at the moment
they are needed, so that a rotated one is taken up, and no object here holds one that a log or a
traceback could show.
"""

from __future__ import annotations

import errno
import ipaddress
import os
import stat
from pathlib import Path
from urllib.parse import urlsplit

import msgspec
import yaml

from lifecycle.network.nfe import is_loopback
from lifecycle.programming import TARGETS
from lifecycle.programming.target import SettingsError, target_kind

_MAX_BYTES = 256 * 1024
_MAX_TOKEN_BYTES = 64 * 1024

IpNetwork = ipaddress.IPv4Network | ipaddress.IPv6Network


def read_file(path: str | Path, most: int) -> bytes:
    """Return the first `most` bytes of a regular file, without ever waiting for a writer.

    Raises:
        OSError: it cannot be read, or is a pipe, a device or anything else that is no file.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(descriptor, "rb") as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "it is not a regular file")
        return file.read(most)


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
                text = read_file(self.file, _MAX_TOKEN_BYTES).decode("ascii")
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
        self._check_url()
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

    def _check_url(self) -> None:
        """A URL that a token may be sent to: https, or this host."""
        url, parts = self.url, urlsplit(self.url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise ValueError(f"cannot use url {url!r}; use http:// or https:// and a host")
        if parts.username or parts.password:
            raise ValueError("cannot use a url with a password in it; use token")
        if parts.query or parts.fragment:
            raise ValueError(f"cannot use url {url!r}; leave out what follows '?' or '#'")
        if self.token is not None and parts.scheme == "http" and not self.is_local:
            raise ValueError(f"cannot send a token to {url!r}: anyone could read it; use https://")


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
        data = read_file(file, _MAX_BYTES + 1)
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
    servers = {name: getattr(found, name) for name, *_ in keys}
    folder = file.absolute().parent
    return {name: _beside(each, folder) for name, each in servers.items() if each is not None}


def _beside(settings: ServerSettings, folder: Path) -> ServerSettings:
    """Make the file of a token one beside the settings file."""
    if settings.token is None or not settings.token.file:
        return settings
    token = Token(file=str(folder / settings.token.file))
    return msgspec.structs.replace(settings, token=token)


def readable(error: Exception) -> str:
    """Return msgspec's message with the path of the value in front, as we write paths."""
    text, separator, where = str(error).rpartition(" - at `")
    if not separator:
        return str(error)
    whose, _, path = where.strip("`").rpartition("` in `")
    return f"{'a key of ' if whose else ''}{path.lstrip('$.')}: {text}"
