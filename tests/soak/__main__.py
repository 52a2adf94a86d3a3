"""`make soak`: rounds of faults against a supervised system of ten nodes, judged from outside.

    python -m tests.soak [--seed N] [--rounds N] [--first N] [--only CONDITION] [--list]

A seed stands for a list of rounds, which `--list` prints. With root they run in network and mount
namespaces of their own, so that links can be cut and disks filled; without, those rounds are
skipped and named. The first round that fails ends it: its seed, its number, its part of `lifecycle
history` and where its journal is are printed, and the exit status is 1.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path

from tests.soak.model import NEEDS_ROOT, Condition, plan

_INSIDE = "SOAK_INSIDE"
_SET_UP = (
    "mount --make-rprivate / && mount -t tmpfs -o size=2g tmpfs /dev/shm && ip link set lo up && "
    'ip link set lo multicast on && exec "$@"'
)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.soak")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=100)
    parser.add_argument("--first", type=int, default=1, metavar="N", help="begin with this round")
    parser.add_argument(
        "--only",
        action="append",
        choices=[each.value for each in Condition],
        help="only rounds in this condition; may be given again",
    )
    parser.add_argument("--list", action="store_true", help="print the rounds, and do nothing")
    parser.add_argument("--go-on", action="store_true", help="also after a round that failed")
    options = parser.parse_args()
    rounds = plan(options.seed, options.rounds)[options.first - 1 :]
    if options.only:
        rounds = tuple(each for each in rounds if each.condition.value in options.only)
    if options.list:
        print(*rounds, sep="\n")
        return 0
    private = os.environ.get(_INSIDE) == "1"
    if not private and _can_be_private():
        again = [sys.executable, "-m", "tests.soak", *sys.argv[1:]]
        os.environ[_INSIDE] = "1"
        os.execvp("unshare", ["unshare", "-n", "-m", "sh", "-c", _SET_UP, "soak", *again])
    lacks = {} if private else dict.fromkeys(NEEDS_ROOT, "needs root and nft")
    skipped = [each for each in rounds if each.condition in lacks]
    for each in skipped:
        print(f"skipped, {lacks[each.condition]}: {each}")
    return _soak(options, [each for each in rounds if each not in skipped], private=private)


def _can_be_private() -> bool:
    if not all(map(shutil.which, ("unshare", "nft", "ip", "mount"))):
        return False
    trial = ["unshare", "-n", "-m", "sh", "-c", _SET_UP, "soak", "true"]
    return subprocess.run(trial, capture_output=True, check=False).returncode == 0


def _soak(options: argparse.Namespace, rounds: list, *, private: bool) -> int:
    directory = Path(tempfile.mkdtemp(prefix="soak-"))
    began_s = time.monotonic()
    with contextlib.ExitStack() as stack:
        stack.callback(shutil.rmtree, directory, ignore_errors=True)
        soaking = stack.enter_context(_place(directory, private=private))
        failed = 0
        left = collections.deque([*rounds, None])
        while left:
            done = left.popleft()
            if done is None and soaking.run is None:
                break
            print(done or "down", flush=True)
            started_s = time.monotonic()
            try:
                if done is None:
                    soaking.end("down")
                else:
                    soaking.round(done)
            except Exception:  # noqa: BLE001 - whatever it is, it is reported
                failed += 1
                print(f"FAILED: seed {options.seed}, {done or 'down'}")
                traceback.print_exc(limit=-2, file=sys.stdout)
                kept = Path(tempfile.mkdtemp(prefix=f"soak-failed-{options.seed}-")) / "kept"
                shutil.copytree(directory, kept, ignore=_sockets)
                _history(soaking, kept / "history.txt")
                upto = done.number if done else options.rounds
                again = f"python -m tests.soak --seed {options.seed} --rounds {upto}"
                print(f"  history of it: {kept}/history.txt; again: {again}", flush=True)
                soaking.abandon()
                if not options.go_on:
                    break
            else:
                print(f"  as expected, {time.monotonic() - started_s:.1f} s", flush=True)
        print(soaking.measured())
    if failed:
        print(f"seed {options.seed}: {failed} failed, {time.monotonic() - began_s:.0f} s")
        return 1
    counted = collections.Counter(each.condition.value for each in rounds)
    what = ", ".join(f"{count} {name}" for name, count in sorted(counted.items()))
    print(
        f"seed {options.seed}: {len(rounds)} rounds as expected ({what}), "
        f"{time.monotonic() - began_s:.0f} s"
    )
    return 0


def _sockets(directory: str, names: list[str]) -> list[str]:
    return [
        each
        for each in names
        if not (Path(directory, each).is_file() or Path(directory, each).is_dir())
    ]


def _history(soaking, file: Path) -> None:
    from tests.ros.supervisor.running import command, environment

    done = subprocess.run(
        command("history"),
        env=environment(soaking.runtime, ""),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    file.write_text(done.stdout + done.stderr)
    print(*done.stdout.splitlines()[-40:], sep="\n")


@contextlib.contextmanager
def _place(directory: Path, *, private: bool):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from lifecycle.middleware.fastdds.profiles import discovery_environment
        from lifecycle.pytest_plugin import claimed_domain
        from tests.soak.soaking import Soaking
    profiles = directory / "profiles"
    profiles.mkdir()
    with claimed_domain() as domain:
        os.environ.pop("FASTRTPS_DEFAULT_PROFILES_FILE", None)
        os.environ |= {
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }
        os.environ |= discovery_environment(profiles)
        soaking = Soaking(directory, domain, private=private)
        try:
            yield soaking
        finally:
            soaking.close()


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    # A participant that Fast DDS has locked up cannot be destroyed, nor left to be.
    os._exit(code)
