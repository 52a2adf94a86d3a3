"""Compares the plans of the supervisors of one system, and notices which was shut down.

Owns: announcing our plan, comparing those of others with it, and the findings that come of it. A
manifest with another node, another argument or another flow need on one of the hosts passes every
check of the running graph there: only the plans show it. Nothing here polls. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING

from msgspec.structs import replace

from lifecycle.manifest.model import DiscoveryRange, RunKind
from lifecycle.middleware.process.control import machine_id
from lifecycle.plan.comparison import (
    PlanNotice,
    PlanNoticeError,
    concerns,
    decode,
    encode,
    notice_of,
)
from lifecycle.plan.model import Plan
from lifecycle.supervisor.nodes.system import System
from lifecycle.verify.observation import Observation
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import rule
from lifecycle.verify.rules.nodes import MISSING_NODE
from lifecycle.verify.rules.run import PLAN_UNKNOWN, PLANS_DIFFER
from lifecycle.verify.verdict import Finding, Verdict

if TYPE_CHECKING:
    from lifecycle.middleware.discovery.liveliness import PlanNotices
    from lifecycle.supervisor.health.peer_supervisors import PeerSupervisors
    from lifecycle.supervisor.nodes.observer_participant import ObserverParticipant

ANNOUNCED_S = 5.0
"""A supervisor that is there has announced its plan within so long: with its first matched
endpoints, and where Fast DDS lost that, 3 s later."""

_MOST = 64
"""Supervisors whose notices are kept."""

_logger = logging.getLogger(__name__)


FAILED = "failed: "
"""How the reason of a supervisor begins whose run failed."""


class Agreement:
    """Compares our plan with those of the other supervisors; `open` it in a loop and `close` it.

    Args:
        system: ours.
        air: carries the notices.
        connected: who is there.
    """

    def __init__(
        self, system: System, air: ObserverParticipant, connected: PeerSupervisors
    ) -> None:
        self._system = system
        self._air = air
        self._connected = connected
        self._loop = asyncio.get_running_loop()
        self._plan = system.first
        self._own = tuple(
            machine
            for machine in dict.fromkeys(each.planned.machine for each in system.nodes.values())
            if machine
        )
        self._notices: PlanNotices | None = None
        self._run = os.urandom(8).hex()
        self._said: PlanNotice | None = None
        self._known: list[PlanNotice] = []
        self._since: dict[str, float] = {}
        self._again: asyncio.TimerHandle | None = None

    def open(self) -> None:
        """Announce our plan where another supervisor may be, and take notice of others'."""
        near = self._plan.discovery_range in (DiscoveryRange.LOCALHOST, DiscoveryRange.OFF)
        if near and not self._system.remote:
            return
        self._notices = self._air.plan_notices(self._arrived)
        self.announce(self._plan)

    def announce(self, plan: Plan) -> None:
        """Say that this is what we plan from now on."""
        self._plan = plan
        if self._notices is not None:
            self._said = notice_of(plan, run=self._run, host=machine_id(), machines=self._own)
            self._notices.announce(encode(self._said))

    def leave(self, reason: str) -> None:
        """Say that what comes is an orderly end, and why; begins with FAILED where a run failed."""
        if self._notices is not None and self._said is not None:
            notice = replace(self._said, left=True, reason=" ".join(reason.split()))
            self._notices.announce(encode(notice))

    def close(self) -> None:
        """Announce and compare no more."""
        if self._again is not None:
            self._again.cancel()
        if self._notices is not None:
            self._notices.destroy()
            self._notices = None

    @property
    def shut_down(self) -> dict[str, str]:
        """Machines of our plan whose supervisor has said that it ends, and why."""
        ours = (each for each in self._known if each.system == self._plan.system and each.left)
        return {machine: each.reason[:80] for each in ours for machine in each.machines}

    def left(self) -> frozenset[str]:
        """Return the full names of the nodes of machines that were shut down properly.

        Not of those whose run failed: that is an end nobody asked for.
        """
        ended = self.shut_down.items()
        machines = {machine for machine, why in ended if not why.startswith(FAILED)}
        return frozenset(each.full_name for each in self._plan.nodes if each.machine in machines)

    def follows_from_shut_down(self, verdict: Verdict) -> bool:
        """Whether nothing is violated but the absence of machines that were shut down properly."""
        gone = self.left()
        violated = [each for each in verdict.findings if each.outcome is Outcome.VIOLATED]
        return bool(violated) and all(
            rule(each.rule).about is not None and not gone.isdisjoint(each.nodes)
            for each in violated
        )

    def findings(self, observation: Observation) -> tuple[Finding, ...]:
        """Return what is wrong with what others planned, and who did not say it."""
        return (*self._different(), *self._unknown(observation))

    def explained(self, verdict: Verdict) -> Verdict:
        """Return `verdict` with the reason of nodes that are missing since their host ended."""
        machines = {each.full_name: each.machine for each in self._plan.nodes}
        gone = self.shut_down

        def explain(finding: Finding) -> Finding:
            machine = machines.get(finding.node)
            if finding.rule != MISSING_NODE.id or machine not in gone:
                return finding
            why = f" ({gone[machine]})" if gone[machine] else ""
            return replace(
                finding,
                observed=f"machine {machine!r} was shut down",
                message=f"{finding.message}: machine {machine!r} was shut down by its supervisor"
                f"{why}",
            )

        if not gone:
            return verdict
        return replace(verdict, findings=tuple(map(explain, verdict.findings)))

    def _arrived(self, text: str) -> None:
        with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
            self._loop.call_soon_threadsafe(self._take, text)

    def _take(self, text: str) -> None:
        if self._notices is None:
            return
        try:
            notice = decode(text)
        except PlanNoticeError as error:
            _logger.warning("passed over: %s", error)
            return
        own = frozenset(self._own)
        if notice.run == self._run or notice in self._known:
            return
        if not concerns(self._plan, own, notice):
            return
        if notice.left and not any(each.run == notice.run for each in self._known):
            return  # it left before we came
        others = (each for each in self._known if not notice.replaces(each))
        self._known = [*others, notice][-_MOST:]
        self._system.touch()

    def _different(self) -> Iterator[Finding]:
        ours = "" if self._said is None else self._said.checksum
        for notice in self._known:
            if notice.checksum == ours:
                continue
            who = _who(notice, self._plan.system)
            theirs = notice.checksum[: len(ours)]
            yield PLANS_DIFFER.finding(
                outcome=Outcome.VIOLATED,
                subject=who,
                expected=f"plan {ours}",
                observed=f"plan {theirs}",
                message=f"cannot rely on {who}: plans differ (checksums {ours} here, {theirs} "
                "there); compare 'lifecycle plan MANIFEST' on both",
            )

    def _unknown(self, observation: Observation) -> Iterator[Finding]:
        """Yield a finding for each machine that is there and has not said what it planned."""
        seen = {each.full_name for each in observation.nodes}
        remote = [(each.full_name, each) for each in self._system.remote.values()]
        waits_s: list[float] = []
        for machine in dict.fromkeys(planned.machine for _, planned in remote):
            ours = [(name, planned.run) for name, planned in remote if planned.machine == machine]
            names = {name for name, _ in ours}
            runs = {name for name, run in ours if run.kind is not RunKind.ATTACH}
            there = machine in self._connected.machines or bool(runs & seen)
            if not machine or not there or self._says(machine, names):
                self._since.pop(machine, None)
                continue
            left_s = self._since.setdefault(machine, self._loop.time()) + ANNOUNCED_S
            left_s -= self._loop.time()
            if left_s > 0:
                waits_s.append(left_s)
            assert self._said is not None
            who = f"the supervisor of machine {machine!r}"
            yield PLAN_UNKNOWN.finding(
                outcome=Outcome.VIOLATED if left_s > 0 else Outcome.UNVERIFIABLE,
                subject=who,
                expected=f"plan {self._said.checksum}",
                observed="not announced yet" if left_s > 0 else "not announced",
                message=f"cannot tell whether {who} planned the same system: it has not said"
                + (" so yet" if left_s > 0 else f" what it planned within {ANNOUNCED_S:g} s"),
            )
        if waits_s:
            if self._again is not None:
                self._again.cancel()
            self._again = self._loop.call_later(min(waits_s), self._system.touch)

    def _says(self, machine: str, names: set[str]) -> bool:
        """Whether some notice is of a supervisor that runs the machine, or its nodes."""
        return any(
            machine in each.machines
            or (each.system != self._plan.system and not names.isdisjoint(each.nodes))
            for each in self._known
        )


def _who(notice: PlanNotice, system: str) -> str:
    machines = " and ".join(repr(each[:80]) for each in notice.machines[:3])
    of = f"machine {machines}" if machines else f"host {notice.host[:40]!r}"
    if notice.system == system:
        return f"the supervisor of {of}"
    return f"the supervisor of system {notice.system[:80]!r} on {of}"
