"""Writes what users see of an installation into a folder, so that two can be compared by `diff -r`.

    python -m tests.outside.frozen FOLDER [--only corpus|manifests|runs]

`LIFECYCLE=path/to/lifecycle` chooses the installation. What differs from run to run (numbers of
ports, pids, times, addresses, folders) is left out:

- corpus: exit code and output of `check` for every document of tests/corpus;
- manifests: `check`, `plan --format json` of manifests/;
- runs: `up --stop-after 1` of manifests that one machine can run: exit code, verdict, findings,
  flows, and which events came of which node, in the order in which each node had them.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from tests.outside.running import LIFECYCLE

ROOT = Path(__file__).parents[2]
ALONE = ("first_node", "teleop", "dynamic_discovery", "statically_configured_graph")
"""Manifests whose nodes all run on one machine."""

_CHANGING = (
    (re.compile(re.escape(str(ROOT))), "ROOT"),
    (re.compile(r"\b\d{4}-\d\d-\d\d-\d\d-\d\d-\d\d-[\w-]+"), "RUN"),
    (re.compile(r"\bpid \d+"), "pid N"),
)


def _run(*words: str, environment: dict[str, str] | None = None) -> tuple[int, str, str]:
    done = subprocess.run(
        [str(LIFECYCLE), *words],
        cwd=ROOT,
        env={**os.environ, "COLUMNS": "100", **(environment or {})},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    return done.returncode, _steady(done.stdout), _steady(done.stderr)


def _steady(text: str) -> str:
    for pattern, word in _CHANGING:
        text = pattern.sub(word, text)
    return text


def _write(path: Path, *parts: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    texts = (
        each if isinstance(each, str) else json.dumps(each, indent=1, sort_keys=True)
        for each in parts
    )
    path.write_text("\n".join(texts) + "\n")


def corpus(folder: Path) -> None:
    for path in sorted(ROOT.glob("tests/corpus/*/*.lifecycle.yaml")):
        code, output, errors = _run("check", str(path.relative_to(ROOT)))
        _write(folder / path.parent.name / f"{path.stem}.txt", f"exit {code}", output, errors)


def manifests(folder: Path) -> None:
    for path in sorted(ROOT.glob("manifests/*.lifecycle.yaml")):
        name = str(path.relative_to(ROOT))
        _write(folder / f"{path.name.split(chr(46))[0]}.check.txt", *map(str, _run("check", name)))
        code, output, errors = _run("plan", name, "--format", "json")
        plan = json.loads(output) if code == 0 else output
        _write(folder / f"{path.name.split(chr(46))[0]}.plan.json", f"exit {code}", plan, errors)


def runs(folder: Path) -> None:
    for name in ALONE:
        with tempfile.TemporaryDirectory() as directory:
            report = Path(directory, "report.json")
            code, output, _ = _run(
                *("up", f"manifests/{name}.lifecycle.yaml", "--stop-after", "1"),
                *("--format", "json", "--report", str(report)),
                environment={"XDG_RUNTIME_DIR": directory, "ROS_LOG_DIR": f"{directory}/log"},
            )
            result = json.loads(report.read_text())
        events = [json.loads(line) for line in output.splitlines() if line.startswith("{")]
        _write(folder / f"{name}.json", f"exit {code}", _seen(result), _course(events))


def _seen(result: dict[str, Any]) -> dict[str, Any]:
    """What the verdict says, without numbers that a run chooses."""
    return {
        "verdict": result["verdict"],
        "findings": result["findings"],
        "flows": [
            {k: v for k, v in flow.items() if k not in ("source", "destination", "tuples")}
            for flow in result["flows"]
        ],
        "run": result["run"],
        "keys": sorted(result),
    }


def _course(events: list[dict[str, Any]]) -> dict[str, list[str]]:
    """By node or process: its events, in order; `system` has the others."""
    course: dict[str, list[str]] = {}
    for event in events:
        if event.get("event") in ("log", "verdict", "joined", "wiring"):
            continue
        whose = event.get("node") or event.get("process") or "system"
        words = (event.get(k) for k in ("event", "operation", "state", "reach", "reached"))
        line = " ".join(str(each) for each in words if each)
        line += f" [{', '.join(sorted(event))}]"
        course.setdefault(str(whose), []).append(line)
    return course


PARTS = {"corpus": corpus, "manifests": manifests, "runs": runs}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", choices=PARTS)
    given = parser.parse_args()
    for name, write in PARTS.items():
        if given.only in (None, name):
            write(given.folder / name)


if __name__ == "__main__":
    main()
