"""Say whether the system of a manifest is up and running, as `lifecycle verify` judges it.

    python -m examples.graph_watch.is_running manifests/first_node.lifecycle.yaml

Exits with 0 if it is, else with 1, and says what differs.
"""

from __future__ import annotations

import sys

from lifecycle.graph.graph import Graph
from lifecycle.manifest import load
from lifecycle.plan.build import build_plan
from lifecycle.verify.outcome import Outcome


def main() -> int:
    """Ask once."""
    plan = build_plan(load(sys.argv[1]).manifest)
    with Graph.open(plan.domain_id) as graph:
        verdict = graph.verdict(plan)
    for finding in verdict.findings:
        print(finding.message)
    return 0 if verdict.verdict is Outcome.OK else 1


if __name__ == "__main__":
    sys.exit(main())
