"""The manifest of the soak's system: ten nodes in eight processes, all policies in use."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import yaml

from tests.ros.supervisor.running import ROOT
from tests.soak.model import (
    BAD,
    DECLARED_RATE,
    EXTRA,
    ISSUED,
    PROCESSES,
    SAFE_INACTIVE,
    SILENT_S,
    TINTED,
    WATCHDOG_S,
    Manifest,
    Process,
)
from tests.soak.nodes import FAILS_VARIABLE, MARK_VARIABLE, STUMBLE_VARIABLE

NAME = "soaked"
COMPOSITION = ROOT / "tests" / "ros" / "supervisor" / "composition"
_STRING = "std_msgs/msg/String"
_QOS = {"reliability": "RELIABLE"}
PUBLISHES = {"base": "odom", "camera": "video", "filter": "points", "core": "beat"}
SUBSCRIBES = {
    "arm": "odom",
    "filter": "video",
    "detector": "points",
    "fragile": "beat",
    "lone": "beat",
    EXTRA: "beat",
}
_CLASSES = {
    "arm": "Arm",
    "filter": "Filter",
    "detector": "Detector",
    "fragile": "Listener",
    "lone": "Listener",
    EXTRA: "Listener",
}
_MORE = {each: Process(name=each, nodes=(each,), takes_down=(each,)) for each in (EXTRA, BAD)}
"""Of manifests that are applied."""
_STEP_S = 8.0


def manifest(
    directory: Path, domain_id: int, mark: str, differs: Manifest, name: str = NAME
) -> Path:
    """Write the manifest as `name`; return its path. Nodes take orders under `mark`."""
    stumble = directory / "stumble"
    stumble.mkdir(exist_ok=True)
    variables = {MARK_VARIABLE: mark, STUMBLE_VARIABLE: str(stumble)}
    variables |= {f"SOAK_PUBLISHES_{key}": name for key, name in PUBLISHES.items()}
    nodes: dict[str, Any] = {}
    more = [*([EXTRA] if differs.extra else ()), *([BAD] if differs.bad else ())]
    for process in (*PROCESSES, *(_MORE[each] for each in more)):
        for key in process.nodes:
            if not process.orders:
                continue
            nodes[key] = {
                "run": {
                    "python": f"tests.soak.nodes:{_CLASSES.get(key, 'Soaked')}",
                    "environment": variables,
                },
                "process": process.name,
                "restart": process.restart,
                "timeouts": {
                    **dict.fromkeys(("configure_s", "connect_s", "activate_s"), 2.5),
                    "start_s": _STEP_S,
                    "silent_s": SILENT_S,
                },
                "interface": {
                    "parameters": {"rate": {"type": "double", "default_value": DECLARED_RATE}}
                },
            }
            if process.restart != "no":
                nodes[key] |= {"watchdog_sec": WATCHDOG_S}
            if process.violation != "report":
                nodes[key]["on_violation"] = {"param": process.violation}
    for kind, names in (("publishers", PUBLISHES), ("subscriptions", SUBSCRIBES)):
        for key, topic in names.items():
            if key in nodes:
                nodes[key]["interface"][kind] = [{"name": topic, "type": _STRING, "qos": _QOS}]
    for key in TINTED:
        nodes[key]["interface"]["parameters"]["tint"] = {"type": "int", "default_value": 0}
        if differs.tint:
            nodes[key]["parameters"] = {"tint": differs.tint}
    for key in ISSUED:
        nodes[key]["run"]["environment"] = {**variables, "SOAK_ISSUE": str(differs.issue)}
    if differs.bad:
        nodes[BAD]["run"]["environment"] = {**variables, FAILS_VARIABLE: differs.bad}
    nodes["base"]["on_failure"] = "dependents"
    nodes["arm"] |= {"after": {"base": "configured"}, "restart_sec": 0.3}
    nodes["camera"] |= {"restart_sec": 0.2, "restart_steps": 3, "restart_max_delay_sec": 1.5}
    nodes["core"]["on_failure"] = "all"
    nodes["fragile"] |= {"start_limit_burst": 2, "start_limit_interval_sec": 3600}
    nodes["pool"] = {
        "run": {"command": [sys.executable, str(COMPOSITION / "container.py"), "pool"]},
        "managed": False,
        "endpoints": "open",
        "restart": "on-failure",
        "watchdog_sec": WATCHDOG_S,
    }
    nodes["part"] = {
        "run": {"component": "demo/Hearer", "container": "pool"},
        "managed": True,
        "remap": {"words": "/beat"},
        "interface": {"subscriptions": [{"name": "words", "type": _STRING, "qos": _QOS}]},
    }
    document = {
        "manifest_version": 1,
        "system": NAME,
        "discovery": {"domain_id": domain_id, "range": "localhost"},
        # Kills come faster here than a limit for a robot allows; `fragile` tries that.
        "start_limit_interval_sec": 0,
        "on_violation": {"default": "report", "graph.undeclared-publisher": {"mode": "safe"}},
        "modes": {"normal": {}, "safe": {"inactive": list(SAFE_INACTIVE)}},
        "nodes": nodes,
    }
    path = directory / f"{name}.lifecycle.yaml"
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    return path
