"""The verdict as JSON. Owns: the document of schemas/verdict.v1.schema.json. Pure."""

from __future__ import annotations

import json

from lifecycle import codec
from lifecycle.verify.verdict import Verdict


def to_json(verdict: Verdict, *, indent: int | None = None) -> str:
    """Write `{"verdict": …, "findings": [...], "flows": [...]}`, and `open_endpoints` if any.

    The last verdict of a run has `run`, too: why it ended, how far it came and its exit code.

    Args:
        verdict: what to write.
        indent: spaces per level; None for one line.
    """
    document = {
        "verdict": verdict.verdict.value,
        "findings": codec.to_plain(verdict.findings),
        "flows": codec.to_plain(verdict.flows),
    }
    if verdict.open_endpoints:
        document["open_endpoints"] = codec.to_plain(verdict.open_endpoints)
    if verdict.run is not None:
        document["run"] = codec.to_plain(verdict.run)
    separators = (",", ":") if indent is None else None
    return json.dumps(document, ensure_ascii=False, indent=indent, separators=separators)
