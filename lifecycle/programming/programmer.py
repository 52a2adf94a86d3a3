"""Keeps networks in step with the verified flows of one system: from reports to rules to targets.

Also removes what dead runs left. What was applied manually stays: `lifecycle flows remove` or
`lifecycle down` ends it. Whatever waits may be cancelled: the ledger has what was made.
"""

from __future__ import annotations

import socket
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import psutil

from lifecycle.codec import from_json
from lifecycle.errors import LifecycleError, UsageError
from lifecycle.network.five_qi import DscpMapping, dscp_mapping
from lifecycle.network.nfe import canonical, is_loopback
from lifecycle.plan.model import Plan, PlannedNode
from lifecycle.programming.ledger import Ledger, TargetRecord, has_ledger, owner_is_dead
from lifecycle.programming.rules import FlowRule, RuleSet, SourceAddress, Treatment, flow_rules
from lifecycle.programming.target import (
    Means,
    PartlyError,
    Program,
    T,
    Target,
    TargetChanges,
    each_done,
    read_targets,
    target_kind,
)
from lifecycle.run_directory import is_held, run_name, runtime_root
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import FlowReport

_DISCARD_PORT = 9
"""RFC 863; connecting a UDP socket sends nothing."""


def read_program(names: Iterable[str], given: Mapping[str, Any], *, option: str) -> Program:
    """Return the networks that a person asked for, and what flows get in them.

    Args:
        names: of targets.
        given: values of options; `mapping` is the name or the file of a 5QI to DSCP mapping.
        option: that names are given by.

    Raises:
        UsageError: they do not fit together, or cannot be used.
    """
    given = dict(given)
    mapping, label_flows = given.pop("mapping", ""), given.pop("flow_labels", False)
    chosen = read_targets(names, given, option=option)
    if not chosen:
        raise UsageError(f"cannot use --dscp-from-5qi or --flow-labels without {option}")
    if not mapping:
        return Program(chosen, Treatment(label_flows=label_flows))
    try:
        file = Path(mapping)
        if file.is_file():
            found = from_json(file.read_bytes(), DscpMapping)
        else:
            found = dscp_mapping(mapping)
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot use {mapping!r} as 5QI to DSCP mapping: {error}") from error
    return Program(chosen, Treatment(mapping=found, label_flows=label_flows))


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


class Programmer:
    """Programs targets with the verified flows of one system, one call at a time.

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
        self._plan = plan
        self._targets = tuple(targets)
        self._means = means
        self._source_address = source_address
        self._treatment = treatment or Treatment()
        self._asked: tuple[FlowRule, ...] = ()
        self._is_done = False
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

    async def diff(self, flows: Iterable[FlowReport]) -> tuple[TargetChanges, ...]:
        """Return what `update` would do; changes no network."""
        rules = self.rules(flows).rules
        async with self._means.ledger.locked():
            return tuple([await each.plan(rules) for each in self._targets])

    def export(self, flows: Iterable[FlowReport]) -> str:
        """Return what targets would be given if nothing were there, as text.

        Raises:
            ValueError: see `Target.export`.
        """
        rules = self.rules(flows)
        return "".join(each.export(rules) for each in self._targets)

    async def update(
        self,
        flows: Iterable[FlowReport],
        *,
        hold: bool = False,
        within_s: float | None = None,
    ) -> tuple[TargetChanges, ...]:
        """Bring every target up to date with these flows.

        Args:
            flows: as last verified.
            hold: a flow that was asked for and is not verified at this moment keeps its rule
                until it is verified again or is no longer declared: while a node restarts, its old
                rule does no harm, and a session of a mobile network is costly to make again.
            within_s: for all that servers are asked; None bounds each request only.

        Returns:
            What was done, per target; nothing if the rules are the same as last time.

        Raises:
            PartlyError: one target or several could not be brought up to date; others are.
        """
        reports = tuple(flows)
        rules = self.rules(reports).rules
        if hold:
            rules = _with_held(rules, self._asked, reports)
        if rules == self._asked and self._is_done:
            return ()
        # If a target fails, the next call must not take it for done.
        self._asked, self._is_done = rules, False
        self._means.begin(within_s)
        async with self._means.ledger.locked():
            done = await _each(self._targets, lambda each: each.apply(rules))
        self._is_done = True
        return done

    async def renew(self, *, within_s: float | None = None) -> float | None:
        """Prolong what would expire; return seconds until the next time, None if never."""
        self._means.begin(within_s)
        async with self._means.ledger.locked():
            due = [await each.renew() for each in self._targets]
        return min((each for each in due if each is not None), default=None)


def open_programmer(
    plan: Plan,
    program: Program,
    *,
    environment: Mapping[str, str],
    machine: str = "",
    owned: bool = False,
) -> Programmer:
    """Return a programmer for this host.

    Args:
        plan: of the system.
        program: the networks to program, and how.
        environment: says where run directories are.
        machine: the machine that this host is; empty to determine it by its addresses.
        owned: the caller is the supervisor whose end is to end what is made.

    Raises:
        UsageError: options or settings cannot be used.
    """
    directory = runtime_root(environment) / run_name(plan, machine)
    means = Means(Ledger(directory, plan.system, owned=owned))
    return Programmer(
        plan,
        [each.open(means) for each in program.targets],
        means,
        source_address=route_sources(plan, machine),
        treatment=program.treatment,
    )


async def remove_programmed(
    directory: Path, *, within_s: float | None = None
) -> tuple[TargetChanges, ...]:
    """Remove everything of a run in networks, by whichever target it was made or by hand.

    Args:
        directory: of the run; its ledger lists what is there.
        within_s: for all that servers are asked; None bounds each request only.

    Raises:
        ProgrammingError: the ledger cannot be read.
        PartlyError: something could not be removed, or not in time; it stays listed.
    """
    # The name as the ledger has it: that of a directory is made safe.
    system = Ledger(directory, "").read().system or directory.name.partition("@")[0]
    means = Means(Ledger(directory, system))

    async def remove(record: TargetRecord) -> TargetChanges:
        kind = target_kind(record.target)
        return await kind(kind.restore(record), means).remove()

    means.begin(within_s)
    async with means.ledger.locked():
        return await _each(means.ledger.read().targets, remove)


async def sweep_orphans(
    root: Path, report: Callable[[str], None], *, own: str = "", within_s: float | None = None
) -> None:
    """Remove what the dead runs of this user left in networks.

    Args:
        root: directory of all run directories, see run_directory.runtime_root.
        report: takes what was removed, and what could not be and stays listed, as text for people.
        own: name of the caller's own run, whose directory it holds itself.
        within_s: for what servers are asked of each run; None bounds each request only.
    """
    for directory in _with_ledgers(root, own):
        try:
            if not owner_is_dead(Ledger(directory, "").read()):
                continue
            for each in await remove_programmed(directory, within_s=within_s):
                if each.changes:
                    report(f"left by a killed supervisor: {each.render(done=True)}")
        except LifecycleError as error:
            report(str(error))


def _with_ledgers(root: Path, own: str) -> list[Path]:
    """Return the run directories with a ledger that nobody else holds."""
    found = sorted(root.iterdir()) if root.is_dir() else []
    return [each for each in found if has_ledger(each) and (each.name == own or not is_held(each))]


def _with_held(
    rules: tuple[FlowRule, ...], asked: Iterable[FlowRule], reports: Sequence[FlowReport]
) -> tuple[FlowRule, ...]:
    unsure = {
        (each.topic, each.publisher, each.subscription)
        for each in reports
        if each.outcome is not Outcome.OK or not each.source or not each.destination
    }
    keys = {each.key for each in rules}
    held = [each for each in asked if each.key not in keys and unsure.issuperset(each.names)]
    return tuple(sorted((*rules, *held), key=lambda each: each.key))


async def _each(
    things: Iterable[T], do: Callable[[T], Awaitable[TargetChanges]]
) -> tuple[TargetChanges, ...]:
    done, failed = await each_done(things, do)
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
