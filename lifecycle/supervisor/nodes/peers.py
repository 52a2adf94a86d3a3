"""The other supervisors of a system: alive, lost, left, agreed.

Owns: `Peers`: announcing ourselves and our plan, noticing who is found, lost or shut down, what
they report of silent nodes, comparing clocks and plans, and marks that arrive. A manifest with
another node, another argument or another flow need on one of the hosts passes every check of the
running graph there: only the plans show it. Nothing here polls. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING

import msgspec
from msgspec.structs import replace

from lifecycle.graph.loop import set_within
from lifecycle.manifest.model import DiscoveryRange, RunKind
from lifecycle.manifest.names import supervisor_alive_topic
from lifecycle.measure.clock import ClockComparison, ClockOffset
from lifecycle.middleware.process.control import machine_id
from lifecycle.node.host.control import Operation
from lifecycle.plan.comparison import (
    PlanNotice,
    PlanNoticeError,
    concerns,
    decode,
    encode,
    notice_of,
)
from lifecycle.supervisor.nodes.liveliness import Cause
from lifecycle.supervisor.nodes.marks import Marks, carries_marks
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.run.events import MachineConnection
from lifecycle.verify.observation import ArrivedMark, Observation
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import PLAN_UNKNOWN, PLANS_DIFFER
from lifecycle.verify.rules.measured import compares_clocks
from lifecycle.verify.rules.nodes import MISSING_NODE
from lifecycle.verify.verdict import Finding, FlowReport, Verdict

if TYPE_CHECKING:
    from lifecycle.middleware.services.supervisor_topics import (
        AliveNotice,
        AlivePublisher,
        AliveSubscription,
        PlanNotices,
    )
    from lifecycle.supervisor.nodes.observer_participant import ObserverParticipant

ANNOUNCED_S = 5.0
"""A supervisor that is there has announced its plan within so long: with its first matched
endpoints, and where Fast DDS lost that, 3 s later."""

SAID_AFTER_S = (0.0, 0.1, 0.4)
"""Which nodes are silent is published again: Fast DDS repeats what was lost after up to 3 s."""

EXCHANGED_S = 1.0
"""Clocks are compared so often, where a delay between machines is declared, and marks are sent,
where a DSCP is."""

ASKED_S = (0.25, 0.25, 0.5)
"""An answer to what time it is elsewhere is waited for so long before it is asked again: a notice
may be lost, or wait in the queue of a congested network."""

FAILED = "failed: "
"""How the reason of a supervisor begins whose run failed."""

_MOST = 64
"""Supervisors whose notices are kept."""

_logger = logging.getLogger(__name__)


class _Peer(msgspec.Struct):
    """A supervisor that should be alive.

    Attributes:
        machine: whose it is.
        nodes: fully qualified names of the nodes that are lost with it.
        watch: None once it is not followed any more.
        lost_at_s: when it was lost; None while it is not.
        received: when its last notice was sent and received, and how often it had asked by then.
        clock: compared with ours.
        answered: our last question that it has answered; None before the first.
        unknown_since_s: since when it is there, and has not said its plan.
    """

    machine: str
    nodes: tuple[str, ...]
    watch: AliveSubscription | None = None
    alive: bool = False
    lost_at_s: float | None = None
    received: tuple[int, int, int] | None = None
    clock: ClockComparison = msgspec.field(default_factory=ClockComparison)
    answered: int | None = None
    unknown_since_s: float | None = None

    @property
    def what(self) -> str:
        """For messages."""
        return f"the supervisor of machine {self.machine!r}"


class Peers:
    """What a system depends on beside its own processes; `open` it in a loop and `close` it."""

    def __init__(self, system: System, participant: ObserverParticipant) -> None:
        self._system = system
        self._participant = participant
        self._loop = asyncio.get_running_loop()
        machines = dict.fromkeys(each.planned.machine for each in system.nodes.values())
        self._own = tuple(filter(None, machines))
        self._supervisors: list[_Peer] = []
        self._announcements: list[AlivePublisher] = []
        self._silent: Mapping[str, str] = {}
        self._asks = self._awaited = 0
        self._answered = asyncio.Event()
        self._exchanging: asyncio.TimerHandle | None = None
        self._notices: PlanNotices | None = None
        self._run = os.urandom(8).hex()
        self._marks = Marks(self._run)
        self._judged_marks: tuple[ArrivedMark, ...] = ()
        self._said: PlanNotice | None = None
        self._known: list[PlanNotice] = []

    def open(self) -> None:
        """Begin to watch, and announce ourselves and our plan where another supervisor may be."""
        system, plan = self._system.plan.system, self._system.plan
        remote = self._system.remote.values()
        for machine in filter(None, dict.fromkeys(each.machine for each in remote)):
            nodes = (each.full_name for each in remote if each.machine == machine)
            self._supervisors.append(self._watch(_Peer(machine, tuple(nodes))))
        if remote:
            self._announcements = [
                self._participant.announce_alive(
                    supervisor_alive_topic(system, each), self._in_loop(self._ask_newcomer)
                )
                for each in self._own
            ]
            self._system.liveliness.listen(self._say)
        if remote or plan.discovery_range not in (DiscoveryRange.LOCALHOST, DiscoveryRange.OFF):
            self._notices = self._participant.plan_notices(self._in_loop(self._take))
            self.announce()

    def announce(self) -> None:
        """Say what we plan from now on."""
        if self._notices is not None:
            plan = self._system.first
            self._said = notice_of(plan, run=self._run, host=machine_id(), machines=self._own)
            self._notices.announce(encode(self._said))
            if self._announcements and self._exchanging is None:
                self._exchange()

    def leave(self, reason: str) -> None:
        """Say that what comes is an orderly end, and why; begins with FAILED where a run failed."""
        if self._notices is not None and self._said is not None:
            notice = replace(self._said, left=True, reason=" ".join(reason.split()))
            self._notices.announce(encode(notice))

    async def close(self) -> None:
        """Announce, watch and compare no more."""
        if self._exchanging is not None:
            self._exchanging.cancel()
        if self._notices is not None:
            self._notices.destroy()
            self._notices = None
        self._marks.close()
        for peer in self._supervisors:
            if peer.watch is not None:
                peer.watch.destroy()
                peer.watch = None
        for announcement in self._announcements:
            announcement.destroy()
        self._announcements.clear()

    def _in_loop(self, do: Callable[..., None]) -> Callable[..., None]:
        """Return what has the loop do something, from any thread."""

        def call(*arguments: object) -> None:
            with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
                self._loop.call_soon_threadsafe(do, *arguments)

        return call

    # Who is alive

    def _watch(self, peer: _Peer) -> _Peer:
        def calls(do: Callable[..., None]) -> Callable[..., None]:
            def unless_forgotten(*arguments: object) -> None:
                if peer.watch is not None:  # else this was on its way as it was closed
                    do(peer, *arguments)

            return self._in_loop(unless_forgotten)

        peer.watch = self._participant.watch_alive(
            supervisor_alive_topic(self._system.plan.system, peer.machine),
            on_liveliness=calls(self._alive),
            on_left=calls(self._left),
            on_notice=calls(self._noticed),
        )
        return peer

    def _alive(self, peer: _Peer, is_alive: bool) -> None:
        if is_alive is peer.alive:
            return
        peer.alive, lost_s = is_alive, 0.0
        if not is_alive:
            peer.lost_at_s = self._loop.time()
            self._participant.send_again_soon()
            self._system.have_hosts(Operation.SEND_AGAIN_SOON)
        elif peer.lost_at_s is not None:
            lost_s, peer.lost_at_s = self._loop.time() - peer.lost_at_s, None
            # DDS may have forgotten the node names of participants that it lost for long.
            self._participant.republish_names()
            self._system.have_hosts(Operation.REPUBLISH_NAMES)
        self._system.emit(
            MachineConnection(machine=peer.machine, established=is_alive, lost_s=lost_s)
        )
        why = "" if is_alive else f"{peer.what} is not heard any more"
        self._system.liveliness.note(peer.nodes, Cause.LOST, why)

    def _left(self, peer: _Peer) -> None:
        """It left properly, or DDS forgot it after it was lost."""
        if not peer.alive:
            return
        peer.alive = False
        self._system.emit(MachineConnection(machine=peer.machine, established=False, left=True))
        self._system.liveliness.note(peer.nodes, Cause.REPORTED, "")

    def _noticed(self, peer: _Peer, notice: AliveNotice, sent_ns: int, received_ns: int) -> None:
        self._compare(peer, notice, sent_ns, received_ns)
        for name in peer.nodes:
            self._system.liveliness.note((name,), Cause.REPORTED, notice.silent.get(name, ""))

    def _say(self) -> None:
        """Our own nodes fell silent or came back: say so."""
        liveliness = self._system.liveliness
        causes = (Cause.HUNG, Cause.STOPPED)
        silent = {name: why for cause in causes for name, why in liveliness.causes(cause).items()}
        if silent == self._silent:
            return
        self._silent = silent

        def say() -> None:
            if silent is self._silent:
                self._notify()

        for wait_s in SAID_AFTER_S:
            self._loop.call_later(wait_s, say)

    def _notify(self) -> None:
        from lifecycle.middleware.services.supervisor_topics import AliveNotice

        notice = AliveNotice(
            silent=self._silent,
            received={each.machine: each.received for each in self._supervisors if each.received},
            asks=self._asks,
            marks=self._marks.own_ports,
        )
        for each in self._announcements:
            each.notify(notice)

    # What time it is there, and what arrives as it is sent

    def _exchange(self) -> None:
        """Have others compare with what is here, again and again while that is needed."""
        self._exchanging = None
        carries = carries_marks(self._system.first)
        if carries:
            self._marks.open()
            self._marks.send()
            if self._judged_marks != self._marks.arrived():
                self._system.touch()
        if carries or compares_clocks(self._system.first):
            self._notify()
            self._exchanging = self._loop.call_later(EXCHANGED_S, self._exchange)

    def _ask_newcomer(self) -> None:
        """Ask who begins to listen at once: data may congest the network soon."""
        if self._exchanging is not None:
            self._asks += 1
            self._notify()

    def _compare(self, peer: _Peer, notice: AliveNotice, sent_ns: int, received_ns: int) -> None:
        """It sent a notice, having received ours."""
        self._marks.ports[peer.machine] = notice.marks
        *_, asked = peer.received or (0, 0, 0)
        peer.received = (sent_ns, received_ns, notice.asks)
        if notice.asks != asked:
            self._notify()
        for own in self._own:
            if own in notice.received:
                t1_ns, t2_ns, peer.answered = notice.received[own]
                peer.clock.add(t1_ns, t2_ns, sent_ns, received_ns)
        if not self._lacks_answers():
            self._answered.set()

    def _lacks_answers(self) -> bool:
        """Whether a supervisor that is there has not answered the question that is waited for."""
        return any(
            each.alive and each.answered is not None and each.answered < self._awaited
            for each in self._supervisors
        )

    async def compare_clocks(self) -> None:
        """Compare clocks by exchanges that begin now, within all of ASKED_S."""
        self._awaited = self._asks + 1
        for wait_s in ASKED_S:
            self._asks += 1
            self._answered.clear()
            self._notify()
            if not self._lacks_answers() or await set_within(self._answered, wait_s):
                return

    def follow(self, flows: Iterable[FlowReport]) -> None:
        """Take the flows as they were verified just now."""
        if self._marks.own_ports == (0, 0):
            return  # none with a DSCP comes from elsewhere, or goes there
        machines = {each.full_name: each.machine for each in self._system.first.nodes}
        self._marks.follow(flows, machines, self._own)

    def marks(self) -> tuple[ArrivedMark, ...]:
        """Return with what DSCP arrives what other supervisors send beside flows to us."""
        self._judged_marks = self._marks.arrived()
        return self._judged_marks

    def clocks(self) -> tuple[tuple[str, ClockOffset], ...]:
        """Return how far the clocks of other machines are ahead, of those that are known."""
        now_ns = time.time_ns()
        found = ((each.machine, each.clock.offset(now_ns)) for each in self._supervisors)
        return tuple((machine, offset) for machine, offset in found if offset is not None)

    # Who planned what, and who was shut down

    def _take(self, text: str) -> None:
        if self._notices is None:
            return
        try:
            notice = decode(text)
        except PlanNoticeError as error:
            _logger.warning("passed over: %s", error)
            return
        if notice.run == self._run or notice in self._known:
            return
        if not concerns(self._system.first, frozenset(self._own), notice):
            return
        if notice.left and not any(each.run == notice.run for each in self._known):
            return  # it left before we came
        others = (each for each in self._known if not notice.replaces(each))
        self._known = [*others, notice][-_MOST:]
        self._marks.machines = {each.run: each.machines for each in self._known}
        self._system.touch()

    def _shut_down(self) -> dict[str, str]:
        """Return the machines of our plan whose supervisor has said that it ends, and why."""
        system = self._system.plan.system
        ours = (each for each in self._known if each.system == system and each.left)
        return {machine: each.reason[:80] for each in ours for machine in each.machines}

    def left(self) -> frozenset[str]:
        """Return the full names of the nodes of machines that were shut down properly.

        Not of those whose run failed: that is an end nobody asked for.
        """
        gone = self._shut_down().items()
        machines = {machine for machine, why in gone if not why.startswith(FAILED)}
        nodes = self._system.first.nodes
        return frozenset(each.full_name for each in nodes if each.machine in machines)

    def explained(self, verdict: Verdict) -> Verdict:
        """Return `verdict` with the reason of nodes that are missing since their host ended."""
        machines = {each.full_name: each.machine for each in self._system.first.nodes}
        gone = self._shut_down()

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

        return replace(verdict, findings=tuple(map(explain, verdict.findings)))

    def findings(self, observation: Observation) -> tuple[Finding, ...]:
        """Return what is wrong with what others planned, and who did not say it."""
        return (*self._different(), *self._unknown(observation))

    def _different(self) -> Iterator[Finding]:
        ours = "" if self._said is None else self._said.checksum
        for notice in self._known:
            if notice.checksum == ours:
                continue
            machines = " and ".join(repr(each[:80]) for each in notice.machines[:3])
            of = f"machine {machines}" if machines else f"host {notice.host[:40]!r}"
            if notice.system != self._system.plan.system:
                of = f"system {notice.system[:80]!r} on {of}"
            who = f"the supervisor of {of}"
            theirs = notice.checksum[: len(ours)]
            yield PLANS_DIFFER.finding(
                subject=who,
                expected=f"plan {ours}",
                observed=f"plan {theirs}",
                message=f"cannot rely on {who}: plans differ (checksums {ours} here, {theirs} "
                "there); compare 'lifecycle plan MANIFEST' on both",
            )

    def _unknown(self, observation: Observation) -> Iterator[Finding]:
        """Yield a finding for each machine that is there and has not said what it planned."""
        seen = {each.full_name for each in observation.nodes}
        started = (e for e in self._system.remote.values() if e.run.kind is not RunKind.ATTACH)
        there = {each.machine for each in started if each.full_name in seen}
        now_s = self._loop.time()
        for peer in self._supervisors:
            if not (peer.alive or peer.machine in there) or self._has_said(peer):
                peer.unknown_since_s = None
                continue
            if peer.unknown_since_s is None:
                peer.unknown_since_s = now_s
                self._loop.call_later(ANNOUNCED_S, self._touch)
            left_s = peer.unknown_since_s + ANNOUNCED_S - now_s
            assert self._said is not None
            yield PLAN_UNKNOWN.finding(
                outcome=Outcome.VIOLATED if left_s > 0 else Outcome.UNVERIFIABLE,
                subject=peer.what,
                expected=f"plan {self._said.checksum}",
                observed="not announced yet" if left_s > 0 else "not announced",
                message=f"cannot tell whether {peer.what} planned the same system: it has not said"
                + (" so yet" if left_s > 0 else f" what it planned within {ANNOUNCED_S:g} s"),
            )

    def _touch(self) -> None:
        if self._notices is not None:  # else it was closed meanwhile
            self._system.touch()

    def _has_said(self, peer: _Peer) -> bool:
        """Whether some notice is of a supervisor that runs its machine, or its nodes."""
        return any(
            peer.machine in each.machines
            or (each.system != self._system.plan.system and {*peer.nodes} & {*each.nodes})
            for each in self._known
        )
