"""`make hostile`: runs every attack, prints per class tried and handled; exit 1 if one was not.

    python -m tests.hostile [--seed N] [--class NAME …] [--only TEXT] [--every N] [--list]

Each class runs in a process of its own, in a domain of its own, two at a time. What was not handled
is printed with the command that repeats it.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import contextlib
import importlib
import json
import os
import random
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path

NAMES = (
    "servers",
    "files",
    "limits",
    "signals",
    "reports",
    "names",
    "control",
)
"""Modules of this package, the slow ones first; each has its HostileClass as `CLASS`."""

MEMORY_BYTES = 8 * 2**30

SLOW_S = 3.0
"""What takes longer is said with `--here`: all of it must be over in ten minutes."""

ROOT = Path(__file__).parents[2]


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.hostile")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--class", dest="classes", action="append", choices=NAMES)
    parser.add_argument("--only", default="", help="attacks whose name holds this text")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="each N-th attack only")
    parser.add_argument("--list", action="store_true", help="names only")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here:
        return _run_here(options)
    if options.list:
        for name in options.classes or NAMES:
            for each in _chosen(name, options.seed, options.only, options.every):
                print(f"{name}: {each.name!r}")
        return 0
    began_s = time.monotonic()
    tried = handled = 0
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        names = options.classes or NAMES
        for name, (lines, took_s) in zip(
            names, pool.map(lambda each: _run_apart(each, options), names), strict=True
        ):
            failed = [each for each in lines if each["why"]]
            tried += len(lines)
            handled += len(lines) - len(failed)
            print(
                f"{name:10} {len(lines):4} tried {len(lines) - len(failed):4} handled"
                f" {took_s:6.1f} s",
                flush=True,
            )
            for each in failed:
                words = ("--seed", options.seed, "--class", name, "--only", each["attack"])
                again = shlex.join(map(str, words))
                print(f"  NOT HANDLED {each['attack']!r}: {each['why']}")
                print(f"    again: {Path(sys.executable).name} -m tests.hostile {again}")
    print(
        f"seed {options.seed}: {tried} attacks, {handled} handled, {tried - handled} not,"
        f" {time.monotonic() - began_s:.0f} s"
    )
    return 0 if tried and tried == handled else 1


def _chosen(name: str, seed: int, only: str, nth: int = 1) -> list:
    found = importlib.import_module(f"tests.hostile.{name}").CLASS
    every = found.attacks(random.Random(f"{name} {seed}"))
    assert len({each.name for each in every}) == len(every), "two attacks have one name"
    return [each for each in every if only in each.name][::nth]


def on_a_host_of_its_own() -> tuple[str, ...]:
    """Return what has a command run on a host with an address; nothing where that needs root."""
    through = ("unshare", "-n", "-m", "sh", "-c", _HOST, "hostile")
    if not all(map(shutil.which, ("unshare", "ip", "mount"))):
        return ()
    works = subprocess.run([*through, "true"], capture_output=True, check=False).returncode == 0
    return through if works else ()


_HOST = (
    "mount --make-rprivate / && mount -t tmpfs -o size=1g tmpfs /dev/shm && ip link set lo up && "
    "ip link add h0 type veth peer name h1 && ip addr add 10.66.0.1/24 dev h0 && "
    "ip link set h0 up && ip link set h1 up && ip route add 224.0.0.0/4 dev h0 && "
    'export HOSTILE_HOST=10.66.0.1 && exec "$@"'
)


def _run_apart(name: str, options: argparse.Namespace) -> tuple[list[dict[str, str]], float]:
    """Run one class in a process of its own; return a line for each attack, and its seconds."""
    of_class = importlib.import_module(f"tests.hostile.{name}").CLASS
    limit_s, through = of_class.limit_s, on_a_host_of_its_own() if of_class.has_host else ()
    words = ["--seed", str(options.seed), "--class", name, "--only", options.only, "--here"]
    words += ["--every", str(options.every)]
    began_s = time.monotonic()
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(
            [*through, sys.executable, "-m", "tests.hostile", *words],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )
        late = False
        try:
            out, _ = process.communicate(timeout=limit_s)
        except subprocess.TimeoutExpired:
            late = True
            process.terminate()
            out, _ = process.communicate(timeout=30)
        errors.seek(0)
        said = errors.read()[-3000:]
    lines = [json.loads(each) for each in out.splitlines() if each.startswith('{"attack"')]
    if late or process.returncode:
        why = f"the class did not end within {limit_s:g} s" if late else f"it died: {said}"
        lines.append({"attack": "", "why": why})
    return lines, time.monotonic() - began_s


def _run_here(options: argparse.Namespace) -> int:
    # Whoever reads without a bound must not take the machine's memory with it.
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    (name,) = options.classes
    found = importlib.import_module(f"tests.hostile.{name}").CLASS
    attacks = _chosen(name, options.seed, options.only, options.every)
    with place(options.seed) as here, contextlib.ExitStack() as stack:
        try:
            stage = stack.enter_context(found.stage(here, attacks))
        except Exception as error:  # noqa: BLE001 - whatever it is, it is reported
            _say("the stage", error)
            return 0
        for each in attacks:
            began_s = time.monotonic()
            try:
                each.run(stage)
            except Exception as error:  # noqa: BLE001 - likewise
                _say(each.name, error)
            else:
                _say(each.name, None)
            if (took_s := time.monotonic() - began_s) > SLOW_S:
                print(f"{each.name!r} took {took_s:.1f} s", file=sys.stderr)
        try:
            stack.close()
        except Exception as error:  # noqa: BLE001 - likewise
            _say("what is left of it", error)
    return 0


def _say(name: str, error: Exception | None) -> None:
    from tests.hostile.attack import Unhandled

    why = ""
    if isinstance(error, Unhandled):
        why = str(error)
    elif error is not None:
        why = "".join(traceback.format_exception(error)[-4:])
    sys.__stdout__.write(json.dumps({"attack": name, "why": why}) + "\n")
    sys.__stdout__.flush()


@contextlib.contextmanager
def place(seed: int) -> Iterator:
    """Yield a place for attacks: a folder, and a domain that the environment names."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from lifecycle.middleware.fastdds.profiles import discovery_environment
        from lifecycle.pytest_plugin import claimed_domain
        from tests.hostile.attack import Place

    before = dict(os.environ)
    with tempfile.TemporaryDirectory(prefix="hostile-") as folder, claimed_domain() as domain:
        path = Path(folder)
        (path / "profiles").mkdir()
        os.environ.pop("FASTRTPS_DEFAULT_PROFILES_FILE", None)
        os.environ |= {
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(path / "log"),
            "NO_PROXY": "127.0.0.1",
        }
        os.environ |= discovery_environment(path / "profiles")
        try:
            yield Place(path=path, domain=domain, random=random.Random(seed))
        finally:
            os.environ.clear()
            os.environ.update(before)


if __name__ == "__main__":
    sys.exit(main())
