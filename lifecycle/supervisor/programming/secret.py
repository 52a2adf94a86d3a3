"""Credentials: where they come from, and that they go nowhere but into a request.

Owns: tokens. They are read from the environment or a file at the moment they are needed, so that a
rotated one is taken up, and no object here holds one that a log or a traceback could show.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Mapping
from pathlib import Path

import msgspec

from lifecycle.supervisor.programming.errors import SettingsError

_MAX_BYTES = 64 * 1024


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

    def reveal(self, environment: Mapping[str, str] | None = None) -> str:
        """Return the token itself.

        Raises:
            SettingsError: it is not there, or is no token; its text is never quoted.
        """
        if self.env:
            text = (os.environ if environment is None else environment).get(self.env, "")
            where = f"environment variable {self.env}"
        else:
            where = f"file {self.file!r}"
            try:
                text = read_file(self.file, _MAX_BYTES).decode("ascii")
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
