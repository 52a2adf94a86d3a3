"""Which endpoints have unique network flow endpoints, by what nodes report. Pure.

For uniqueness the endpoints that nodes report are compared. An endpoint that no node reports lives
in another process, and it cannot share one of these NFEs: a UDP or TCP port belongs to one process
of a host (bind(2), EADDRINUSE), and another host has other addresses. So unknown NFEs make an
answer unknown only inside one process. Where the manifest declares the address of a machine, the
NFEs on that address are judged: it is by this one that flows between machines go.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Protocol

from lifecycle import dataclasses
from lifecycle.manifest import EndpointKind
from lifecycle.network import (
    InternetProtocol,
    LocatedNfe,
    NetworkFlowEndpoint,
    TransportProtocol,
    canonical,
    dissimilar,
    is_ip,
    is_multicast,
    is_wildcard,
    located,
)
from lifecycle.verify.observation import EndpointReport, NodeConfiguration

_SIDES = (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION)
_SEVERAL = -1
"""Instead of the one endpoint that has an NFE."""

_Bucket = tuple[EndpointKind, InternetProtocol, TransportProtocol, int]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _Entry:
    """One endpoint.

    Attributes:
        nfes: all that it reports; None if they are not known.
        judged: those of them that count.
    """

    kind: EndpointKind
    process: tuple[str, int]
    nfes: tuple[LocatedNfe, ...] | None
    judged: tuple[LocatedNfe, ...] | None


@dataclasses.dataclass(frozen=True, slots=True)
class _Reported:
    """What one node reports, kept so that the identities of its reports stay theirs."""

    configuration: NodeConfiguration
    entries: tuple[_Entry, ...]
    by_report: dict[int, _Entry]

    @classmethod
    def of(
        cls, configuration: NodeConfiguration, address: str, last: _Reported | None
    ) -> _Reported:
        """Read one configuration; entries that equal those of the node's last one are these."""
        reports = [
            each for each in configuration.endpoints if each.kind in _SIDES and not each.error
        ]
        entries = tuple(_entry(configuration, each, address) for each in reports)
        if last is not None and last.entries == entries:
            entries = last.entries
        by_report = {id(each): entry for each, entry in zip(reports, entries, strict=True)}
        return cls(configuration, entries, by_report)


def _entry(configuration: NodeConfiguration, report: EndpointReport, address: str) -> _Entry:
    identity = configuration.identity
    nfes = located(
        report.nfes,
        identity.machine_id,
        dscp=report.dscp if report.kind is EndpointKind.PUBLISHER else None,
    )
    return _Entry(
        kind=report.kind,
        process=(identity.machine_id, identity.process_id),
        nfes=nfes,
        judged=None if nfes is None else _that_count(nfes, address),
    )


class _Judged:
    """Compares the endpoints of all nodes."""

    def __init__(self, entries: list[tuple[_Entry, ...]]) -> None:
        self._of = entries
        self._answers: dict[int, bool | None] = {}
        # NFEs with another port or protocol are dissimilar whatever else they hold, so only those
        # of one bucket are ever compared: judging grows with the endpoints, not with their square.
        # Endpoints of one participant have the same NFEs, so each is kept once, with whose it is.
        self._buckets: dict[_Bucket, dict[LocatedNfe, int]] = {}
        self._unknown: set[tuple[EndpointKind, tuple[str, int]]] = set()
        for reported in entries:
            for entry in reported:
                self._add(entry)

    def is_of(self, entries: list[tuple[_Entry, ...]]) -> bool:
        """Whether these are the endpoints that are compared: the same objects."""
        return len(entries) == len(self._of) and all(map(operator.is_, entries, self._of))

    def is_unique(self, entry: _Entry) -> bool | None:
        """Return whether one of them is unique; None when its NFEs are not known."""
        key = id(entry)
        if key not in self._answers:
            self._answers[key] = self._judge(entry)
        return self._answers[key]

    def _add(self, entry: _Entry) -> None:
        if entry.judged is None:
            self._unknown.add((entry.kind, entry.process))
            return
        for each in entry.judged:
            if is_ip(each):
                owners = self._buckets.setdefault(_bucket(entry.kind, each), {})
                if owners.setdefault(each, id(entry)) != id(entry):
                    owners[each] = _SEVERAL

    def _judge(self, entry: _Entry) -> bool | None:
        if entry.judged is None:
            return None
        kind, me = entry.kind, id(entry)
        own = [each for each in entry.judged if is_ip(each)]
        for each in own:
            owners = self._buckets[_bucket(kind, each)]
            if owners[each] == _SEVERAL or not all(
                owner == me or dissimilar(each, other) for other, owner in owners.items()
            ):
                return False
        if not own:
            return False  # the network sees nothing of it
        return None if (kind, entry.process) in self._unknown else True


class ReportedEnd(Protocol):
    """An endpoint with what its node reports of it."""

    @property
    def report(self) -> EndpointReport | None:
        """The report; None if there is none."""


class Uniqueness:
    """Answers for every reported endpoint whether it is unique."""

    def __init__(
        self,
        configurations: Iterable[NodeConfiguration],
        addresses: Mapping[str, str] = MappingProxyType({}),
        last: Uniqueness | None = None,
    ) -> None:
        """Collect what nodes report.

        Args:
            configurations: of every node.
            addresses: declared address of each node's machine, by full node name.
            last: of an earlier moment, with the same addresses; what it read of configurations
                that are still the same objects is taken over. It changes the cost alone.

        Attributes:
            judged: stays the same object while every answer does.
        """
        configurations = tuple(configurations)
        self.read: list[_Reported] = []
        self._entries: dict[int, _Entry] = {}
        before = {id(each.configuration): each for each in last.read} if last is not None else {}
        staying = set(map(id, configurations))
        replaced = {
            each.configuration.name: each for key, each in before.items() if key not in staying
        }
        for configuration in configurations:
            # Taken once: what is reported twice, be it by one object, has two owners.
            read = before.pop(id(configuration), None)
            if read is None:
                name = configuration.name
                read = _Reported.of(
                    configuration, addresses.get(name, ""), replaced.pop(name, None)
                )
            self.read.append(read)
            self._entries.update(read.by_report)
        entries = [each.entries for each in self.read]
        same = last is not None and last.judged.is_of(entries)
        self.judged: _Judged = last.judged if last is not None and same else _Judged(entries)

    @classmethod
    def of(
        cls,
        configurations: tuple[NodeConfiguration, ...],
        addresses: Mapping[str, str],
        last: Uniqueness | None,
    ) -> Uniqueness:
        """Return what is to be said of configurations: `last` if they are the same objects."""
        if last is not None and len(last.read) == len(configurations):
            read = (each.configuration for each in last.read)
            if all(map(operator.is_, read, configurations)):
                return last
        return cls(configurations, addresses, last)

    def nfes(self, ends: Sequence[ReportedEnd]) -> tuple[NetworkFlowEndpoint, ...]:
        """Return the NFEs of endpoints, each once, with the DSCP that was read back."""
        entries = (self._entries.get(id(end.report)) for end in ends)
        found = (each.nfe for entry in entries if entry for each in entry.nfes or ())
        return tuple(dict.fromkeys(found))

    def is_unique(self, end: ReportedEnd) -> bool | None:
        """Return whether an endpoint is unique; None when its NFEs are not known."""
        entry = self._entries.get(id(end.report))
        if entry is None:
            return None
        return self.judged.is_unique(entry)

    def all_unique(self, ends: Sequence[ReportedEnd]) -> bool | None:
        """Return whether each of several endpoints is unique; False if one is certainly not."""
        answers = [self.is_unique(end) for end in ends]
        if False in answers:
            return False
        return None if None in answers or not answers else True


def _that_count(nfes: tuple[LocatedNfe, ...], address: str) -> tuple[LocatedNfe, ...]:
    """Return the NFEs on the address that the machine is declared to have; all if none is.

    A host has addresses that lead nowhere outside, and many hosts have the same: each container
    bridge is 172.17.0.1. Two endpoints on two of them do not share a flow. Wildcards and groups
    count as the declared address too.
    """
    wanted = canonical(address)
    found = tuple(
        each
        for each in nfes
        if is_wildcard(each.nfe.internet_address)
        or is_multicast(each.nfe.internet_address)
        or canonical(each.nfe.internet_address) == wanted
    )
    unicast = any(not is_multicast(each.nfe.internet_address) for each in found)
    return found if address and unicast else nfes


def _bucket(kind: EndpointKind, located_nfe: LocatedNfe) -> _Bucket:
    nfe = located_nfe.nfe
    return (kind, nfe.internet_protocol, nfe.transport_protocol, nfe.transport_port)
