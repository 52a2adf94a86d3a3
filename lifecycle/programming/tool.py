"""Runs nft and tc: bounded, asked in English, each refusal as one sentence.

Owns: what their refusals mean, such as a missing privilege; and the qdiscs that tc lists.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
from collections.abc import Sequence

import msgspec

from lifecycle.codec import from_json
from lifecycle.programming.target import ProgrammingError
from lifecycle.run_directory import OWN_CHILD

_TIMEOUT_S = 10.0
"""They talk to the kernel only; a busy machine needs tenths of a second."""

_PACKAGES = {"nft": "nftables", "tc": "iproute2"}

HOW_PRIVILEGED = (
    "run this command as root, or give it that capability: in a container --cap-add NET_ADMIN, in "
    "a systemd unit AmbientCapabilities=CAP_NET_ADMIN"
)
"""Root is not enough where the capability was taken away: capabilities(7)."""

_NO_PRIVILEGE = re.compile(r"operation not permitted|permission denied|must be root", re.IGNORECASE)

Output = subprocess.CompletedProcess[str]
"""What a program left."""


class HostTool:
    """Programs of this host.

    Args:
        prefix: arguments before each command line, such as `ip netns exec robot`.
    """

    def __init__(self, prefix: Sequence[str] = ()) -> None:
        self._prefix = tuple(prefix)

    def run(self, argv: Sequence[str], *, stdin: str = "") -> Output:
        """Run a program to its end and return what it left, whatever its exit code.

        Raises:
            ProgrammingError: it is not installed, or does not end.
        """
        # Distributions keep these in sbin, which is not on every user's path.
        path = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
        try:
            with OWN_CHILD:
                return subprocess.run(
                    [*self._prefix, *argv],
                    input=stdin,
                    capture_output=True,
                    text=True,
                    errors="backslashreplace",
                    timeout=_TIMEOUT_S,
                    check=False,
                    env={**os.environ, "LC_ALL": "C", "PATH": path},
                )
        except FileNotFoundError as error:
            program = str(error.filename or argv[0])
            package = _PACKAGES.get(program, program)
            raise ProgrammingError(
                f"cannot run {program!r}: it is not installed",
                hint=f"install it: apt-get install {package}",
            ) from error
        except subprocess.TimeoutExpired as error:
            raise ProgrammingError(
                f"cannot finish {shlex.join(argv)!r}: it still ran after {_TIMEOUT_S:g} s"
            ) from error
        except OSError as error:
            raise ProgrammingError(f"cannot run {shlex.join(argv)!r}: {error.strerror}") from error


def demand(tool: HostTool, argv: Sequence[str], *, doing: str, stdin: str = "") -> str:
    """Run a program that has to succeed and return what it printed.

    Args:
        tool: runs it.
        argv: the command line.
        doing: what fails with it, to follow "cannot": "write nftables table inet flowqos_x".
        stdin: what it reads.

    Raises:
        ProgrammingError: see `failure`.
    """
    output = tool.run(argv, stdin=stdin)
    if output.returncode == 0:
        return output.stdout
    raise failure(output, argv, doing=doing)


class Qdisc(msgspec.Struct, frozen=True, kw_only=True):
    """What is read of a queueing discipline in the list of `tc -j qdisc show`."""

    kind: str
    dev: str = ""
    handle: str = "0:"
    root: bool = False


def qdiscs(tool: HostTool, *options: str, doing: str) -> tuple[Qdisc, ...]:
    """Return the queueing disciplines that `tc -j qdisc show` lists.

    Args:
        tool: runs it.
        options: which ones, such as `dev eth0`.
        doing: what fails with it, to follow "cannot".

    Raises:
        ProgrammingError: it failed, or what it prints is no such list.
    """
    argv = ("tc", "-j", "qdisc", "show", *options)
    text = demand(tool, argv, doing=doing)
    try:
        return from_json(text.strip() or "[]", tuple[Qdisc, ...])
    except ValueError as error:
        raise ProgrammingError(
            f"cannot {doing}: what {shlex.join(argv)!r} prints is no list of qdiscs: {error}",
            hint="look at what it prints, and which program that is",
        ) from error


def failure(output: Output, argv: Sequence[str], *, doing: str) -> ProgrammingError:
    """Return the error that a failed program means: a missing privilege, or what it says itself."""
    command = shlex.join(argv)
    printed = filter(None, map(str.strip, output.stderr.splitlines()))
    said = next(printed, f"exit code {output.returncode}")
    if _NO_PRIVILEGE.search(output.stderr):
        return ProgrammingError(
            f"cannot {doing}: {command!r} needs CAP_NET_ADMIN in this network namespace",
            hint=HOW_PRIVILEGED,
        )
    return ProgrammingError(f"cannot {doing}: {command!r} says {said!r}")
