"""Read a YAML file safely: regular files only, size limit, encoding; then parse it.

Owns: every way in which a path may be no readable text; `compose` owns what the text may hold.
Reading is bounded in time and memory: nothing but a regular file is read, and of that at most one
byte over the limit. Touches the file system; knows nothing of what a manifest means.
"""

from __future__ import annotations

import contextlib
import os
import re
import stat
from collections.abc import Mapping
from pathlib import Path

from lifecycle.manifest.diagnostics import ManifestError, Position
from lifecycle.manifest.yaml.document import Document, error
from lifecycle.manifest.yaml.yaml_parser import EMPTY, compose, quote

MAX_BYTES = 1 << 20
"""Size limit of one file, 1 MiB."""

_NOT_TEXT = re.compile(
    "[\0-\x08\x0b\x0c\x0e-\x1f\x7f-\x84\x86-\x9f]|[\ud800-\udfff]|[\ufffe\uffff]"
)
"""Characters that YAML 1.2.2 §5.1 does not allow in a document; one set of all takes 3 ms."""


def read_document(path: str | Path, *, shown: str = "") -> Document:
    """Read one file as a YAML document whose root is a mapping.

    Args:
        path: the file.
        shown: how messages name the file; the path itself if empty.

    Raises:
        ManifestError: with the one reason why it cannot be read, or all doubled keys, tags and
            impossible numbers at once.
    """
    file = shown or str(path)
    text = decode(read_bytes(path, file=file), file=file)
    return parse(text, file=file)


def parse(text: str, *, file: str) -> Document:
    """Parse text as a YAML document whose root is a mapping.

    Raises:
        ManifestError: see `read_document`.
    """
    document, findings = compose(text, file=file)
    if findings:
        raise ManifestError(findings)
    plain = document.root.data
    if not isinstance(plain, Mapping):
        at = document.at()
        if plain is None:
            raise ManifestError([error("yaml.empty", at, EMPTY, _START)])
        message = f"cannot use {quote(plain)} as a whole document; it must be a mapping of keys"
        raise ManifestError([error("yaml.root", at, message, _START)])
    return document


_READ = os.O_RDONLY
for _flag in ("O_NONBLOCK", "O_CLOEXEC", "O_BINARY"):  # a platform has those that it needs
    # O_NONBLOCK: opening a FIFO without a writer must not wait for one.
    _READ |= getattr(os, _flag, 0)

_START = "start with 'manifest_version: 1'"


def read_bytes(path: str | Path, *, file: str) -> bytes:
    """Read a regular file of at most `MAX_BYTES`.

    Raises:
        ManifestError: missing, unreadable, not a regular file, or too large.
    """
    try:
        descriptor = os.open(path, _READ)
    except (OSError, ValueError) as problem:
        reason = problem.strerror if isinstance(problem, OSError) else str(problem)
        raise _refuse(file, f"cannot open {quote(str(path), limit=200)}: {reason}") from problem
    status = os.fstat(descriptor)
    mode = status.st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        raise _refuse(file, f"cannot read {_kind(mode)} as a manifest", "name a regular file")
    if status.st_dev in _kernel_devices():
        os.close(descriptor)
        message = "cannot read a file that the kernel makes up (/proc, /sys) as a manifest"
        raise _refuse(file, message, "name a regular file")
    with os.fdopen(descriptor, "rb") as stream:
        try:
            data: bytes | None = stream.read(MAX_BYTES + 1)
        except OSError as problem:  # a network file system, a broken disk, much of /proc
            raise _refuse(file, f"cannot read this file: {problem.strerror}") from problem
        if data is None:  # O_NONBLOCK: /proc/kmsg and its like never end, they wait
            raise _refuse(
                file,
                "cannot read a file that has no end and nothing to read",
                "name a regular file",
            )
        if len(data) > MAX_BYTES:
            size = max(os.fstat(descriptor).st_size, len(data))
            raise _refuse(
                file,
                f"cannot read a file of {size} bytes; at most {MAX_BYTES} are allowed",
                "split it with 'include:'",
            )
    return data


def _kernel_devices() -> set[int]:
    """Where every file claims to be a regular one; reading /proc/kmsg waits, and takes away."""
    found = set()
    for each in ("/proc", "/sys"):
        with contextlib.suppress(OSError):
            found.add(os.stat(each).st_dev)  # noqa: PTH116 - of a text
    return found


def decode(data: bytes, *, file: str) -> str:
    """Decode UTF-8, with or without byte order mark, and refuse what is no text.

    Raises:
        ManifestError: not UTF-8, a NUL byte, or a control character.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        before = data[: problem.start].decode("utf-8-sig", errors="replace")
        byte = f"0x{data[problem.start]:02x}"
        message = f"cannot read byte {byte} as UTF-8: {problem.reason}"
        raise _refuse(file, message, "save the file as UTF-8", before) from problem
    match = _NOT_TEXT.search(text)
    if match:
        name = "a NUL byte" if match[0] == "\0" else f"the control character U+{ord(match[0]):04X}"
        raise _refuse(file, f"cannot read {name}", "remove it", text[: match.start()])
    return text


def _refuse(file: str, message: str, hint: str = "", before: str = "") -> ManifestError:
    line = before.count("\n") + 1
    column = len(before) - (before.rfind("\n") + 1) + 1
    at = Position(file=file, line=line, column=column)
    return ManifestError([error("yaml.file", at, message, hint)])


def _kind(mode: int) -> str:
    kinds = (
        (stat.S_ISDIR, "a directory"),
        (stat.S_ISFIFO, "a FIFO"),
        (stat.S_ISSOCK, "a socket"),
        (stat.S_ISCHR, "a character device"),
        (stat.S_ISBLK, "a block device"),
    )
    return next((name for test, name in kinds if test(mode)), "a special file")
