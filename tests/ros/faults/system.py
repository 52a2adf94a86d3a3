"""The small healthy system that every fault is derived from, and how a fault edits it.

Owns: `healthy`, `Fault`. A fault is data: what is changed, what must come of it.
"""

from __future__ import annotations

import copy
import dataclasses
import enum
from collections.abc import Mapping
from pathlib import Path

import yaml

from tests.installation import PYTHON


class ExitCode(enum.IntEnum):
    """Those of `lifecycle up`, see docs/cli.md."""

    OK = 0
    MANIFEST_INVALID = 3
    VIOLATED = 4
    UNVERIFIABLE = 5
    BRING_UP_FAILED = 6
    INTERRUPTED = 130


NODES = "tests.ros.faults.nodes"
FOREIGN = str(Path(__file__).with_name("foreign.py"))
BARE_DDS = str(Path(__file__).with_name("bare_dds.py"))
REMOVE = object()
"""As a value of an edit: take the key away."""

_MISBEHAVE = {"misbehave": {"type": "string", "default_value": ""}}
_TIMEOUTS = {"start_s": 5, "configure_s": 5, "connect_s": 5, "activate_s": 5, "shutdown_s": 1}

_HEALTHY: dict[str, object] = {
    "manifest_version": 1,
    "system": "faults",
    "discovery": {"range": "localhost"},
    "policy": {"unheard": "ignore"},
    "nodes": {
        "talker": {
            "run": {"python": f"{NODES}:Talker"},
            "timeouts": _TIMEOUTS,
            "interface": {
                "publishers": [{"name": "chatter", "type": "std_msgs/msg/String"}],
                "parameters": _MISBEHAVE,
            },
        },
        "listener": {
            "run": {"python": f"{NODES}:Listener"},
            "timeouts": _TIMEOUTS,
            "interface": {
                "subscriptions": [{"name": "chatter", "type": "std_msgs/msg/String"}],
                "service_servers": [{"name": "~/ping", "type": "std_srvs/srv/Trigger"}],
                "parameters": _MISBEHAVE,
            },
        },
    },
    "links": [{"topic": "/chatter", "from": "talker", "to": "listener"}],
}


def foreign(*arguments: str) -> list[str]:
    """Return the command line of a plain node, see foreign.py."""
    return [str(PYTHON), FOREIGN, *arguments]


def healthy(edits: Mapping[str, object] | None = None) -> dict[str, object]:
    """Return the healthy system with `edits` applied: a path `a/b/0/c` to its new value."""
    document = copy.deepcopy(_HEALTHY)
    for path, value in (edits or {}).items():
        *parents, last = path.split("/")
        place: object = document
        for key in parents:
            place = place[int(key)] if isinstance(place, list) else place.setdefault(key, {})
        if value is REMOVE:
            del place[last]
        elif isinstance(place, list):
            place[int(last)] = copy.deepcopy(value)
        else:
            place[last] = copy.deepcopy(value)
    return document


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fault:
    """One way in which a system may be broken, and what must come of it.

    Attributes:
        name: as a sentence, the test's id.
        edits: what differs from the healthy system.
        exit_code: of `lifecycle up`.
        rule: id of the finding or failure; empty for a fault that has none (usage, static text).
        subject: what the finding must name.
        message: a part of the message that tells the cause.
        options: more words for `lifecycle up`.
        intruder: a foreign process that runs beside the system: arguments of `intruder_is`.
        intruder_is: the program, foreign.py or bare_dds.py.
        activates: the fault strikes after a verdict ok, so activation is right.
        quick: is in `make test`, too.
    """

    name: str
    edits: Mapping[str, object]
    exit_code: ExitCode
    subject: str
    message: str = ""
    rule: str = ""
    options: tuple[str, ...] = ()
    intruder: tuple[str, ...] = ()
    intruder_is: str = FOREIGN
    activates: bool = False
    quick: bool = False

    @property
    def manifest(self) -> str:
        """The manifest's text."""
        return yaml.safe_dump(healthy(self.edits), sort_keys=False)
