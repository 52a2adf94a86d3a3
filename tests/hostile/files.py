"""Manifests, paths, report targets, settings, run directories and folders of every hostile kind.

Verbs that need no ROS run in this process; what may block runs in one of its own.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import stat
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from lifecycle.errors import ExitCode
from tests.hostile.attack import (
    Attack,
    Attacks,
    HostileClass,
    Place,
    Unhandled,
    check,
    in_a_process,
    in_process,
    mutated,
)

CORPUS = Path(__file__).parents[1] / "corpus"
GOOD = sorted((CORPUS / "valid").glob("*.lifecycle.yaml"))
SMALLEST = """manifest_version: 1
system: small
nodes: {n: {run: {python: "tests.ros.supervisor.systems:Quiet"}}}
"""
_INVALID = (int(ExitCode.USAGE), int(ExitCode.MANIFEST_INVALID))

Make = Callable[[Path], object]


def _loop(path: Path) -> None:
    path.symlink_to(path)


def _closed(path: Path) -> None:
    path.write_text(SMALLEST)
    path.chmod(0)


def _laughs(path: Path) -> None:
    lines = ["a: &a0 [x, x]"] + [f"b{n}: &a{n + 1} [*a{n}, *a{n}]" for n in range(60)]
    path.write_text(SMALLEST + "\n".join(lines))


KINDS: dict[str, Make] = {
    "nothing": lambda path: None,
    "a folder": lambda path: path.mkdir(),
    "a link to itself": _loop,
    "a link to nowhere": lambda path: path.symlink_to("nowhere"),
    "a link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "a link to /dev/full": lambda path: path.symlink_to("/dev/full"),
    "a link to /proc/self/mem": lambda path: path.symlink_to("/proc/self/mem"),
    "a link to /proc/kmsg's folder": lambda path: path.symlink_to("/proc"),
    "a pipe": os.mkfifo,
    "a socket": lambda path: os.mknod(path, stat.S_IFSOCK | 0o600),
    "nobody's to read": _closed,
    "empty": lambda path: path.write_bytes(b""),
    "NUL bytes": lambda path: path.write_bytes(bytes(4096)),
    "random bytes": lambda path: path.write_bytes(random.Random(7).randbytes(4096)),
    "UTF-16": lambda path: path.write_bytes(SMALLEST.encode("utf-16")),
    "UTF-32": lambda path: path.write_bytes(SMALLEST.encode("utf-32")),
    "Latin-1": lambda path: path.write_bytes(b"system: caf\xe9\n"),
    "two documents": lambda path: path.write_text(SMALLEST + "---\n" + SMALLEST),
    "a billion laughs": _laughs,
    "itself in itself": lambda path: path.write_text("&a [*a]"),
    "its own key": lambda path: path.write_text("? &a [*a]\n: 1\n"),
    "deep lists": lambda path: path.write_text("a: " + "[" * 100_000),
    "deep blocks": lambda path: path.write_text("".join(f"{' ' * n}a:\n" for n in range(3000))),
    "a long line": lambda path: path.write_text("a: " + "x" * 2_000_000),
    "a hundred thousand keys": lambda path: path.write_text(
        "".join(f"k{n}: 1\n" for n in range(100_000))
    ),
    "a Python object": lambda path: path.write_text("!!python/object/apply:os.system ['id']"),
    "control characters": lambda path: path.write_text('system: "\x1b[2J\u202e"\n', "utf-8"),
    "a number of 9999 digits": lambda path: path.write_text("manifest_version: " + "9" * 9999),
    "a date that is none": lambda path: path.write_text("manifest_version: 2001-99-99\n"),
    "a list": lambda path: path.write_text("- 1\n"),
    "a word": lambda path: path.write_text("word\n"),
    "a tab": lambda path: path.write_text("\ta: 1\n"),
    "an include of itself": lambda path: path.write_text(
        f"manifest_version: 1\nsystem: s\ninclude: [{{manifest: '{path.name}'}}]\n"
    ),
    "an include of /dev/zero": lambda path: path.write_text(
        "manifest_version: 1\nsystem: s\ninclude: [{manifest: /dev/zero}]\n"
    ),
    "an interface of /dev/zero": lambda path: path.write_text(
        SMALLEST.replace("}}}", "}, interface: 'local:///dev/zero'}}")
    ),
    "a parameter file of /dev/zero": lambda path: path.write_text(
        SMALLEST.replace("}}}", "}, parameter_files: [/dev/zero]}}")
    ),
    "a parameter file that is a pipe": lambda path: (
        os.mkfifo(path.with_name("pipe")),
        path.write_text(SMALLEST.replace("}}}", "}, parameter_files: [pipe]}}")),
    ),
    "an interface that is a pipe": lambda path: (
        os.mkfifo(path.with_name("pipe")),
        path.write_text(SMALLEST.replace("}}}", "}, interface: 'local://pipe'}}")),
    ),
    "an include that is a pipe": lambda path: (
        os.mkfifo(path.with_name("pipe.lifecycle.yaml")),
        path.write_text(
            "manifest_version: 1\nsystem: s\ninclude: [{manifest: pipe.lifecycle.yaml}]\n"
        ),
    ),
}
"""What may stand where a file is expected."""

NAMES = (
    *("", " ", "\n", "a\nb.lifecycle.yaml", "\x1b[2J.lifecycle.yaml", "\u202e.lifecycle.yaml"),
    *("x" * 5000, "x" * 250 + ".lifecycle.yaml", "-", "--", "~", "a/" * 3000, "/dev/stdin"),
    *("nul\udcff.lifecycle.yaml", ".lifecycle.yaml", "lifecycle.yaml", "[red].lifecycle.yaml"),
)
"""Paths as they are written."""

WORDS = (
    *("x", ":=", "x:=", ":=x", "x:=1 x:=2", "\x1b[2J:=1", "a:=$(env HOME)", "a:=\n", "é:=é"),
    *(
        "a:=" + "x" * 100_000,
        "domain:=-1",
        "domain:=1e9",
        "domain:=\u202e",
        "--",
        "-",
        "a:=[1",
        "=:=:",
    ),
)
"""Words in the place of `name:=value`."""


def _manifest(make: Make, verb: str, place: Place) -> None:
    folder = place.folder()
    path = folder / "m.lifecycle.yaml"
    make(path)
    words = {
        "check": ("check", str(path)),
        "plan": ("plan", str(path)),
        "export": ("export", "sros2", str(path), "-o", str(folder / "out")),
        "down": ("down", str(path)),
    }[verb]
    check(in_process(*words, variables={"XDG_RUNTIME_DIR": str(folder)}))


def _named(name: str, place: Place) -> None:
    check(in_process("check", name), *_INVALID)
    check(in_process("status", name, variables={"XDG_RUNTIME_DIR": str(place.folder())}))
    before = Path.cwd()
    os.chdir(place.folder())
    try:
        check(in_process("check", "x", "--report", f"{name}.json"), *_INVALID)
    finally:
        os.chdir(before)
    check(in_process("check", "x", variables={"XDG_RUNTIME_DIR": name}), *_INVALID)


def _worded(word: str, place: Place) -> None:
    path = place.folder() / "m.lifecycle.yaml"
    path.write_text(SMALLEST)
    check(in_process("check", str(path), *word.split(" ")), *_INVALID, 0)


def _broken(text: bytes, place: Place) -> None:
    folder = place.folder()
    path = folder / "m.lifecycle.yaml"
    path.write_bytes(text)
    for verb in ("check", "plan"):
        check(in_process(verb, str(path)), 0, *_INVALID)


def _corpus(path: Path, place: Place) -> None:
    del place
    for words in (("check",), ("check", "--format", "json"), ("plan",)):
        check(in_process(*words, str(path)), 0, *_INVALID)


def _reported(make: Make, suffix: str, place: Place) -> None:
    folder = place.folder()
    (folder / "m.lifecycle.yaml").write_text(SMALLEST)
    target = folder / f"report{suffix}"
    make(target)
    words = ("check", str(folder / "m.lifecycle.yaml"), "--report", str(target))
    with _drained(target):
        check(in_a_process(*words, runtime=folder, limit_s=20.0))


@contextlib.contextmanager
def _drained(path: Path) -> Iterator[None]:
    """Read a pipe, as whoever made it would."""
    if not path.exists() or not stat.S_ISFIFO(path.stat().st_mode):
        yield
        return
    with path.open("rb+", buffering=0) as pipe:
        thread = threading.Thread(target=lambda: pipe.read(1 << 20), daemon=True)
        thread.start()
        yield
        pipe.write(b"\n")
        thread.join(5.0)


def _settings(make: Make, place: Place) -> None:
    folder = place.folder()
    (folder / "m.lifecycle.yaml").write_text(SMALLEST)
    make(folder / "targets.json")
    words = ("flows", "remove", str(folder / "m.lifecycle.yaml"))
    check(in_process(*words, variables={"XDG_RUNTIME_DIR": str(folder)}))
    from lifecycle.errors import LifecycleError
    from lifecycle.programming.http import load_settings
    from lifecycle.programming.nef import NefSettings

    try:
        load_settings(folder / "targets.json", "nef", NefSettings)
    except LifecycleError as error:
        if "\n" in str(error) or not str(error).isprintable():
            raise Unhandled(repr(str(error))) from error


RECORD = json.dumps(
    {
        "run_id": "a" * 32,
        "boot_id": Path("/proc/sys/kernel/random/boot_id").read_text().strip(),
        "supervisor": {"name": "supervisor", "pid": 1, "start_ticks": 1},
        "children": [{"name": "init", "pid": 1, "start_ticks": 1}],
        "domain_id": 0,
    }
)
RUNS: dict[str, Callable[[Path], object]] = {
    "the root is a file": lambda root: root.write_text("x"),
    "the root is a link": lambda root: root.symlink_to("/tmp"),
    "the root is a loop": _loop,
    "the root is everybody's": lambda root: (root.mkdir(), root.chmod(0o777)),
    "the root cannot be read": lambda root: (root.mkdir(), root.chmod(0o0)),
    "the run is a file": lambda root: (root.mkdir(0o700), (root / "small@7").write_text("x")),
    "the run is a link": lambda root: (root.mkdir(0o700), (root / "small@7").symlink_to("/")),
}


def _in_run(**files: bytes | str | None) -> Callable[[Path], object]:
    def make(root: Path) -> None:
        run = root / "small@7"
        run.mkdir(mode=0o700, parents=True)
        root.chmod(0o700)
        for name, content in files.items():
            path = run / name.replace("_", ".")
            if content is None:
                path.mkdir()
            elif isinstance(content, str) and content.startswith("→"):
                path.symlink_to(content[1:])
            elif content == b"pipe":
                os.mkfifo(path)
            else:
                path.write_bytes(content if isinstance(content, bytes) else content.encode())

    return make


RUNS |= {
    "the lock is a folder": _in_run(lock=None),
    "the lock is a link": _in_run(lock="→/etc/passwd"),
    "the lock is a pipe": _in_run(lock=b"pipe"),
    "the record is a folder": _in_run(lock=b"", record_json=None),
    "the record is a pipe": _in_run(lock=b"", record_json=b"pipe"),
    "the record is a link": _in_run(lock=b"", record_json="→/dev/zero"),
    "the record is noise": _in_run(lock=b"", record_json=b"\xff\0{"),
    "the record is deep": _in_run(lock=b"", record_json=b"[" * 100_000),
    "the record names process 1": _in_run(lock=b"", record_json=RECORD),
    "the ledger is noise": _in_run(lock=b"", record_json=RECORD, programmed_json=b"\xff{"),
    "the ledger is a folder": _in_run(lock=b"", record_json=RECORD, programmed_json=None),
    "the ledger names nothing that is": _in_run(
        lock=b"",
        record_json=RECORD,
        programmed_json=b'{"version":1,"system":"small","targets":[{"target":"x","scope":"y"}]}',
    ),
    "the ledger names settings of /dev/zero": _in_run(
        lock=b"",
        record_json=RECORD,
        programmed_json=b'{"version":1,"system":"small","targets":[{"target":"nef","scope":"y",'
        b'"settings":"/dev/zero","entries":[{"key":"k","digest":"d","what":"w","id":"1"}]}]}',
    ),
    "the socket is a file": _in_run(lock=b"", record_json=RECORD, control=b""),
    "the socket is a folder": _in_run(lock=b"", record_json=RECORD, control=None),
}


def _run_directory(make: Callable[[Path], object], words: tuple[str, ...], place: Place) -> None:
    folder = place.folder()
    make(folder / "lifecycle")
    check(in_process(*words, variables={"XDG_RUNTIME_DIR": str(folder)}, limit_s=8.0))


def attacks(rng: random.Random) -> list[Attack]:
    found = Attacks()
    add = found.add
    for kind, make in KINDS.items():
        for verb in ("check", "plan", "export", "down"):
            add(f"manifest, {kind}: {verb}", _manifest, make, verb)
        add(f"settings, {kind}", _settings, make)
    for name in NAMES:
        add(f"path {name[:40]!r} of {len(name)}", _named, name)
    for word in WORDS:
        add(f"argument {word[:40]!r}", _worded, word)
    for number in range(120):
        path = rng.choice(GOOD)
        add(f"{path.name} changed {number}", _broken, mutated(path.read_bytes(), rng))
    for path in sorted((CORPUS / "invalid").glob("*.lifecycle.yaml"))[::4]:
        add(f"invalid {path.name}", _corpus, path)
    for kind in tuple(KINDS)[:10]:
        for suffix in (".json", ".odd"):
            add(f"report, {kind}: {suffix}", _reported, KINDS[kind], suffix)
    for name, run in RUNS.items():
        for words in (("status", "small"), ("down", "small"), ("pause", "small@7")):
            add(f"{name}: {words[0]}", _run_directory, run, words)
    return found


CLASS = HostileClass(name="files", attacks=attacks)
