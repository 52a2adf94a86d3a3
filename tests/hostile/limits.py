"""Too little of everything: descriptors, memory, files, shared memory, disk, standard streams."""

from __future__ import annotations

import contextlib
import os
import random
import shlex
import shutil
import subprocess
from pathlib import Path

from tests.hostile.attack import (
    BOUND_S,
    Attack,
    Attacks,
    HostileClass,
    Place,
    Unhandled,
    check,
    in_a_process,
    in_process,
)
from tests.ros.supervisor.running import pair

LIMITS = (
    *("ulimit -n 3", "ulimit -n 8", "ulimit -n 16", "ulimit -n 32", "ulimit -n 64"),
    *("ulimit -n 128", "ulimit -v 100000", "ulimit -v 200000", "ulimit -v 400000"),
    *("ulimit -v 800000", "ulimit -v 1500000", "ulimit -f 0", "ulimit -f 8", "ulimit -s 256"),
    *("ulimit -c 0", "umask 777", "umask 000"),
)
VERBS = ("check", "plan", "up", "verify")

HERE = "unshare -m --propagation private"
"""A mount namespace of its own; only root has one."""

MOUNTS = {
    "/dev/shm of 64 KiB": "mount -t tmpfs -o size=64k tmpfs /dev/shm",
    "/dev/shm of 4 KiB": "mount -t tmpfs -o size=4k tmpfs /dev/shm",
    "/dev/shm read-only": "mount -t tmpfs -o ro tmpfs /dev/shm",
    "/dev/shm without inodes": "mount -t tmpfs -o nr_inodes=2 tmpfs /dev/shm",
    "run directory on a full disk": "mount -t tmpfs -o size=4k tmpfs {runtime} && "
    "head -c 4096 /dev/zero > {runtime}/full",
    "run directory read-only": "mount -t tmpfs -o ro tmpfs {runtime}",
    "run directory without inodes": "mount -t tmpfs -o nr_inodes=2 tmpfs {runtime}",
    "logs on a full disk": "mount -t tmpfs -o size=4k tmpfs {runtime}/log && "
    "head -c 4096 /dev/zero > {runtime}/log/full",
    "/tmp read-only": "mount -t tmpfs -o ro tmpfs /var/tmp",
}
STREAMS = {
    "stdin is closed": "<&-",
    "stdout is closed": ">&-",
    "stderr is closed": "2>&-",
    "all are closed": "<&- >&- 2>&-",
    "stdout is full": "> /dev/full",
    "stderr is full": "2> /dev/full",
    "stdin has no end": "< /dev/zero",
}
VARIABLES = {
    "HOME is nowhere": {"HOME": "/nonexistent"},
    "TMPDIR is nowhere": {"TMPDIR": "/nonexistent"},
    "PATH is empty": {"PATH": ""},
    "the locale is none": {"LC_ALL": "xx_YY", "LANG": "xx"},
    "the terminal is none": {"TERM": "nonsense", "COLUMNS": "-1", "LINES": "x"},
    "the domain is none": {"ROS_DOMAIN_ID": "x"},
    "the domain is 99999": {"ROS_DOMAIN_ID": "99999"},
    "the RMW is none": {"RMW_IMPLEMENTATION": "rmw_nonsense"},
    "the range is none": {"ROS_AUTOMATIC_DISCOVERY_RANGE": "EVERYWHERE"},
    "security without a keystore": {
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": "Enforce",
    },
    "security with an empty keystore": {
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": "Enforce",
        "ROS_SECURITY_KEYSTORE": "/nonexistent",
    },
    "profiles that are none": {"FASTRTPS_DEFAULT_PROFILES_FILE": "/dev/null"},
    "the ament prefix is none": {"AMENT_PREFIX_PATH": "/nonexistent:\x1b[2J"},
    "the log directory is a file": {"ROS_LOG_DIR": "/dev/null"},
    "peers of a terminal": {"ROS_STATIC_PEERS": "\x1b[2J;;1.2.3.4.5"},
}


def _words(verb: str, folder: Path, place: Place) -> list[str]:
    manifest = str(pair(folder, place.domain))
    rest = {
        "up": ["--stop-after", "0.5", "--timeout", "15"],
        "verify": ["--timeout", "1"],
    }
    return [verb, manifest, *rest.get(verb, [])]


def _under(before: str, verb: str, after: str, place: Place) -> None:
    """Run a verb in a shell that has set something up before, with redirections after."""
    folder = place.folder()
    (folder / "log").mkdir()
    line = f'{before}\nexec "$@" {after.format(runtime=shlex.quote(str(folder)))}'
    done = in_a_process(
        *_words(verb, folder, place),
        runtime=folder,
        through=("bash", "-c", line.format(runtime=shlex.quote(str(folder))), "bash"),
        limit_s=BOUND_S + 10,
    )
    # A shell that cannot start it says 126 or 127; what the kernel kills has no word.
    if done.code in {126, 127}:
        return
    if after and not (done.out + done.err).strip():
        if done.code in {0, 2, 3, 4, 5, 6, 7, 129, 130, 143}:
            return
        raise Unhandled(f"exit code {done.code}")
    check(done)


def _mounted(mount: str, verb: str, place: Place) -> None:
    script = mount + ' && exec "$@"'
    folder = place.folder()
    (folder / "log").mkdir()
    manifest_folder = place.folder()
    words = _words(verb, manifest_folder, place)
    done = in_a_process(
        *words,
        runtime=folder,
        through=(
            *HERE.split(), "bash", "-c", script.format(runtime=shlex.quote(str(folder))), "bash",
        ),
        limit_s=BOUND_S + 10,
    )  # fmt: skip
    check(done)


def _with(variables: dict[str, str], verb: str, place: Place) -> None:
    folder = place.folder()
    words = _words(verb, folder, place)
    if verb == "up":
        check(in_a_process(*words, runtime=folder, variables=variables, limit_s=BOUND_S))
    else:
        check(in_process(*words, variables={"XDG_RUNTIME_DIR": str(folder), **variables}))


def may_mount() -> bool:
    """Whether this user may have a mount namespace."""
    with contextlib.suppress(OSError):
        return (
            shutil.which("unshare") is not None
            and subprocess.run([*HERE.split(), "true"], check=False, capture_output=True).returncode
            == 0
            and os.getuid() == 0
        )
    return False


def attacks(rng: random.Random) -> list[Attack]:
    del rng
    found = Attacks()
    add = found.add
    for limit in LIMITS:
        for verb in ("check", "up"):
            add(f"{limit}: {verb}", _under, limit, verb, "")
    for name, stream in STREAMS.items():
        for verb in ("check", "up"):
            add(f"{name}: {verb}", _under, "", verb, stream)
    for name, variables in VARIABLES.items():
        for verb in ("plan", "up"):
            add(f"{name}: {verb}", _with, variables, verb)
    if may_mount():
        for name, mount in MOUNTS.items():
            add(f"{name}: up", _mounted, mount, "up")
    return found


CLASS = HostileClass(name="limits", attacks=attacks, limit_s=500.0)
