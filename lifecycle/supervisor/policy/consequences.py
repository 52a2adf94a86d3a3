"""What is done about violations of an active system: what the manifest says, and when it is due.

Owns: `reaction_of`, which finds the nearest `on_violation` for a finding (node, system),
and `Consequences`: a violation that lasts has the consequence that is asked for it, once. It looks
at verdicts and carries nothing out: that is gate/hold.py's, by the orders that a person gives. Must
not import rclpy.
"""

from __future__ import annotations

from collections.abc import Iterable

import msgspec
from msgspec.structs import replace

from lifecycle.manifest.model import (
    BY_DEFAULT,
    Consequence,
    EndpointKind,
    OnViolation,
    Reaction,
    Restart,
)
from lifecycle.plan.model import Plan
from lifecycle.supervisor.control.protocol import Reach
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.run.events import Emitter
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import rule
from lifecycle.verify.rules.catalogue import About
from lifecycle.verify.verdict import Finding

_ORDER = tuple(Consequence)
_Key = tuple[str, str, str, EndpointKind | None]


def reaction_of(plan: Plan, finding: Finding) -> Reaction:
    """Return what is to be done about a violation.

    What is nearest counts: its nodes, then the system; there the id of the rule, then its family,
    then the default. Of two ends the stronger one counts.
    """
    names = finding.nodes or (finding.subject,)
    nodes = _strongest(
        finding, (each.on_violation for each in plan.nodes if each.full_name in names)
    )
    found = nodes or _strongest(finding, (plan.on_violation,))
    return found or Reaction(rule=BY_DEFAULT, what=Consequence.REPORT)


def _strongest(finding: Finding, said: Iterable[OnViolation]) -> Reaction | None:
    """Return the strongest of what several say about one finding; None if none says anything."""
    family = rule(finding.rule).family
    found: list[Reaction] = []
    for each in said:
        for name in (finding.rule, family, BY_DEFAULT):
            if own := [one for one in each if one.rule == name]:
                found += own
                break
    return max(found, key=lambda one: _ORDER.index(one.what), default=None)


class Due(msgspec.Struct, frozen=True, kw_only=True):
    """A consequence that is to be carried out now.

    Attributes:
        keys: for DEACTIVATE, of the nodes.
        mode: for MODE, the one to enter.
        finding: what it is for; the first where there are several.
    """

    what: Consequence
    keys: tuple[str, ...] = ()
    mode: str = ""
    finding: Finding


class Consequences:
    """Knows which violations of one system last, and what is to be done about them.

    Args:
        system: whose nodes.
        emit: whose clock counts.
        lasting_s: seconds for which a violation that may pass by itself is only looked at.
    """

    def __init__(self, system: System, emit: Emitter, *, lasting_s: float) -> None:
        self._system = system
        self._emit = emit
        self._lasting_s = lasting_s
        self._since: dict[_Key, float] = {}
        self._tried: set[_Key] = set()

    def forget(self) -> None:
        """Begin anew: the system is not active."""
        self._since = {}

    def look(self, findings: Iterable[Finding]) -> tuple[Due | None, float | None]:
        """Take what is found of an active system now.

        Args:
            findings: without those of nodes that are to be started again.

        Returns:
            What is due, and else in how many seconds something may be; None if nothing is.
        """
        now_s = self._emit.elapsed_s
        every = tuple(findings)
        coming = self._coming_elsewhere(every)
        self._tried &= {_key(each) for each in every}
        asked: dict[_Key, Due] = {}
        for each in every:
            if each.outcome is Outcome.VIOLATED and coming.isdisjoint(each.nodes):
                due = self._asked(each)
                if due is not None:
                    asked[_key(each)] = due
        self._since = {key: self._since.get(key, now_s) for key in asked}
        until_s = {key: since_s + self._lasting_s for key, since_s in self._since.items()}
        lasting = [due for key, due in asked.items() if until_s[key] <= now_s]
        if not lasting:
            return None, min(until_s.values()) - now_s if until_s else None
        worst = max(lasting, key=lambda due: _ORDER.index(due.what))
        keys = {key for each in lasting if each.what is worst.what for key in each.keys}
        if worst.what is Consequence.MODE:
            # A mode that its gate refuses is left again, and not entered for the same reason twice.
            self._tried |= {key for key, due in asked.items() if due.mode == worst.mode}
        ordered = tuple(key for key in self._system.nodes if key in keys)
        return replace(worst, keys=ordered), None

    def _asked(self, finding: Finding) -> Due | None:
        """Return what would still have an effect."""
        plan = self._system.plan
        reaction = reaction_of(plan, finding)
        what = reaction.what
        if what is Consequence.REPORT:
            return None
        names = set(finding.nodes or (finding.subject,))
        concerned = [each for each in plan.nodes if each.full_name in names]
        own = [node for node in self._system.nodes.values() if node.name in names]
        if concerned and not own:
            return None  # its own supervisor has the same manifest
        if what is Consequence.MODE:
            if self._system.mode == reaction.mode or _key(finding) in self._tried:
                return None
            return Due(what=what, mode=reaction.mode, finding=finding)
        if what is Consequence.DEACTIVATE:
            held = [node for node in own if node.is_to_be_active]
            if held:
                active = [each for each in held if each.reach is Reach.ACTIVE and not each.is_gone]
                keys = tuple(each.planned.key for each in active)
                return Due(what=what, keys=keys, finding=finding) if keys else None
            what = Consequence.PAUSE
        return Due(what=what, finding=finding)

    def _coming_elsewhere(self, findings: Iterable[Finding]) -> frozenset[str]:
        """Return the names of nodes that are away and that another supervisor starts again."""
        restarted = {
            each.full_name
            for each in self._system.plan.nodes
            if each.supervision.restart is not Restart.NO and each.key not in self._system.nodes
        }
        return frozenset(
            each.node
            for each in findings
            if each.node in restarted and rule(each.rule).about is About.PRESENCE
        )


def _key(finding: Finding) -> _Key:
    return finding.rule, finding.subject, finding.node, finding.endpoint
