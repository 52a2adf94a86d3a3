"""The verdict as JSON.

Owns: the document of schemas/verdict.v1.schema.json, and how findings are written in any. Pure.
"""

from __future__ import annotations

import json

from lifecycle import codec
from lifecycle.printable import json_text
from lifecycle.verify.verdict import Verdict


def to_json(verdict: Verdict, *, indent: int | None = None) -> str:
    """Write `{"verdict": …, "findings": [...], "flows": [...]}`.

    There are `open_endpoints` and `tolerated`, too, where there are any. The last verdict of a run
    has `run`: why it ended, how far it came, its exit code, and what its gate took on trust, if
    anything. Where no system was judged it has `"judged": false`, and its findings are why.

    Args:
        verdict: what to write.
        indent: spaces per level; None for one line.
    """
    document: dict[str, object] = {
        "verdict": verdict.verdict.value,
        "findings": plain_findings(verdict),
        "flows": codec.to_plain(verdict.flows),
    }
    if not verdict.judged:
        document["judged"] = False
    if verdict.open_endpoints:
        document["open_endpoints"] = codec.to_plain(verdict.open_endpoints)
    if verdict.tolerated:
        document["tolerated"] = codec.to_plain(verdict.tolerated)
    if verdict.run is not None:
        run = codec.to_plain(verdict.run)
        assert isinstance(run, dict)
        document["run"] = {name: value for name, value in run.items() if value or name != "trusted"}
    separators = (",", ":") if indent is None else None
    text = json.dumps(document, ensure_ascii=False, indent=indent, separators=separators)
    return json_text(text)


def plain_findings(verdict: Verdict) -> list[dict[str, object]]:
    """Return the findings as JSON holds them: of the two ends their subject says enough."""
    found = []
    for each in verdict.findings:
        plain = codec.to_plain(each)
        assert isinstance(plain, dict)
        del plain["ends"]
        found.append(plain)
    return found
