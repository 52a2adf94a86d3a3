"""Processes of this host: which of them a participant is of, and how each was started (proc(5)).

Owns: what a GUID prefix of Fast DDS says. It writes its vendor, the host, the process and a number
of its own into the first 16 hex digits (GuidPrefix_t::create); all participants of a process share
them. And which environment variables of a process matter to who starts it again. Must not import
rclpy.

Anybody can serve `~/get_configuration`. So each process whose nodes report their configuration
holds an abstract Unix socket (unix(7)) that is named by these digits. It ends with the process, and
leaves no file. A program of this machine that sets out to pass for one of ours can bind such a
name, too; one on another machine, or in another network namespace, cannot.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import socket
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec.structs import replace

if TYPE_CHECKING:  # nodes ask for prefixes, and capture nothing
    from lifecycle.export.programs import CapturedProgram

_HOST_DIGITS = slice(4, 8)
_PID_DIGITS = slice(8, 12)
PROCESS_DIGITS = 16


def is_of_process(prefix: str, pid: int, like: str) -> bool:
    """Return whether a participant may be one of a process of this host, by its GUID prefix.

    Fast DDS keeps the lower 16 bits of a pid: False is certain, True is not.

    Args:
        prefix: 24 hex digits.
        pid: of the process.
        like: the prefix of a participant on this host.
    """
    written = (pid & 0xFFFF).to_bytes(2, "little").hex()
    return is_of_host(prefix, like) and prefix[_PID_DIGITS] == written


def is_of_host(prefix: str, like: str) -> bool:
    """Return whether a participant is one of the host of another, by their GUID prefixes."""
    return prefix[: _HOST_DIGITS.stop] == like[: _HOST_DIGITS.stop]


_held: dict[str, socket.socket] = {}


def vouch_for(prefix: str) -> None:
    """Show that a participant of this process is of a node in our host, if its prefix is known."""
    name = _name(prefix)
    if not prefix or name in _held:
        return
    held = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        held.bind(name)
    except OSError:  # no Unix sockets here, or the name is taken: then nothing is shown
        held.close()
    else:
        _held[name] = held


def is_vouched_for(prefix: str) -> bool:
    """Return whether a process of this machine says so of a participant, by its GUID prefix."""
    with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)) as asking:
        return asking.connect_ex(_name(prefix)) == 0


def _name(prefix: str) -> str:
    return f"\0lifecycle-host-{prefix[:PROCESS_DIGITS]}"


_LONGEST_VALUE = 8192

_OF_A_SESSION = re.compile(
    "_|_ROS_WHEELS_.*|LIFECYCLE_.*|SHLVL|PWD|OLDPWD|SHELL|HOME|USER|LOGNAME|MAIL|HOSTNAME|LANG|LC_.*"
    "|TERM|TERM_.*|COLORTERM|COLUMNS|LINES|LS_COLORS|LESS.*|PAGER|EDITOR|VISUAL|PS[1-4]|PROMPT.*"
    "|MANPATH|INFOPATH"
    "|HIST.*|VTE_.*|KONSOLE_.*|GNOME_.*|WINDOWID|WINDOWPATH|TMUX.*|STY|SSH_.*|XDG_.*|DBUS_.*|GPG_.*"
    "|DESKTOP_.*|SESSION_.*|DISPLAY|WAYLAND_DISPLAY|XAUTHORITY|INVOCATION_ID|JOURNAL_STREAM"
    "|SYSTEMD_.*|NOTIFY_SOCKET|WATCHDOG_.*|MANAGERPID|LISTEN_.*|SUDO_.*|VIRTUAL_ENV_PROMPT"
    "|PYTEST_.*|ROS_DOMAIN_ID|ROS_AUTOMATIC_DISCOVERY_RANGE|ROS_LOG_DIR"
)
"""Variables of a login, of who started it, or that a manifest says otherwise."""

_PATHS = ("PATH", "LD_LIBRARY_PATH")
"""Lists of folders that matter only by what they have and we have not, in whatever order."""

_ROS_LIBRARY = re.compile(r"/lib(rmw|rcl|fastrtps|fastdds|ddsc|zenohc)[^/]*\.so")


def programs_of(
    participants: Iterable[str], own: str, environment: Mapping[str, str]
) -> dict[str, CapturedProgram]:
    """Return how the processes of participants on this host were started, by GUID prefix.

    Args:
        participants: GUID prefixes, 24 hex digits each.
        own: that of a participant of this process.
        environment: variables that differ from these are reported.
    """
    pids = tuple(int(each.name) for each in Path("/proc").iterdir() if each.name.isdecimal())
    found = {}
    for prefix in dict.fromkeys(participants):
        fits = [pid for pid in pids if is_of_process(prefix, pid, own) and _speaks_ros(pid)]
        programs = [each for pid in fits if (each := read_program(pid, environment))]
        # Fast DDS keeps 16 bits of a pid: of two that fit it is not known which it is.
        if len(programs) == 1:
            found[prefix] = programs[0]
    return found


def read_program(pid: int, environment: Mapping[str, str]) -> CapturedProgram | None:
    """Return how a process was started; None where that cannot be read or written down."""
    from lifecycle.export.programs import CapturedProgram
    from lifecycle.plan.processes import shown

    folder = Path(f"/proc/{pid}")
    try:
        words = (folder / "cmdline").read_bytes().split(b"\0")[:-1]
        argv = tuple(each.decode() for each in words)
        variables = _variables((folder / "environ").read_bytes())
        directory = str((folder / "cwd").readlink())
        executable = str((folder / "exe").readlink())
    except (OSError, UnicodeDecodeError):
        return None
    if not argv or not argv[0]:
        return None
    differing = {
        name: value
        for name, value in variables.items()
        if _matters(name, value, environment.get(name))
    }
    withheld = tuple(
        sorted(
            each
            for each, value in differing.items()
            if shown(each, value) != value or len(value) > _LONGEST_VALUE
        )
    )
    program = _program(argv[0], directory, variables.get("PATH", os.defpath), executable)
    if "/" not in argv[0] and shutil.which(argv[0], path=environment.get("PATH")) == program:
        program = argv[0]
    return CapturedProgram(
        process_id=pid,
        argv=(program, *argv[1:]),
        working_directory=directory,
        environment=tuple(
            (name, value) for name, value in sorted(differing.items()) if name not in withheld
        ),
        withheld=withheld,
    )


def note_ended(
    programs: Mapping[str, Mapping[str, CapturedProgram]],
) -> dict[str, dict[str, CapturedProgram]]:
    """Return what `GraphObserver.programs` did, with those noted that have ended since."""
    return {
        name: {
            prefix: replace(each, has_ended=not _speaks_ros(each.process_id))
            for prefix, each in found.items()
        }
        for name, found in programs.items()
    }


def _variables(block: bytes) -> dict[str, str]:
    pairs = (each.decode(errors="replace").partition("=") for each in block.split(b"\0") if each)
    return {name: value for name, _, value in pairs}


def _matters(name: str, value: str, ours: str | None) -> bool:
    if value == ours or _OF_A_SESSION.fullmatch(name) or not re.fullmatch(r"[A-Za-z_]\w*", name):
        return False
    if name in _PATHS:
        known = (ours or "").split(os.pathsep)
        return not set(value.split(os.pathsep)) <= set(known)
    return True


def _program(word: str, directory: str, path: str, executable: str) -> str:
    """Return what execvp(3) found for the first word of a command line, as it was found.

    A program may show another first word than it was started by; then it is its file.
    """
    if "/" in word:
        return word if (Path(directory) / word).exists() else executable
    folders = os.pathsep.join(str(Path(directory) / each) for each in path.split(os.pathsep))
    return shutil.which(word, path=folders) or executable


def _speaks_ros(pid: int) -> bool:
    """Whether a process has a middleware loaded."""
    try:
        maps = Path(f"/proc/{pid}/maps").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    return _ROS_LIBRARY.search(maps) is not None
