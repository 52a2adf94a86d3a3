"""Keeps networks in step with the verified flows of one system: from reports to rules to targets.

Also removes what dead runs left. What was applied manually stays: `lifecycle flows remove` or
`lifecycle down` ends it. Blocking: a supervisor has a thread for it.
"""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import psutil

from lifecycle.errors import LifecycleError, UsageError
from lifecycle.network.five_qi import dscp_mapping, parse_mapping
from lifecycle.network.nfe import canonical, is_loopback
from lifecycle.plan.model import Plan, PlannedNode
from lifecycle.programming.ledger import Ledger, TargetRecord, has_ledger, owner_is_dead
from lifecycle.programming.rules import FlowRule, RuleSet, SourceAddress, Treatment, flow_rules
from lifecycle.programming.target import (
    Chosen,
    Means,
    PartlyError,
    T,
    Target,
    TargetChanges,
    each_done,
    target_kind,
)
from lifecycle.run_directory import is_held, run_name, runtime_root
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import FlowReport

_DISCARD_PORT = 9
"""RFC 863; connecting a UDP socket sends nothing."""


def read_treatment(mapping: str, *, label_flows: bool) -> Treatment:
    """Return what a person asked for; `mapping` is the name or the file of one, empty for none.

    Raises:
        UsageError: no such mapping, or its file cannot be used.
    """
    if not mapping:
        return Treatment(label_flows=label_flows)
    try:
        file = Path(mapping)
        found = parse_mapping(file.read_bytes()) if file.is_file() else dscp_mapping(mapping)
    except (OSError, ValueError) as error:
        raise UsageError(str(error)) from error
    return Treatment(mapping=found, label_flows=label_flows)


def route_sources(plan: Plan, machine: str = "") -> SourceAddress:
    """Return what observes source addresses, see rules.SourceAddress.

    A publisher's socket is bound to `0.0.0.0`, so the source address of its packets is known only
    by the route they take. For publishers on other machines this host cannot know it.

    Args:
        plan: says which machine a node is on.
        machine: the machine that this host is; empty to determine it by its addresses.
    """
    own = {
        canonical(each.address.partition("%")[0])
        for addresses in psutil.net_if_addrs().values()
        for each in addresses
        if each.family in (socket.AF_INET, socket.AF_INET6)
    }
    elsewhere = {
        each.name
        for each in plan.machines
        if each.name != machine and each.address and canonical(each.address) not in own
    }

    def observe(node: PlannedNode, destination: str) -> str:
        if node.machine in elsewhere:
            return ""
        if is_loopback(destination):
            # A packet to loopback comes from loopback, whatever the routing says.
            return canonical(destination)
        return route_source(destination)

    return observe


def route_source(destination: str) -> str:
    """Return the address that this host sends from to `destination`; empty if it has no route."""
    family = socket.AF_INET6 if ":" in destination else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as sock:
        try:
            sock.connect((destination, _DISCARD_PORT))
        except OSError:
            return ""
        return canonical(str(sock.getsockname()[0]))


class Removal:
    """Removes everything of one run in networks, also what was applied manually.

    One thread removes, another cancels.
    """

    def __init__(self, means: Means) -> None:
        self._ledger = means.ledger
        self._patience = means.patience
        self._means = means

    def close(self, *, within_s: float | None = None) -> tuple[TargetChanges, ...]:
        """Remove everything that the ledger lists, by whichever target it was made.

        Args:
            within_s: for all that servers are asked; None for the patience with each request.

        Raises:
            PartlyError: something could not be removed, or not in time; it stays listed.
        """

        def remove(record: TargetRecord) -> TargetChanges:
            kind = target_kind(record.target)
            return kind(kind.restore(record), self._means).remove()

        with self._patience.within(within_s), self._ledger.locked():
            return _each(self._ledger.read().targets, remove)

    def cancel(self) -> None:
        """From another thread: have what servers are asked fail at once, until `resume`."""
        self._patience.cancelled.set()

    def resume(self) -> None:
        """Ask servers again after a `cancel`."""
        self._patience.cancelled.clear()


class Programmer(Removal):
    """Programs targets with the verified flows of one system.

    Args:
        source_address: observes where publishers send from; None believes the manifest only.
    """

    def __init__(
        self,
        plan: Plan,
        targets: Sequence[Target],
        means: Means,
        *,
        source_address: SourceAddress | None = None,
        treatment: Treatment | None = None,
    ) -> None:
        super().__init__(means)
        self._plan = plan
        self._targets = tuple(targets)
        self._source_address = source_address
        self._treatment = treatment or Treatment()
        self._applied: tuple[FlowRule, ...] | None = None
        # What targets have, as far as is known: all of it once every target was brought up to date.
        self._programmed: dict[str, FlowRule] = {}
        self.left_out: tuple[str, ...] = ()

    def replan(self, plan: Plan) -> None:
        """Take another plan of the same system and machines: its flows are programmed next."""
        self._plan = plan

    def rules(self, flows: Iterable[FlowReport]) -> RuleSet:
        """Return what may be programmed of these flows, and what may not."""
        found = flow_rules(
            flows,
            self._plan,
            source_address=self._source_address,
            treatment=self._treatment,
        )
        self.left_out = found.left_out
        return found

    def diff(self, flows: Iterable[FlowReport]) -> tuple[TargetChanges, ...]:
        """Return what `update` would do; changes no network."""
        rules = self.rules(flows).rules
        with self._ledger.locked():
            return tuple(each.plan(rules) for each in self._targets)

    def export(self, flows: Iterable[FlowReport]) -> str:
        """Return what targets would be given if nothing were there, as text.

        Raises:
            ValueError: see `Target.export`.
        """
        rules = self.rules(flows)
        return "".join(each.export(rules) for each in self._targets)

    def update(
        self,
        flows: Iterable[FlowReport],
        *,
        hold: bool = False,
        within_s: float | None = None,
    ) -> tuple[TargetChanges, ...]:
        """Bring every target up to date with these flows.

        Args:
            flows: as last verified.
            hold: a flow that was programmed and is not verified at this moment keeps its rule
                until it is verified again or is no longer declared: while a node restarts, its old
                rule does no harm, and a session of a mobile network is costly to make again.
            within_s: for all that servers are asked; None for the patience with each request.

        Returns:
            What was done, per target; nothing if the rules are the same as last time.

        Raises:
            PartlyError: one target or several could not be brought up to date; others are.
        """
        reports = tuple(flows)
        rules = self.rules(reports).rules
        if hold:
            rules = _with_held(rules, self._programmed.values(), reports)
        if rules == self._applied:
            return ()
        # Forgotten first: if a target fails, the next call must not take it for done. What was
        # programmed is not: it is held whether or not the last call succeeded.
        self._applied = None
        by_key = {each.key: each for each in rules}

        def apply(target: Target) -> TargetChanges:
            changes = target.apply(rules)
            self._programmed |= by_key
            return changes

        with self._patience.within(within_s), self._ledger.locked():
            try:
                done = _each(self._targets, apply)
            except LifecycleError:
                listed = [entry for each in self._ledger.read().targets for entry in each.entries]
                made = {each.key.rsplit(" ", 2)[0] for each in listed}  # without "to device"
                self._programmed |= {key: each for key, each in by_key.items() if key in made}
                raise
        self._applied, self._programmed = rules, by_key
        return done

    def renew(self, *, within_s: float | None = None) -> float | None:
        """Prolong what would expire; return seconds until the next time, None if never."""
        with self._patience.within(within_s), self._ledger.locked():
            due = [each.renew() for each in self._targets]
        return min((each for each in due if each is not None), default=None)

    def close(self, *, within_s: float | None = None) -> tuple[TargetChanges, ...]:
        """Remove everything, see Removal."""
        self._applied, self._programmed = None, {}
        return super().close(within_s=within_s)


def open_programmer(
    plan: Plan,
    chosen: Sequence[Chosen],
    *,
    environment: Mapping[str, str],
    machine: str = "",
    owned: bool = False,
    treatment: Treatment | None = None,
) -> Programmer:
    """Return a programmer for this host.

    Args:
        plan: of the system.
        chosen: the networks to program.
        environment: says where run directories are.
        machine: the machine that this host is; empty to determine it by its addresses.
        owned: the caller is the supervisor whose end is to end what is made.
        treatment: see Treatment.

    Raises:
        UsageError: options or settings cannot be used.
    """
    directory = runtime_root(environment) / run_name(plan, machine)
    means = Means(Ledger(directory, plan.system, owned=owned))
    return Programmer(
        plan,
        [each.open(means) for each in chosen],
        means,
        source_address=route_sources(plan, machine),
        treatment=treatment,
    )


def removal_of(directory: Path) -> Removal:
    """Return what removes everything of the run in a directory.

    Raises:
        ProgrammingError: the ledger cannot be read.
    """
    # The name as the ledger has it: that of a directory is made safe.
    system = Ledger(directory, "").read().system or directory.name.partition("@")[0]
    return Removal(Means(Ledger(directory, system)))


def sweep_orphans(
    root: Path,
    report: Callable[[str], None],
    *,
    own: str = "",
    within_s: float | None = None,
) -> None:
    """Remove what the dead runs of this user left in networks.

    Args:
        root: directory of all run directories, see run_directory.runtime_root.
        report: takes what was removed, and what could not be and stays listed, as text for people.
        own: name of the caller's own run, whose directory it holds itself.
        within_s: for all that servers are asked; None for the patience with each request.
    """
    until_s = math.inf if within_s is None else time.monotonic() + within_s
    for directory in sorted(root.iterdir()) if root.is_dir() else ():
        if not has_ledger(directory) or (directory.name != own and is_held(directory)):
            continue
        try:
            if not owner_is_dead(Ledger(directory, "").read()):
                continue
            for each in removal_of(directory).close(within_s=until_s - time.monotonic()):
                if each.changes:
                    report(f"left by a killed supervisor: {each.render(done=True)}")
        except LifecycleError as error:
            report(str(error))


def _with_held(
    rules: tuple[FlowRule, ...], programmed: Iterable[FlowRule], reports: Sequence[FlowReport]
) -> tuple[FlowRule, ...]:
    unsure = {
        (each.topic, each.publisher, each.subscription)
        for each in reports
        if each.outcome is not Outcome.OK or not each.source or not each.destination
    }
    keys = {each.key for each in rules}
    held = tuple(
        each
        for each in programmed
        if each.key not in keys and all(map(unsure.__contains__, each.names))
    )
    return tuple(sorted((*rules, *held), key=lambda each: each.key))


def _each(things: Iterable[T], do: Callable[[T], TargetChanges]) -> tuple[TargetChanges, ...]:
    done, failed = each_done(things, do)
    if len(failed) == 1 and not done:
        raise failed[0][1]
    if failed:
        raise PartlyError(
            "targets",
            len(done) + len(failed),
            [("", error) for _, error in failed],
            done=[each.render(done=True) for each in done if each.changes],
        )
    return tuple(done)
