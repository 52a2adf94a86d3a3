"""What a peer may answer for `~/get_configuration`, or say on `/lifecycle/graph`.

Names have no underscores: they are words of a node's name where a blank would not do.
"""

from __future__ import annotations

import json

from tests.unit.verify.test_foreign_configurations import GOOD, REFUSED

_CUT = 200_000
"""Characters of those that are endless by intention: DDS has to carry them too."""


def _fits(text: str) -> bool:
    try:
        return bool(text.encode())
    except UnicodeEncodeError:
        return False


ANSWERS: dict[str, str] = {
    **{
        name: text[:_CUT]
        for name, text in REFUSED.items()
        if _fits(text[:_CUT]) and "\0" not in text
    },
    "five megabytes": " " * 5_000_000,
    "no success": "\x1b[2J\nverdict: ok\u202e",
    "another schema": '{"openapi": "3.1.0"}',
    "endpoints of a thousand": json.dumps({**GOOD, "endpoints": GOOD["endpoints"] * 1000}),
    "a terminal in every text": json.dumps(GOOD).replace('""', '"\\u001b[2J\\n"'),
}

MESSAGES: list[str] = [
    *(text[:60_000] for text in ANSWERS.values()),
    *(
        json.dumps({"version": 1, "kind": kind, "node": "/talker", "incarnation": "9" * 20,
                    "sequence": 2**62, "state": "active", "connected": True, "checksum": "\x1b[2J",
                    "about": "/listener", "reason": "\x1b[2J\n", "connection": "net",
                    "endpoint": "x", "urls": [], "silent": ["/listener"]})
        for kind in ("joined", "left", "state_changed", "heartbeat", "configuration_changed",
                     "connection_lost", "mapping_lost", "silent", "stuck", "alive")
    ),
    json.dumps({"run": "x", "host": "y", "system": "faults", "machines": ["local"],
                "nodes": ["/talker"], "checksum": "ab", "plan": "eJzLAAAA"}),
    json.dumps({"run": "x", "host": "\x1b[2J", "system": "faults\n", "machines": ["local"],
                "nodes": ["/talker"], "checksum": "ab", "reason": "left"}),
]  # fmt: skip
