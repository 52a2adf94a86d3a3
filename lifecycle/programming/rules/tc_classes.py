"""Which traffic classes a link has for a set of rules, in which order and with what rate.

Owns: the ranking of DSCPs and 5QIs on one link and how its rate is divided. Pure.

The kernel's own queues do not rank by DSCP as people expect: pfifo_fast and prio put EF, CS6 and
DF into one band. So each class of the rules gets a queue of its own here.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

from lifecycle.network.dscp import describe, dscp_name, parse_dscp
from lifecycle.network.five_qi import five_qi_of
from lifecycle.programming.rules.rules import FlowRule

DEFAULT_MINOR = 0xFFF
"""Minor number of the class that everything else goes to."""

_FIRST = tuple(map(parse_dscp, ("EF", "VA")))
"""Expedited forwarding and admitted voice come before everything (RFC 3246, RFC 5865)."""

_LOWEST = tuple(map(parse_dscp, ("LE", "CS1")))
"""Less than best effort (RFC 8622, RFC 4594 §4.10)."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True, order=True)
class TrafficClass:
    """One class of a link.

    Attributes:
        rank: lower is served first.
        name: `ef`, `dscp5`, `5qi85`: what settings call it.
        minor: minor number of its classid, 0x100–0x2ff; the same wherever the class occurs.
        comment: for people; DSCP and TOS side by side.
    """

    rank: tuple[int, int]
    name: str
    minor: int
    comment: str

    @property
    def below_default(self) -> bool:
        """Whether everything else comes before it."""
        return self.rank[0] > _RANK_DEFAULT


_RANK_FIRST, _RANK_GBR, _RANK_MARKED, _RANK_NON_GBR, _RANK_DEFAULT, _RANK_LOWEST = range(6)


def class_of(rule: FlowRule) -> TrafficClass | None:
    """Return the class of a rule, by its DSCP or else its 5QI; None if it stays with the rest.

    DF is the rest itself.
    """
    if rule.dscp is not None:
        return None if rule.dscp == 0 else _by_dscp(rule.dscp)
    return None if rule.five_qi is None else _by_five_qi(rule.five_qi)


def classes_of(rules: Iterable[FlowRule]) -> tuple[TrafficClass, ...]:
    """Return the classes of the rules, each once, the one to serve first in front."""
    return tuple(sorted({found for rule in rules if (found := class_of(rule)) is not None}))


def band_of(class_: TrafficClass, classes: Sequence[TrafficClass]) -> int:
    """Return the band of a class with prio, counted from 0; the rest has one in between."""
    index = list(classes).index(class_)
    return index + 1 if class_.below_default else index


def divide(
    classes: Iterable[TrafficClass], *, link_kbit: int, guaranteed_kbit: Mapping[str, int] = {}
) -> tuple[dict[str, int], int]:
    """Return the guaranteed rate of each class by name, and that of the rest, in kbit/s.

    Classes that nobody gave a rate share what is left equally with the rest; those below the rest
    get a hundredth of the link, so that they do not starve.

    Args:
        classes: of the link.
        link_kbit: rate of the link, kbit/s: a little below the real one, or its queue is elsewhere.
        guaranteed_kbit: rates by class name, kbit/s. A prioritised class needs more than its burst
            peak, or it queues behind itself.

    Raises:
        ValueError: a rate is not positive, an unknown class has one, or there is not enough.
    """
    every = tuple(classes)
    known = ", ".join(each.name for each in every) or "none"
    if link_kbit < 1:
        raise ValueError(f"cannot divide a link of {link_kbit} kbit/s; use 1 or more")
    for name, rate in guaranteed_kbit.items():
        if name not in {each.name for each in every}:
            raise ValueError(
                f"cannot guarantee a rate to class {name!r}; classes of these rules are: {known}"
            )
        if rate < 1:
            raise ValueError(f"cannot guarantee {rate} kbit/s to class {name}; use 1 or more")
    rates = {
        each.name: guaranteed_kbit.get(each.name, max(1, link_kbit // 100))
        for each in every
        if each.below_default or each.name in guaranteed_kbit
    }
    open_ = [each.name for each in every if each.name not in rates]
    left = link_kbit - sum(rates.values())
    share = left // (len(open_) + 1)
    if share < 1:
        given = ", ".join(f"{name} {rate}" for name, rate in rates.items())
        raise ValueError(
            f"cannot guarantee {sum(rates.values())} kbit/s ({given}) on a link of "
            f"{link_kbit} kbit/s: something must be left for "
            f"{', '.join((*open_, 'everything else'))}"
        )
    rates.update((name, share) for name in open_)
    return {each.name: rates[each.name] for each in every}, left - share * len(open_)


def _by_dscp(dscp: int) -> TrafficClass:
    name = dscp_name(dscp).lower()
    group = _RANK_MARKED
    if dscp in _FIRST:
        group = _RANK_FIRST
    elif dscp in _LOWEST:
        group = _RANK_LOWEST
    return TrafficClass(
        rank=(group, -dscp),
        name=f"dscp{name}" if name.isdecimal() else name,
        minor=0x100 + dscp,
        comment=describe(dscp),
    )


def _by_five_qi(value: int) -> TrafficClass:
    five_qi = five_qi_of(value)
    group = _RANK_GBR if five_qi.resource_type.guarantees_rate else _RANK_NON_GBR
    return TrafficClass(
        rank=(group, five_qi.priority_level),
        name=f"5qi{value}",
        minor=0x200 + value,
        comment=str(five_qi),
    )
