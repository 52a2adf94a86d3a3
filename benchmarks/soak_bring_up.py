"""How reliably a system comes up: bring-ups in a row, on a quiet machine or on one with no time.

A first contact that network or middleware lose shows once in many bring-ups only. This runs
`lifecycle up MANIFEST --stop-after 0` again and again, one after the other, and counts what came up
at once, what came up only after a node was started again, and what did not.

    python benchmarks/soak_bring_up.py [--times 10] [--busy 0] [--manifest FILE] [--keep DIRECTORY]

`--busy 2` has two processes compute beside it all the while. It prints one line for each bring-up
and the sum; with `--keep` the output of each that did not come up is kept. Exit code 1 if any.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MANIFEST = ROOT / "manifests" / "client_server_master.lifecycle.yaml"
AGAIN = "is started again on a fresh port"
BOUND_S = 120.0


@contextlib.contextmanager
def busy(count: int) -> Iterator[None]:
    """Keep `count` processors busy meanwhile."""
    programs = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for each in programs:
            each.kill()
            each.wait()


def bring_up(manifest: Path, keep: Path | None, number: int) -> tuple[int, float, int]:
    """Bring the system up; return exit code, seconds, and how often nodes were started again."""
    began = time.monotonic()
    with tempfile.TemporaryFile("w+") as errors:
        done = subprocess.run(
            [
                *(sys.executable, "-m", "lifecycle", "up", str(manifest)),
                *("--stop-after", "0", "--format", "json"),
            ],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            timeout=BOUND_S,
            check=False,
        )
        took_s = time.monotonic() - began
        if done.returncode and keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
            errors.seek(0)
            (keep / f"{number}.jsonl").write_text(done.stdout)
            (keep / f"{number}.stderr").write_text(errors.read())
    again = sum(
        event.get("event") == "notice" and AGAIN in event["message"]
        for event in map(json.loads, done.stdout.splitlines())
    )
    return done.returncode, took_s, again


def main() -> int:
    """Run the soak."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--times", type=int, default=10)
    parser.add_argument("--busy", type=int, default=0)
    parser.add_argument("--manifest", type=Path, default=MANIFEST)
    parser.add_argument("--keep", type=Path)
    chosen = parser.parse_args()
    runs = []
    with busy(chosen.busy):
        for number in range(1, chosen.times + 1):
            code, took_s, again = bring_up(chosen.manifest, chosen.keep, number)
            runs.append((code, took_s, again))
            words = f"{number}: exit code {code} after {took_s:.1f} s"
            print(f"{words}; {again} started again" if again else words, flush=True)
    good = [each for each in runs if each[0] == 0]
    mended = sum(again > 0 for _, _, again in good)
    times = [took_s for _, took_s, _ in runs]
    print(
        f"{len(good)} of {len(runs)} came up, {mended} of them after a node was started again; "
        f"{statistics.median(times):.1f} s (median), {max(times):.1f} s at most; "
        f"{chosen.busy} processors kept busy"
    )
    return 0 if len(good) == len(runs) else 1


if __name__ == "__main__":
    raise SystemExit(main())
