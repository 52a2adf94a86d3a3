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
        json.dumps({"version": 1, "node": "/talker", "instance": "9" * 20, "state": "active",
                    "connected": True, "checksum": "\x1b[2J", "reason": "\x1b[2J\n",
                    "connections": [{"name": "net", "error": "\x1b[2J"}],
                    "mappings": [{"endpoint": "x", "connection": "net", "matched": 2**62}],
                    **more})
        for more in ({}, {"left": True}, {"version": 2}, {"instance": ""}, {"node": "talker"},
                     {"node": "/\x1b[2J"}, {"instance": "0"}, {"state": "\x1b[2J"})
    ),
    json.dumps({"run": "x", "host": "y", "system": "faults", "machines": ["local"],
                "nodes": ["/talker"], "checksum": "ab", "plan": "eJzLAAAA"}),
    json.dumps({"run": "x", "host": "\x1b[2J", "system": "faults\n", "machines": ["local"],
                "nodes": ["/talker"], "checksum": "ab", "reason": "left"}),
]  # fmt: skip
