"""A case of the catalogue: one way to fool the gate, or one healthy system, and what must be said.

A case knows nothing of the package's inside: files, command lines, what was printed and reported,
exit codes, and what nodes received. The same table is asked of any installation (`LIFECYCLE=`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tests.outside.running import Run

OK = "ok"
VIOLATED = "violated"
UNVERIFIABLE = "unverifiable"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """One row of the catalogue.

    Attributes:
        attack: what is tried, as a sentence; the test's id.
        manifest: text of the manifest. Its nodes are those of `programs/nodes.py`, or of `files`.
        files: further files beside the manifest, by name.
        verb: words of the command but for the manifest: ("up", "--strict", "--stop-after", "3").
        strangers: programs that run before the command begins: words of `programs/stranger.py`.
        story: what is done while the command runs; it ends before the command is waited for.
        exit_code: of the command; several where the order of events is not ours to choose.
        verdict: of the report (`--report`) of `up` and `verify`; None: there is none, or any.
        findings: ids of rules that the report must name.
        not_findings: ids of rules that it must not name.
        violated: what messages of findings must name whose outcome is violated.
        activated: exactly these nodes ran `on_activate`; None: any. Empty: the gate never opened.
        received: exactly these payloads reached nodes of the system; None: any.
        says: what must be in the output, whatever its lines.
        not_says: what must not be in the output.
        within_s: the command ends within so many seconds.
        quick: is in `make test`, too.
    """

    attack: str
    manifest: str
    files: Mapping[str, str] = dataclasses.field(default_factory=dict)
    verb: tuple[str, ...] = ("up", "--strict", "--stop-after", "2")
    strangers: tuple[tuple[str, ...], ...] = ()
    story: Callable[[Run], None] | None = None
    exit_code: int | tuple[int, ...] = 0
    verdict: str | None = None
    findings: tuple[str, ...] = ()
    not_findings: tuple[str, ...] = ()
    violated: tuple[str, ...] = ()
    activated: frozenset[str] | None = None
    received: frozenset[str] | None = None
    says: tuple[str, ...] = ()
    not_says: tuple[str, ...] = ()
    within_s: float = 60.0
    quick: bool = False

    @property
    def exit_codes(self) -> tuple[int, ...]:
        """All that are right."""
        return self.exit_code if isinstance(self.exit_code, tuple) else (self.exit_code,)


NOBODY: frozenset[str] = frozenset()
"""For `activated` and `received`."""

REFUSED: Mapping[str, Any] = {"exit_code": 4, "verdict": VIOLATED, "activated": NOBODY}
"""What a case expects whose gate must not open."""
