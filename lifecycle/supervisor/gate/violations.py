"""How long a system that is held was violated, and by what: what counts, and what only passed.

Owns: `Violations`. A finding counts once it has lasted for longer than LASTS_S, whatever else
changes meanwhile; a shorter one does not, and is named when the run ends. Pure.
"""

from __future__ import annotations

from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind
from lifecycle.verify.judge import not_ok
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Finding, Verdict

LASTS_S = 1.0
"""A violation that lasts for longer is in the exit code."""

_NAMED = 3
_MOST = 1000
"""A graph that churns for days has ever new findings: so many are remembered."""

_Key = tuple[str, str, str, EndpointKind | None]


class Violations:
    """What was violated of one system while it was held.

    Attributes:
        counted: what lasted first, or had a consequence; empty if nothing did.
    """

    def __init__(self) -> None:
        self.counted = ""
        self._since: dict[_Key, float] = {}
        self._seen: dict[str, bool] = {}  # whether it lasted

    def see(self, verdict: Verdict, now_s: float) -> float | None:
        """Take what was judged now of nodes that are to be as planned.

        Args:
            verdict: that holds, of those nodes alone.
            now_s: on any clock that only goes forward.

        Returns:
            The seconds after which what is violated counts; None if nothing new would.
        """
        found = {_key(each): each for each in verdict.findings if each.outcome is Outcome.VIOLATED}
        keys = [*found]
        if verdict.verdict is Outcome.VIOLATED and not found:
            keys = [("", verdict.verdict.value, "", None)]
        self._since = {key: self._since.get(key, now_s) for key in keys}
        lasting = [key for key in keys if now_s - self._since[key] >= LASTS_S]
        if lasting:
            findings = tuple(found[key] for key in lasting if key in found)
            self.count(not_ok(replace(verdict, findings=findings)) or _named(keys[0]))
        for key in keys:
            if key in lasting or len(self._seen) < _MOST:
                self._seen[_named(key)] = self._seen.get(_named(key), False) or key in lasting
        left_s = [self._since[key] + LASTS_S - now_s for key in keys if key not in lasting]
        return min(left_s, default=None)

    def end(self) -> None:
        """Begin anew: nothing is active, or the gate opened."""
        self._since = {}

    def count(self, what: str) -> None:
        """Count a violation, if it is the first."""
        self.counted = self.counted or what

    def passed(self) -> str:
        """Say what was violated and did not count; empty if nothing was."""
        found = [text for text, lasted in self._seen.items() if not lasted]
        if not found:
            return ""
        more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
        named = f"{', '.join(found[:_NAMED])}{more}"
        return f"violated for no longer than {LASTS_S:g} s, and not counted: {named}"


def _key(finding: Finding) -> _Key:
    return finding.rule, finding.subject, finding.node, finding.endpoint


def _named(key: _Key) -> str:
    return f"{key[1]} ({key[0]})" if key[0] else key[1]
