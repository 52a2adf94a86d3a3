"""Declared rates, delays and silences against each other: what no system could keep. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from lifecycle.manifest.checks.system import DeclaredSystem
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.model import QUANTILE, EndpointKind, FlowNeed, Link, Quantity
from lifecycle.manifest.yaml.document import error

_RULE = "check.flow-number"


def check_numbers(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about the numbers of each endpoint, link and topic."""
    published: dict[str, list[Quantity]] = {}
    asked: dict[str, list[Quantity]] = {}
    for node in system.manifest.nodes:
        for each in system.needs.of_node(node):
            yield from _alone(each.need)
            is_publisher = each.need.kind is EndpointKind.PUBLISHER
            (published if is_publisher else asked).setdefault(each.topic, []).extend(
                each.need.quantities
            )
    for link in system.manifest.links:
        yield from _alone(link)
        asked.setdefault(link.topic, []).extend(link.quantities)
    for topic in {**published, **asked}:
        if len(system.named(EndpointKind.PUBLISHER, topic)) == 1:  # several may add up
            of_topic = published.get(topic, ()), asked.get(topic, ())
            yield from _together(*of_topic)
            yield from _each_other(*of_topic)


CHECKS = (check_numbers,)


def _alone(declared: FlowNeed | Link) -> Iterator[Diagnostic]:
    if declared.quantile != QUANTILE and declared.max_delay_ms is None:
        message = f"cannot use quantile {declared.quantile:g} without a delay"
        yield error(_RULE, declared.at, message, "add 'max_delay_ms', or leave it out")
    for rate in _named("rate_hz", declared.quantities):
        if not rate.value and rate.most is None:
            yield error(_RULE, rate.at, "cannot use rate_hz without a number", "add min or max")
        elif rate.most is not None and rate.most < rate.value:
            yield error(_RULE, rate.at, f"cannot keep {rate}: min is larger than max")


def _together(published: Sequence[Quantity], asked: Sequence[Quantity]) -> Iterator[Diagnostic]:
    """Compare what the publishers of a topic declare with what its data are to be."""
    rates = [each for each in _named("rate_hz", published) if each.most or each.value]
    if not rates:
        return
    fastest, least = max(rates, key=_hertz), max(rates, key=lambda each: each.value)
    where = f"the publisher declares {fastest} ({fastest.at.spelled})"
    for rate in _named("rate_hz", asked):
        if rate.value > _hertz(fastest):
            yield error(_RULE, rate.at, f"cannot ask for {rate}: {where}")
        elif rate.most is not None and rate.most < least.value * (1 - least.slack):
            message = f"cannot keep {rate}: the publisher declares {least} ({least.at.spelled})"
            yield error(_RULE, rate.at, message)
    for silence in _named("max_silence_s", (*published, *asked)):
        period_s = 1 / _hertz(fastest)
        if silence.value < period_s:
            message = f"cannot keep {silence}: {where}, one message in {period_s:.3g} s"
            yield error(_RULE, silence.at, message)


def _each_other(published: Sequence[Quantity], asked: Sequence[Quantity]) -> Iterator[Diagnostic]:
    """Compare what the data of a topic are to be in one place with the same in another."""
    for limit in _named("rate_hz", asked):
        if limit.most is None or limit.most < limit.value:
            continue
        where = f"{limit} is asked for, too ({limit.at.spelled})"
        for rate in _named("rate_hz", asked):
            if rate is not limit and rate.value * (1 - rate.slack) > limit.most:
                yield error(_RULE, rate.at, f"cannot keep {rate}: {where}")
        for silence in _named("max_silence_s", (*published, *asked)):
            if silence.value * limit.most < 1:
                yield error(_RULE, silence.at, f"cannot keep {silence}: {where}")


def _named(name: str, numbers: Iterable[Quantity]) -> Iterator[Quantity]:
    return (each for each in numbers if each.name == name)


def _hertz(rate: Quantity) -> float:
    return rate.most or rate.value
