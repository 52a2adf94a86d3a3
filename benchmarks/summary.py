"""What `make bench` prints: bring-up and data path in one table, in under five minutes.

    python benchmarks/summary.py [--sizes 1 5 10 20] [--runs 3] [--chain 10] [--markdown]

Where others use the machine and it takes longer, what is left of bring-up is run once only.
`make bench-all` runs every benchmark, with up to 100 nodes.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script, only its own directory is there

from benchmarks import bring_up, data_path
from benchmarks.measuring import end_on_sigterm, render

ENOUGH_S = 120.0


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Measure bring-up and data path.")
    parser.add_argument("--sizes", type=int, nargs="+", default=(1, 5, 10, 20), metavar="N")
    parser.add_argument("--chain", type=int, nargs="*", default=(10,), metavar="N")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--domain", type=int, default=40)
    parser.add_argument("--markdown", action="store_true", help="as in docs/performance.md")
    options = parser.parse_args()
    end_on_sigterm()
    began_s = time.monotonic()
    enough_s = began_s + ENOUGH_S
    findings = bring_up.Findings()
    names = bring_up.available()
    rows = []
    for shape, sizes in (("single", options.sizes), ("chain", options.chain)):
        found = bring_up.Findings(failures=findings.failures)
        rows += bring_up.measure_all(
            sizes,
            options.runs,
            shape,
            options.domain,
            names=names,
            findings=found,
            enough_s=enough_s,
        )
    rows += data_path.measure_all(options.runs, options.domain + 1, findings.failures)
    took_s = time.monotonic() - began_s
    print(f"cold, in turns, medians of up to {options.runs}; measured in {took_s:.0f} s\n")
    print(render(rows, markdown=options.markdown))
    for each in findings.failures:
        print(f"failed: {each}")
    return 1 if findings.failures else 0


if __name__ == "__main__":
    sys.exit(main())
