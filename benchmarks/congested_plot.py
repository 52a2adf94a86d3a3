"""Records a delay on a congested link without and with a rule for it, and draws what was recorded.

The system, the link and the rule are those of `benchmarks/congested_link.py`; the file is written
by `lifecycle flows --record`.

    python benchmarks/congested_plot.py FILE.csv FILE.svg [--draw-only]

Needs root, and a kernel with sch_htb and cls_u32 or cls_flower. Takes a minute.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import math
import signal
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script, only its own directory is there

from benchmarks.congested_link import (
    BUFFER_S,
    FRAME_BYTES,
    GUARANTEE,
    LINK_KBIT,
    PYTHON,
    UP_S,
    Case,
    brought_up,
    rule,
    write_manifest,
)
from tests.net.hosts import Hosts, lacking

EACH_S = 15.0
BOUND_MS = 50.0
CASE = Case(
    title="P1 marked EF, of which a delay is declared",
    publishers={"p1": {"dscp": "EF"}},
    apply=("--match", "mark", "--guarantee", f"ef={GUARANTEE}"),
    links=[
        {"topic": "/p1", "from": "n1", "to": "n2", "max_delay_ms": BOUND_MS, "quantile": 0.9},
        {"topic": "/p2", "from": "n1", "to": "n2"},
    ],
)

WIDTH, HEIGHT, LEFT, BOTTOM, TOP, RIGHT = 720, 320, 60, 40, 16, 90
LOW_MS, HIGH_MS = 0.1, 1000.0
LINES = (("p50_ms", "p50", "#1f77b4"), ("p99_ms", "p99", "#d62728"))


def record(file: Path) -> float:
    """Record P1 and P2 without a rule and then with one; return when it was applied, seconds."""
    with tempfile.TemporaryDirectory() as name, Hosts() as hosts:
        directory = Path(name)
        left, router, right = hosts.routed("A", "B")
        frames = int(LINK_KBIT * 1000 / 8 * BUFFER_S / FRAME_BYTES)
        router.ip("link", "set", "right", "txqueuelen", str(frames))
        manifest = write_manifest(CASE, left.ipv4, right.ipv4, directory)
        with brought_up(manifest, left, right, directory):
            options = ("--record", str(file))
            recording = right.popen(
                *PYTHON, "flows", "congested", *options, env=right.environment(directory / "b")
            )
            began_s = time.monotonic()
            with rule(dataclasses.replace(CASE, apply=None), router, manifest, directory):
                (directory / "go").touch()
                time.sleep(EACH_S)
            applied_s = time.monotonic() - began_s
            with rule(CASE, router, manifest, directory):
                time.sleep(EACH_S)
                recording.send_signal(signal.SIGINT)
                recording.wait(UP_S)
        return applied_s


def draw(file: Path, picture: Path) -> None:
    """Draw P1's delays over time, on a logarithmic scale."""
    with file.open(encoding="utf-8", newline="") as lines:
        rows = [each for each in csv.DictReader(lines) if each["topic"] == "/p1"]
    last_s = max(float(each["seconds"]) for each in rows)

    def x(at_s: float) -> float:
        return LEFT + at_s / last_s * (WIDTH - LEFT - RIGHT)

    def y(ms: float) -> float:
        share = math.log(max(ms, LOW_MS) / LOW_MS) / math.log(HIGH_MS / LOW_MS)
        return HEIGHT - BOTTOM - share * (HEIGHT - BOTTOM - TOP)

    shapes = [
        f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y(ms):.1f}" y2="{y(ms):.1f}" stroke="#ccc"/>'
        f'<text x="{LEFT - 6}" y="{y(ms) + 4:.1f}" text-anchor="end">{ms:g} ms</text>'
        for ms in (0.1, 1, 10, 100, 1000)
    ]
    shapes += [
        f'<text x="{x(at_s):.1f}" y="{HEIGHT - 14}" text-anchor="middle">{at_s} s</text>'
        for at_s in range(0, int(last_s) + 1, 5)
    ]
    shapes.append(
        f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y(BOUND_MS):.1f}" y2="{y(BOUND_MS):.1f}" '
        'stroke="#2ca02c" stroke-dasharray="6 4"/>'
        f'<text x="{WIDTH - RIGHT + 6}" y="{y(BOUND_MS) + 4:.1f}">≤ {BOUND_MS:g} ms</text>'
    )
    for column, label, colour in LINES:
        known = [(float(row["seconds"]), float(row[column])) for row in rows if row[column]]
        shapes.append(line(((x(at_s), y(ms)) for at_s, ms in known), colour))
        at_y = y(known[-1][1]) + 4
        shapes.append(
            f'<text x="{WIDTH - RIGHT + 6}" y="{at_y:.1f}" fill="{colour}">{label}</text>'
        )
    inside = "\n".join(shapes)
    picture.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        'font-family="sans-serif" font-size="12">\n'
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>\n{inside}\n</svg>\n',
        encoding="utf-8",
    )


def line(points: Iterable[tuple[float, float]], colour: str) -> str:
    """Return a line through points."""
    text = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline points="{text}" fill="none" stroke="{colour}" stroke-width="2"/>'


def main(arguments: Sequence[str] | None = None) -> int:
    """Record unless that was done before, and draw."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--draw-only", action="store_true", help="draw what was recorded before")
    options = parser.parse_args(arguments)
    if not options.draw_only:
        if why := lacking():
            print(why, file=sys.stderr)
            return 1
        print(f"applied after {record(options.file):.1f} s")
    draw(options.file, options.picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
