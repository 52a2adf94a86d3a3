"""Which transport carries a publisher → subscription pair: the rules of negotiation for one pair.

The first rule that applies decides; what both ends cannot have is a problem with its reason.

1.  No common wire format or paradigm: a problem.
2.  Asked for, by a link, else the publisher, else the subscription: that, if both ends can have it.
    Inside a process only `shm` and `multicast` can be asked for, and are handed over directly.
    `multicast` to another host is TCP; `network` is what is there if that is one IP transport, else
    UDP before TCP, IPv6 first where a host has an IPv6 address.
3.  One process: handed over inside it.
4.  An end whose transports are not known: its RMW chooses.
5.  One host: what is there anyway if that is one transport; shared memory; one datagram to a group
    (TTL 0, loopback) where several processes listen; UDP, TCP.
6.  Two hosts: TCP if the publisher sends to a group, which stays on its host, or if the data may
    not be lost and are more than one datagram; else what is there anyway, UDP, TCP.

An end that asked for something else than what was chosen, where no link decides, is a problem.

Owns: `carried`, what Fast DDS does with two participants, and `choose`, these rules. Pure.
"""

from __future__ import annotations

from collections.abc import Collection

import msgspec

from lifecycle.manifest.model import EndpointKind, FlowTransport
from lifecycle.network.medium import CONNECTABLE, Medium, is_fragmented, max_unfragmented
from lifecycle.plan.negotiation.data_layer import End, Party, PartyEndpoint


class Pair(msgspec.Struct, frozen=True, kw_only=True):
    """A publisher and a subscription of one topic.

    Attributes:
        link: the transport that a link demands.
    """

    publisher: Party
    writer: PartyEndpoint
    subscription: Party
    reader: PartyEndpoint
    link: FlowTransport = FlowTransport.ANY

    @property
    def ends(self) -> tuple[End, End]:
        """The publisher and the subscription, as keys."""
        return (
            (self.publisher.key, EndpointKind.PUBLISHER, self.writer.name),
            (self.subscription.key, EndpointKind.SUBSCRIPTION, self.reader.name),
        )

    @property
    def same_host(self) -> bool:
        """Whether both are on one host."""
        return self.publisher.host == self.subscription.host

    @property
    def same_process(self) -> bool:
        """Whether both are in one process."""
        return self.same_host and self.publisher.process == self.subscription.process

    @property
    def present(self) -> list[Medium]:
        """By what the data go if neither end leaves its participant, see `carried`."""
        return carried(
            self.writer.by or self.publisher.own,
            self.reader.by or self.subscription.own,
            same_host=self.same_host,
        )

    @property
    def lossy(self) -> bool | None:
        """Whether the data bear an unreliable transport: either end can deny it."""
        said = (self.writer.lossy, self.reader.lossy)
        return False if False in said else True if True in said else None

    @property
    def subject(self) -> str:
        """Spell it for a message."""
        return f"{self.writer.resolved!r} from {self.publisher.key!r} to {self.subscription.key!r}"


class Choice(msgspec.Struct, frozen=True, kw_only=True):
    """What a pair gets.

    Attributes:
        medium: as `PlannedFlow.medium`; empty if not known, or with a problem.
        reason: one phrase for people.
        problem: why nothing can carry it; starts with "cannot".
        hint: what may help.
    """

    medium: str = ""
    reason: str = ""
    problem: str = ""
    hint: str = ""

    @property
    def inside(self) -> bool:
        """Whether it is handed over inside a process."""
        return self.medium == Medium.INTRAPROCESS

    @property
    def by_group(self) -> bool:
        """Whether one datagram of it goes to a group."""
        return self.medium == Medium.UDPM


MEETING = Medium.SHM
"""By what participants of one process find each other, if they have nothing else in common."""


def carried(writer: Collection[str], reader: Collection[str], *, same_host: bool) -> list[Medium]:
    """Return by what Fast DDS 2.14 sends from a participant with some transports to another.

    Shared memory wins on one host. Of IP transports all that are common carry every sample, so
    more than one means that it arrives twice.

    Args:
        writer: transports of one participant, values of Medium; a group is
            `udpm@239.255.1.9:7901`.
        reader: of the other one.
        same_host: whether they share memory and loopback.

    Returns:
        Media, sorted; empty if they never meet.
    """
    common = _unicast(writer, same_host=same_host) & _unicast(reader, same_host=same_host)
    found = {each for each in common if each.is_network}
    if same_host and found != common:
        return sorted(common - found)
    if same_host:
        for group in (each for each in CONNECTABLE if each.is_group):
            if any(each.startswith(group) for each in {*writer} & {*reader}):
                found = {*found - {group.unicast}, group}
    return sorted(found)


def discover(one: Collection[str], other: Collection[str]) -> bool:
    """Return whether two participants of one host discover each other without a server.

    Fast DDS 2.14 announces participants by shared memory only where they have nothing else
    (`fastdds.shm.enforce_metatraffic`, by default `none`).

    Args:
        one: transports of a participant, as of `carried`.
        other: of the other one.
    """
    networks = [
        {each for each in _unicast(transports, same_host=True) if each.is_network}
        for transports in (one, other)
    ]
    return bool(networks[0] & networks[1]) or not any(networks)


def _unicast(transports: Collection[str], *, same_host: bool) -> set[Medium]:
    """Return by what a participant receives what is sent to it alone.

    A group with TTL 0 also receives what is sent to loopback by unicast.
    """
    words = {each.partition("@")[0] for each in transports}
    return {
        each.unicast for each in CONNECTABLE if each in words and (same_host or not each.is_group)
    }


def wish_of(pair: Pair) -> tuple[FlowTransport, str]:
    """Return what is asked for and who asks: a link, else the publisher, else the subscription."""
    for wish, who in (
        (pair.link, "a link says so"),
        (pair.writer.transport, "the publisher asks for it"),
        (pair.reader.transport, "the subscription asks for it"),
    ):
        if wish is not FlowTransport.ANY:
            return wish, who
    return FlowTransport.ANY, ""


def choose(
    pair: Pair, *, by_multicast: bool, listeners: int, max_datagram_bytes: int | None
) -> Choice:
    """Return what carries a pair.

    Args:
        pair: the pair.
        by_multicast: another subscription of this publisher gets its data from a group.
        listeners: processes of the publisher's host, but its own, that subscribe to the topic.
        max_datagram_bytes: UDP payload that the path carries unfragmented; None assumes Ethernet.
    """
    unable = _common_ground(pair)
    if unable:
        return Choice(problem=unable)
    wish, who = wish_of(pair)
    if pair.same_process:
        if wish in (FlowTransport.ANY, FlowTransport.SHM, FlowTransport.MULTICAST):
            return Choice(medium=Medium.INTRAPROCESS, reason="same process")
        return Choice(
            problem=f"cannot carry {pair.subject} by {wish.value}: both are in process "
            f"{pair.publisher.process!r}, and inside a process no transport is used",
            hint="give one of the two another 'process:'",
        )
    if not (pair.publisher.own and pair.subscription.own) and wish is FlowTransport.ANY:
        return Choice(reason="its RMW chooses")
    choice = (
        _unasked(pair, by_multicast, listeners, max_datagram_bytes)
        if wish is FlowTransport.ANY
        else _asked(pair, wish, who, by_multicast=by_multicast)
    )
    other = pair.reader.transport
    if pair.link is FlowTransport.ANY and choice.medium and not other.accepts(choice.medium):
        return Choice(
            problem=f"cannot carry {pair.subject}: the publisher asks for "
            f"{pair.writer.transport.value}, the subscription for {other.value}",
            hint="ask for the same at both ends, or let a link decide with 'transport:'",
        )
    return choice


def _common_ground(pair: Pair) -> str:
    """Return why the two cannot communicate whatever carries it; empty if they can."""
    one, other = pair.publisher, pair.subscription
    for word, mine, theirs in (
        ("wire format", one.serializations, other.serializations),
        ("communication paradigm", one.paradigms, other.paradigms),
    ):
        common = {*mine} & {*theirs}
        if not common or (word == "communication paradigm" and "publish-subscribe" not in common):
            return (
                f"cannot carry {pair.subject}: no {word} is common; {one.key!r} has "
                f"{_list(mine)}; {other.key!r} has {_list(theirs)}"
            )
    return ""


def _list(words: Collection[str]) -> str:
    return ", ".join(words) or "none"


def _none_common(pair: Pair, what: str) -> Choice:
    one, other = pair.publisher, pair.subscription
    return Choice(
        problem=f"cannot carry {pair.subject}{what}: {one.key!r} can be connected by "
        f"{_list(_able(one))}; {other.key!r} by {_list(_able(other))}",
        hint="" if pair.same_host else "they are on different hosts, where shared memory is none",
    )


def _able(party: Party) -> tuple[str, ...]:
    return party.transports if party.connectable else party.own


def _common(pair: Pair) -> set[str]:
    """Return media that both ends can have."""
    common = {*_able(pair.publisher)} & {*_able(pair.subscription)}
    if not pair.same_host:
        hosts = {pair.publisher.host, pair.subscription.host} - {""}
        versions = {6 if ":" in each else 4 for each in hosts}
        common -= {each for each in Medium if each.stays_on_host or versions - {each.ip_version}}
    return common


def _asked(pair: Pair, wish: FlowTransport, who: str, *, by_multicast: bool) -> Choice:
    common = _common(pair)
    if wish is FlowTransport.NETWORK:
        present = pair.present
        if len(present) == 1 and present[0] in wish.media:
            return Choice(medium=present[0], reason=who)
        order = _ip_order(pair)
        medium = next((each for each in order if each in common), "")
        return (
            Choice(medium=medium, reason=who) if medium else _none_common(pair, " by the network")
        )
    if wish is FlowTransport.MULTICAST and not pair.same_host:
        wish, who = FlowTransport.TCPV4, "multicast stays on its host"
    (medium,) = wish.media
    if medium not in common:
        return _none_common(pair, f" by {wish.value}, as {who}")
    if by_multicast and not pair.same_host and medium is Medium.UDPV4:
        return Choice(
            problem=f"cannot carry {pair.subject} by udpv4: the publisher sends by multicast with "
            "TTL 0 on its own host, and one participant has one TTL for UDP",
            hint="let it go by tcpv4",
        )
    return Choice(medium=medium, reason=who)


def _ip_order(pair: Pair) -> tuple[str, ...]:
    ipv6 = ":" in pair.publisher.host or ":" in pair.subscription.host
    ip = (each for each in CONNECTABLE if each.is_network and not each.is_group)
    return tuple(sorted(ip, key=lambda each: (each.is_tcp, (each.ip_version == 6) is not ipv6)))


def _unasked(
    pair: Pair, by_multicast: bool, listeners: int, max_datagram_bytes: int | None
) -> Choice:
    present = pair.present
    default = present[0] if len(present) == 1 else ""
    if pair.same_host:
        return _near(pair, default, listeners)
    common = _common(pair)
    tcp = _why_tcp(pair, by_multicast=by_multicast, max_datagram_bytes=max_datagram_bytes)
    if tcp and Medium.TCPV4 in {*common, default}:
        return Choice(medium=Medium.TCPV4, reason=tcp)
    if by_multicast:
        return _none_common(pair, " by tcpv4, as multicast stays on its host")
    medium = default or next((each for each in _ip_order(pair) if each in common), "")
    if not medium:
        return _none_common(pair, "")
    usual = medium in (default, Medium.UDPV4)
    return Choice(
        medium=medium, reason="other host" if usual else "other host, and no UDP over IPv4 between"
    )


def _near(pair: Pair, default: str, listeners: int) -> Choice:
    """Choose on one host: what is there anyway, shared memory, one datagram for all, unicast."""
    common = _common(pair)
    if default or Medium.SHM in common:
        return Choice(medium=default or Medium.SHM, reason="same host")
    if listeners > 1 and Medium.UDPM in common:
        reason = f"{listeners} processes of the host listen, and not by shared memory"
        return Choice(medium=Medium.UDPM, reason=reason)
    medium = next((each for each in _ip_order(pair) if each in common), "")
    if medium:
        return Choice(medium=medium, reason="same host, and no common shared memory")
    return _none_common(pair, "")


def _why_tcp(pair: Pair, *, by_multicast: bool, max_datagram_bytes: int | None) -> str:
    """Return why a pair of two hosts should use TCP; empty if it need not."""
    if by_multicast:
        return "multicast stays on its host"
    size = pair.writer.size_bytes
    limit = max_datagram_bytes or max_unfragmented(ipv6=":" in pair.publisher.host)
    if pair.lossy is False and size is not None and is_fragmented(size, limit):
        return f"not lossy, and {size} bytes are more than one datagram"
    return ""
