"""Flow rules as lines for `tc -batch`: a queue per class on one network device, filters per flow.

Owns: the qdisc `1f10:` at the root of a device, its classes, their queues and filters. The handle
is the mark of ownership: tc has no comments, so only what hangs below this handle is ours.
`tc -batch` is neither atomic nor dry-runnable, and a second `qdisc add` fails: look whether the
handle is there first, and then send `render_tc(…, with_qdisc=False)`, whose lines all replace.
Pure.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from lifecycle.programming.rules.rules import FlowRule, LeftOut, asks, named
from lifecycle.programming.rules.tc_classes import (
    DEFAULT_MINOR,
    TrafficClass,
    band_of,
    class_of,
    classes_of,
    divide,
)
from lifecycle.programming.rules.tc_filters import anchors, tc_filters
from lifecycle.programming.rules.tc_settings import OWNED_HANDLE, TcMatch, TcSettings

_PRIO_BANDS = 16
"""TCQ_PRIO_BANDS."""

_QUEUE = "2"
"""First hex digit of the handles of queues; the others are the minor number of their class."""

_QUANTUM_BYTES = 3028
"""Two full Ethernet frames; HTB's own guess is too large for fast links and it says so."""


def render_tc(
    rules: Iterable[FlowRule],
    settings: TcSettings,
    *,
    system: str,
    digest: str,
    with_qdisc: bool = True,
    left_out: Sequence[LeftOut] = (),
) -> str:
    """Return lines for `tc -batch FILE`.

    Args:
        rules: of verified flows.
        settings: of the device.
        system: named in a comment.
        digest: of the rules; named in a comment.
        with_qdisc: start with the qdisc, which fails if it is there; False to bring up to date
            what is.
        left_out: flows without a rule, named in comments.

    Raises:
        ValueError: the kernel lacks what is needed, or the rates do not fit the link.
    """
    every = tuple(rules)
    lines = [
        f"# managed-by=lifecycle digest={digest} system={system} handle={OWNED_HANDLE}",
        *(f"# {named(each)}: {each.describe()}: {asks(each)}" for each in every),
        *(f"# left out: {each}" for each in left_out),
        *(
            f"# left out: {named(each)}: {why}"
            for each in every
            if (why := _why_not(each, settings))
        ),
        *_classes(classes_of(every), settings, with_qdisc=with_qdisc),
        *(each.line for each in anchors(settings)),
        *(each.line for each in tc_filters(every, settings)),
    ]
    return "\n".join(lines) + "\n"


def render_tc_removal(device: str) -> str:
    """Return the line for `tc -batch FILE` that removes our qdisc and all below it.

    It fails, and removes nothing, if the device's root qdisc is not ours.
    """
    settings = TcSettings(device=device)
    return f"qdisc del dev {settings.device} root handle {OWNED_HANDLE}\n"


def _why_not(rule: FlowRule, settings: TcSettings) -> str:
    """Why a rule has no filter; empty if it has one."""
    if class_of(rule) is None:
        return "it has no DSCP but DF and no 5QI, and stays with the rest"
    if rule.dscp is None and settings.match is TcMatch.MARK:
        return "it has no DSCP, and filters look at nothing else here"
    return ""


def _classes(
    classes: Sequence[TrafficClass], settings: TcSettings, *, with_qdisc: bool
) -> Iterator[str]:
    if settings.features.qdisc(settings.link_kbit) == "prio":
        yield from _prio(classes, settings, with_qdisc=with_qdisc)
    else:
        assert settings.link_kbit is not None
        yield from _htb(classes, settings, settings.link_kbit, with_qdisc=with_qdisc)


def _htb(
    classes: Sequence[TrafficClass], settings: TcSettings, link_kbit: int, *, with_qdisc: bool
) -> Iterator[str]:
    device, major = settings.device, OWNED_HANDLE
    rates, rest = divide(classes, link_kbit=link_kbit, guaranteed_kbit=settings.guaranteed_kbit)
    if with_qdisc:
        yield f"qdisc add dev {device} root handle {major} htb default {DEFAULT_MINOR:#x}"
    yield (
        f"class replace dev {device} parent {major} classid {major}1 "
        f"htb rate {link_kbit}kbit ceil {link_kbit}kbit quantum {_QUANTUM_BYTES}"
    )
    above = [each for each in classes if not each.below_default]
    leaves = [
        *((each.minor, rates[each.name], min(i, 5), each.comment) for i, each in enumerate(above)),
        (DEFAULT_MINOR, rest, 6, "everything else"),
        *(
            (each.minor, rates[each.name], 7, each.comment)
            for each in classes
            if each.below_default
        ),
    ]
    for minor, rate, prio, comment in leaves:
        yield f"# class {major}{minor:x}: {comment}"
        yield (
            f"class replace dev {device} parent {major}1 classid {major}{minor:x} "
            f"htb rate {rate}kbit ceil {link_kbit}kbit prio {prio} quantum {_QUANTUM_BYTES}"
        )
        yield (
            f"qdisc replace dev {device} parent {major}{minor:x} handle {_QUEUE}{minor:03x}: "
            f"bfifo limit {settings.queue_bytes}"
        )


def _prio(
    classes: Sequence[TrafficClass], settings: TcSettings, *, with_qdisc: bool
) -> Iterator[str]:
    if settings.guaranteed_kbit:
        raise ValueError(
            f"cannot guarantee a rate to {', '.join(settings.guaranteed_kbit)} with prio; "
            f"give the rate of the link, and a kernel with htb"
        )
    bands = len(classes) + 1
    if bands > _PRIO_BANDS:
        raise ValueError(
            f"cannot give {len(classes)} classes a band each: prio has {_PRIO_BANDS}; "
            f"give the rate of the link, then htb has no such limit"
        )
    rest = sum(not each.below_default for each in classes)
    for each in classes:
        yield f"# band {band_of(each, classes)}: {each.comment}"
    yield f"# band {rest}: everything else"
    # prio can be changed in place, but only by `replace` and with at least two bands.
    yield (
        f"qdisc {'add' if with_qdisc else 'replace'} dev {settings.device} root "
        f"handle {OWNED_HANDLE} prio bands {max(2, bands)} priomap {' '.join([str(rest)] * 16)}"
    )
