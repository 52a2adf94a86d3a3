"""Substitutions `$(…)` in values: their syntax, nested too; files read and programs run for them.

Owns: the text of a value taken apart (`parse_text`), what `$(find-pkg-share …)`, `$(file …)` and
`$(command …)` read from outside, each bounded in time and size, and the words of conditions. A
program is run by no shell, once in a load however often it is written. Nothing is computed.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import IO

import msgspec

from lifecycle.errors import LifecycleError, did_you_mean
from lifecycle.manifest.diagnostics import ManifestError
from lifecycle.manifest.installed_types import find_resource, list_resources, search_prefixes
from lifecycle.manifest.yaml.document import quote
from lifecycle.manifest.yaml.source import MAX_BYTES, decode, read_bytes

MAX_DEPTH = 8
"""Substitutions inside each other."""

COMMAND_S = 10.0
"""Seconds that one program may take."""

ALLOWED = (
    "write $(arg NAME), $(env NAME), $(env NAME DEFAULT), $(find-pkg-share PACKAGE), $(file PATH), "
    "$(command PROGRAM …), $(equals A B), $(not-equals A B), $(not A), $(and A B) or $(or A B), "
    "a word that is empty or has spaces in quotes; $$( is a literal $("
)

_WORDS: Mapping[str, tuple[int, int | None]] = {
    "arg": (1, 1),
    "env": (1, 2),
    "find-pkg-share": (1, 1),
    "file": (1, 1),
    "command": (1, None),
    "not": (1, 1),
    "and": (2, None),
    "or": (2, None),
    "equals": (2, 2),
    "not-equals": (2, 2),
}
"""Fewest and most words that follow a kind; None for any number."""

_KIND = re.compile(r"\s*([^\s()$'\"]*)")
_SPACE = re.compile(r"\s*")
Text = tuple["str | Substitution", ...]
"""Text of a value in its parts."""


class Substitution(msgspec.Struct, frozen=True, kw_only=True):
    """One `$(…)`.

    Attributes:
        kind: `arg`, `command`, ….
        written: as it is written.
        words: what follows the kind, as many as it takes.
    """

    kind: str
    written: str
    words: tuple[Text, ...]


def parse_text(text: str) -> Text:
    """Take a value's text apart.

    Raises:
        LifecycleError: what is wrong with a substitution in it.
    """
    parts, _ = _parse(text, 0, "", 0)
    return parts


def _parse(text: str, at: int, end: str, depth: int) -> tuple[Text, int]:
    """Return what precedes one of the characters `end`, and where that is."""
    parts: list[str | Substitution] = []
    begin = at
    while at < len(text) and text[at] not in end:
        if text.startswith("$$(", at):
            parts.append(f"{text[begin:at]}$(")
            begin = at = at + 3
        elif text.startswith("$(", at):
            parts.append(text[begin:at])
            found, at = _substitution(text, at, depth + 1)
            parts.append(found)
            begin = at
        else:
            at += 1
    parts.append(text[begin:at])
    return tuple(each for each in parts if each), at


def _substitution(text: str, begin: int, depth: int) -> tuple[Substitution, int]:
    """Read a kind and its words, in quotes or not, up to the closing parenthesis."""
    if depth > MAX_DEPTH:
        raise LifecycleError(f"cannot substitute more than {MAX_DEPTH} levels inside each other")
    match = _KIND.match(text, begin + 2)
    assert match is not None
    kind, at = match[1], match.end()
    words: list[Text] = []
    least, most = _WORDS.get(kind, (0, 0))
    while True:
        space = _SPACE.match(text, at)
        assert space is not None
        at = space.end()
        mark = text[at : at + 1]
        if kind in _WORDS and mark == ")" and least <= len(words) <= (most or len(words)):
            written = text[begin : at + 1]
            return Substitution(kind=kind, written=written, words=tuple(words)), at + 1
        if kind not in _WORDS or mark in ("", "(", ")"):
            whole = text[begin : _closing(text, begin)]
            raise LifecycleError(f"cannot substitute {quote(whole)}", hint=ALLOWED)
        is_quoted = mark in "'\""
        word, at = _parse(text, at + is_quoted, mark if is_quoted else " \t\r\n()", depth)
        if is_quoted and at >= len(text):
            message = f"cannot find the closing {mark} in {quote(text[begin:])}"
            raise LifecycleError(message)
        at += is_quoted
        words.append(word)


def _closing(text: str, begin: int) -> int:
    """Return where a substitution that is none ends, for messages."""
    open_ = 0
    for at in range(begin, len(text)):
        open_ += {"(": 1, ")": -1}.get(text[at], 0)
        if open_ == 0 and text[at] == ")":
            return at + 1
    return len(text)


def truth(text: str) -> bool | None:
    """Return what a condition's text means, as launch reads it; None if it means neither."""
    return {"true": True, "1": True, "false": False, "0": False}.get(text.strip().lower())


def decide(kind: str, words: list[str], written: str) -> bool:
    """Return what a `$(not …)`, `$(equals …)` and the others say."""
    if kind in ("equals", "not-equals"):
        return (words[0] == words[1]) == (kind == "equals")
    truths = [truth(each) for each in words]
    if None in truths:
        word = quote(words[truths.index(None)])
        message = f"cannot use {word} in {quote(written)}; allowed: true, false, 1, 0"
        raise LifecycleError(message)
    if kind == "not":
        return not truths[0]
    return all(truths) if kind == "and" else any(truths)


class NotRunError(LifecycleError):
    """A value that a program would write, where none may be run."""


class Programs:
    """What programs have written, each run once in a load.

    Args:
        environment: of the programs.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        self._environment = dict(environment)
        self._ran: dict[tuple[str, ...], str | LifecycleError] = {}

    def output(self, words: list[str], folder: str) -> str:
        """Return what a program writes to its standard output, without the last line break.

        No shell reads `words`; `folder` is where it starts, and where a relative program is.

        Raises:
            LifecycleError: it is not there, fails, takes too long, or writes too much or no text.
        """
        key = (folder, *words)
        if key not in self._ran:
            try:
                self._ran[key] = self._run(words, folder)
            except LifecycleError as problem:
                self._ran[key] = problem
        found = self._ran[key]
        if isinstance(found, LifecycleError):
            raise found
        return found

    def _run(self, words: list[str], folder: str) -> str:
        name = words[0]
        if not hasattr(os, "killpg"):
            raise LifecycleError(f"cannot run {quote(name)}: $(command …) needs Linux or macOS")
        # With a slash it is a path, else it is looked for on PATH: as execvp does.
        path = os.path.join(folder, name) if "/" in name else name  # noqa: PTH118
        program = shutil.which(path, path=self._environment.get("PATH"))
        if program is None:
            where = "there is no such program" if "/" in name else "no such program on PATH"
            hint = "each word is one argument: write $(command PROGRAM ARGUMENT …)"
            if " " not in name:
                hint = "install it, or source the setup file of its workspace"
            raise LifecycleError(f"cannot run {quote(name)}: {where}", hint=hint)
        with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
            try:
                process = subprocess.Popen(
                    [os.path.abspath(program), *words[1:]],  # noqa: PTH100
                    cwd=folder,
                    env=self._environment,
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=err,
                    start_new_session=True,
                )
            except (OSError, ValueError) as problem:
                why = getattr(problem, "strerror", None) or problem
                raise LifecycleError(f"cannot run {quote(name)}: {why}") from problem
            try:
                _await_end(process, (out, err), name)
            finally:
                # Whatever it has started ends with it, before its group's number can be another's.
                with contextlib.suppress(OSError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            written, said = (os.pread(each.fileno(), MAX_BYTES, 0) for each in (out, err))
        shown = quote(" ".join(words), limit=200)
        if process.returncode:
            last = said.decode("utf-8", "replace").strip().splitlines()[-1:]
            ended = (
                f"exit status {process.returncode}"
                if process.returncode > 0
                else f"signal {-process.returncode}"
            )
            why = f": {quote(last[0], limit=300)}" if last else ""
            hint = f"run it: {shlex.join(words)}"
            raise LifecycleError(f"cannot use {shown}: it ended with {ended}{why}", hint=hint)
        try:
            return _without_last_break(decode(written, file=name))
        except ManifestError as problem:
            message = problem.diagnostics[0].message.removeprefix("cannot read ")
            raise LifecycleError(f"cannot use what {shown} writes: {message}") from problem


def _await_end(process: subprocess.Popen[bytes], files: Iterable[IO[bytes]], name: str) -> None:
    """Wait for the end of a program, within the limits of time and of what it writes."""
    deadline = time.monotonic() + COMMAND_S
    while True:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(0.05)
        if any(os.fstat(each.fileno()).st_size > MAX_BYTES for each in files):
            message = f"cannot use {quote(name)}: it writes more than {MAX_BYTES} bytes"
            raise LifecycleError(message)
        if process.returncode is not None:
            return
        if time.monotonic() > deadline:
            message = f"cannot wait for {quote(name)}: it takes more than {COMMAND_S:g} s"
            raise LifecycleError(message)


def _without_last_break(text: str) -> str:
    return text.removesuffix("\n").removesuffix("\r")


class Surroundings(msgspec.Struct, frozen=True, kw_only=True):
    """What substitutions of one document read from outside.

    Attributes:
        environment: variables, and AMENT_PREFIX_PATH with them.
        folder: what relative paths start from, where programs are started.
        programs: None: none is run.
    """

    environment: Mapping[str, str]
    folder: str
    programs: Programs | None

    def package_share(self, name: str) -> str:
        """Return `PREFIX/share/NAME` of a package; LifecycleError if no prefix has it."""
        prefixes = search_prefixes(self.environment)
        found = None
        if name and "/" not in name and "\0" not in name:
            found = find_resource("packages", name, prefixes)
        if found is None:
            hint = did_you_mean(name, list_resources("packages", prefixes))
            raise LifecycleError(
                f"cannot find the package {quote(name)}",
                hint=hint or "source the setup file of the workspace that holds it",
            )
        # PREFIX/share/ament_index/resource_index/packages/NAME
        return str(found.parents[3] / name)

    def file(self, path: str) -> str:
        """Return a file's text, without the last line break.

        Raises:
            LifecycleError: there is none, it is too long, or it is no text.
        """
        full = os.path.join(self.folder, path)  # noqa: PTH118
        try:
            text = decode(read_bytes(full, file=path), file=path)
        except ManifestError as problem:
            found = problem.diagnostics[0]
            reason = found.message.removeprefix("cannot read ").replace(" as a manifest", "")
            if found.message.startswith("cannot open "):
                reason = found.message.rpartition(": ")[2]
            elif (found.at.line, found.at.column) != (1, 1):
                reason = f"line {found.at.line}: {reason}"
            raise LifecycleError(f"cannot read {quote(path, limit=200)}: {reason}") from problem
        return _without_last_break(text)


def folder_of(path: Path) -> str:
    """Return the folder of a file so that a program's working directory does not matter."""
    return os.path.abspath(path.parent)  # noqa: PTH100 - a link stays the path that users know
