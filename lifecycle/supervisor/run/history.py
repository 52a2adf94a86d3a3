"""History of a run, read from its journal: what was when, what turned a finding, verdicts again.

Owns: reading a journal that may be torn, foreign or incomplete; `Moment`, a line with all that was
known then; why a finding began (`explained`), and judging recorded observations with the rules of
today (`replayed`). Needs no ROS.
"""

from __future__ import annotations

import datetime as dt
import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from lifecycle import codec, dataclasses
from lifecycle.errors import UsageError
from lifecycle.plan import Plan
from lifecycle.supervisor.processes.logs import JOURNAL_NAME
from lifecycle.supervisor.run.events import Event, VerdictChanged, from_record
from lifecycle.supervisor.run.journal import (
    JournaledRun,
    JournalLine,
    JudgedFinding,
    Look,
    judged_finding,
    restored,
)
from lifecycle.verify import Finding, Observation, Outcome, Verdict, verify

LONGEST_LINE = 64 * 2**20
"""Bytes of a line that is read at all."""

BEFORE_S = 2.0
AFTER_S = 0.5
"""Events from so long before a finding began until so long after it are shown with it: an end of a
process may be reported a moment after the graph showed it; ..."""

_MOST_EVENTS = 12
"""... of these the nearest."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """One line of a journal, and what was known when it was written.

    Attributes:
        line: as it stands there.
        event: of a line that has one; None also where this version does not know its kind.
        plan: what the system was judged against; None before it is known.
        seen: what was seen last; None before anything was, or where lines are missing.
        verdict: what held then, without flows; None before the first.
        text: of the file.
    """

    line: JournalLine
    event: Event | None
    plan: Plan | None
    seen: Observation | None
    verdict: Verdict | None
    text: str


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class RecordedRun:
    """A journal that was read.

    Attributes:
        run: which run it is of; None where no line says so.
        moments: every line, oldest first.
        unreadable: (file and line, why) of what was passed over.
    """

    run: JournaledRun | None
    moments: tuple[Moment, ...]
    unreadable: tuple[tuple[str, str], ...]


def journal_files(path: Path) -> tuple[Path, ...]:
    """Return the files of a journal, oldest first.

    Args:
        path: of a run's log directory, or of one file.

    Raises:
        UsageError: there is none.
    """
    newest = path / JOURNAL_NAME if path.is_dir() else path
    older = newest.with_name(f"{newest.name}.1")
    found = [each for each in (older, newest) if each.is_file()]
    if not path.is_dir() and path not in found:
        found = []
    if not found:
        raise UsageError(
            f"cannot find a journal at {str(path)!r}",
            hint=f"name the log directory of a run, or the file {JOURNAL_NAME} in it",
        )
    return tuple(found)


def read_run(files: Iterable[Path]) -> RecordedRun:
    """Read a journal; a line that cannot be read is passed over, and named.

    Raises:
        UsageError: a file cannot be read at all.
    """
    reader = _Reader()
    for path in files:
        try:
            with path.open("rb") as file:
                for number, data in enumerate(file, start=1):
                    reader.take(data, f"{path.name}:{number}")
        except OSError as error:  # noqa: PERF203 - two files
            raise UsageError(f"cannot read {str(path)!r}: {error.strerror}") from error
    return RecordedRun(
        run=reader.run, moments=tuple(reader.moments), unreadable=tuple(reader.unreadable)
    )


class _Reader:
    """Follows what a journal tells, line by line."""

    def __init__(self) -> None:
        self.run: JournaledRun | None = None
        self.moments: list[Moment] = []
        self.unreadable: list[tuple[str, str]] = []
        self._plan: Plan | None = None
        self._seen: Observation | None = None
        self._verdict: Verdict | None = None

    def take(self, data: bytes, place: str) -> None:
        """Take one line."""
        try:
            line = codec.from_json(data, JournalLine, longest=LONGEST_LINE)
            event = None if line.event is None else from_record(line.event)
        except ValueError as error:
            why = "it is incomplete" if not data.endswith(b"\n") else str(error)
            self.unreadable.append((place, why))
            self._seen = None  # what changed with it is not known
            return
        if line.run is not None and self.run is None:
            self.run = line.run
        if line.plan is not None:
            self._plan = line.plan
        if line.look is not None:
            try:
                self._seen = _after(self._seen, line.look)
            except ValueError as error:
                self._seen = None
                self.unreadable.append((place, str(error)))
        if isinstance(event, VerdictChanged):
            self._verdict = event.verdict
        self.moments.append(
            Moment(
                line=line,
                event=event,
                plan=self._plan,
                seen=self._seen,
                verdict=self._verdict,
                text=data.decode("utf-8", errors="replace").rstrip("\n"),
            )
        )


def _after(before: Observation | None, look: Look) -> Observation:
    """Return what was seen, from what was seen before and what changed.

    Raises:
        ValueError: the look before is missing.
    """
    if look.whole:
        before = Observation()
    if before is None:
        raise ValueError("the observation before it is missing")
    nodes, endpoints = look.nodes, look.endpoints
    reports, parameters = look.configurations, look.parameters
    return Observation(
        nodes=before.nodes if nodes is None else restored(before.nodes, nodes.gone, nodes.new),
        endpoints=before.endpoints
        if endpoints is None
        else restored(before.endpoints, endpoints.gone, endpoints.new),
        configurations=before.configurations
        if reports is None
        else restored(before.configurations, reports.gone, reports.new),
        parameters=before.parameters
        if parameters is None
        else restored(before.parameters, parameters.gone, parameters.new),
    )


_CLOCK = re.compile(r"\d{1,2}:\d\d(:\d\d(\.\d{1,6})?)?")
_AFTER = re.compile(r"\+\d+(\.\d+)?")


def moment_of(word: str, recorded: RecordedRun, *, first: bool = False) -> float:
    """Return the moment that a person means, in seconds since the supervisor began.

    Where the host's clock was set back, it showed some times twice; one that it was set over, it
    never showed: then the moment before it was set is meant.

    Args:
        word: `12:03:05` or `12:03:05.25`, local time while the run lasted; `+17.5`, seconds since
            the supervisor began; or ISO 8601, `2026-11-23T12:03:05+01:00`.
        recorded: the run it is about.
        first: the beginning of what is named so, the first time; else its end, the last time.

    Raises:
        UsageError: it is none of these.
    """
    lines = [each.line for each in recorded.moments]
    if not lines:
        raise UsageError("cannot find any time in an empty journal")
    if _AFTER.fullmatch(word):
        return float(word)
    try:
        if not _CLOCK.fullmatch(word):
            at = dt.datetime.fromisoformat(word.replace("Z", "+00:00")).timestamp()
            return _elapsed_at([(at, at)], lines, first=first)
        clock, _, fraction = word.partition(".")
        hour, minute, *rest = map(int, clock.split(":"))
        microsecond = int(fraction.ljust(6, "0")) if fraction else 0
        wanted = dt.time(hour, minute, sum(rest), microsecond)
    except ValueError:
        raise UsageError(
            f"cannot read the time {word!r}",
            hint="write 12:03:05, +17.5 for seconds since the supervisor began, or ISO 8601",
        ) from None
    # What a person reads as 12:03:05 lasts until 12:03:06.
    lasts_s = 0.0 if fraction else 1.0 - 1e-6 if rest else 60.0 - 1e-6
    days = dict.fromkeys(dt.datetime.fromtimestamp(each.at).astimezone().date() for each in lines)
    starts = [dt.datetime.combine(day, wanted).timestamp() for day in days]
    if starts[-1] + lasts_s < lines[0].at - lines[0].elapsed_s:
        starts.append(starts[-1] + _DAY_S)
    return _elapsed_at([(each, each + lasts_s) for each in starts], lines, first=first)


_DAY_S = 86_400.0
_SET_S = 0.5
"""A clock that is ahead by so much more, or less, than at the line before was set meanwhile."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _Period:
    """What the host's clock showed from a line to the next one; nothing is between two of them.

    Attributes:
        elapsed_s: of the line.
        at: of the line.
        until: seconds since the epoch, as the clock had gone on.
    """

    elapsed_s: float
    at: float
    until: float


def was_set_s(before: JournalLine, line: JournalLine) -> float:
    """Return by how many seconds the host's clock was set between two lines; 0 if it was not."""
    ahead_s = (line.at - before.at) - (line.elapsed_s - before.elapsed_s)
    return ahead_s if abs(ahead_s) >= _SET_S else 0.0


def _periods(lines: Sequence[JournalLine]) -> Iterator[_Period]:
    first = lines[0]
    yield _Period(elapsed_s=0.0, at=first.at - first.elapsed_s, until=first.at)
    for line, following in itertools.pairwise(lines):
        until = following.at - was_set_s(line, following)
        yield _Period(elapsed_s=line.elapsed_s, at=line.at, until=until)
    last = lines[-1]
    yield _Period(elapsed_s=last.elapsed_s, at=last.at, until=last.at + 1e-6)


def _elapsed_at(
    named: Sequence[tuple[float, float]], lines: Sequence[JournalLine], *, first: bool
) -> float:
    """Return how long after the beginning the host's clock showed one of some spans of time."""
    periods = tuple(_periods(lines))
    shown = [
        (
            each.elapsed_s + max(start - each.at, 0.0),
            each.elapsed_s + min(end, each.until) - each.at,
        )
        for each in periods
        for start, end in named
        if each.at <= end and start < each.until
    ]
    if shown:
        return shown[0][0] if first else shown[-1][1]
    pairs = tuple(itertools.pairwise(periods))
    for start, end in named:
        for before, each in pairs:
            if before.until <= start and end < each.at:  # it was set forward over that time
                return each.elapsed_s - (0.0 if first else 1e-6)
    at = named[0][0] if first else named[-1][1]
    near = periods[0] if at < min(each.at for each in periods) else periods[-1]
    return near.elapsed_s + at - near.at


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Explanation:
    """Why a finding held at a moment.

    Attributes:
        finding: as it was in the verdict then.
        since: seconds since the epoch from which on it held without a break.
        elapsed_s: the same since the supervisor began.
        first: there was no verdict before it that lacked it.
        facts: what was seen to change when it began, that concerns it; one phrase each.
        others: how many other facts changed then.
        events: what happened then, oldest first, and after how many seconds of the run.
    """

    finding: Finding
    since: float
    elapsed_s: float
    first: bool
    facts: tuple[str, ...]
    others: int
    events: tuple[tuple[float, Event], ...]


def explained(recorded: RecordedRun, elapsed_s: float, wanted: str = "") -> tuple[Explanation, ...]:
    """Return why each finding held at a moment.

    Args:
        recorded: the run.
        elapsed_s: the moment, in seconds since the supervisor began.
        wanted: only findings whose rule or subject has this in it.
    """
    past = [each for each in recorded.moments if each.line.elapsed_s <= elapsed_s]
    verdict = past[-1].verdict if past else None
    if verdict is None:
        return ()
    return tuple(
        _explained(recorded.moments, len(past), finding)
        for finding in verdict.findings
        if wanted in finding.rule or wanted in finding.subject
    )


def named_findings(recorded: RecordedRun) -> tuple[str, ...]:
    """Return what any verdict of a run found, `RULE SUBJECT`, each once, in order."""
    found: dict[str, None] = {}
    for each in recorded.moments:
        if isinstance(each.event, VerdictChanged):
            found |= dict.fromkeys(
                f"{one.rule} {one.subject}" for one in each.event.verdict.findings
            )
    return tuple(found)


def _explained(moments: Sequence[Moment], until: int, finding: Finding) -> Explanation:
    """Find the verdict that a finding began with, and what was seen to change before that."""
    past = moments[:until]
    judged = [index for index, each in enumerate(past) if isinstance(each.event, VerdictChanged)]
    begins = judged[-1]
    first = True
    for index in reversed(judged):
        verdict = past[index].verdict
        if verdict is None or not any(_is_same(each, finding) for each in verdict.findings):
            first = False
            break
        begins = index
    facts, others, saw_s = _turned(past[: begins + 1], finding)
    line = past[begins].line
    now_s = line.elapsed_s
    names = _names(past[begins].plan, finding)
    found = [
        each
        for each in moments
        if not first
        and each.event is not None
        and not isinstance(each.event, VerdictChanged)
        and saw_s - BEFORE_S <= each.line.elapsed_s <= now_s + AFTER_S
        and (each.line.elapsed_s <= now_s or _concerns(each.event, names))
    ]
    # Those that concern it first, then the nearest.
    found.sort(
        key=lambda each: (not _concerns(each.event, names), abs(each.line.elapsed_s - now_s))
    )
    chosen = sorted(found[:_MOST_EVENTS], key=lambda each: each.line.elapsed_s)
    events = tuple((each.line.elapsed_s, each.event) for each in chosen if each.event is not None)
    return Explanation(
        finding=finding,
        since=line.at,
        elapsed_s=line.elapsed_s,
        first=first,
        facts=facts,
        others=others,
        events=events,
    )


def _names(plan: Plan | None, finding: Finding) -> frozenset[str]:
    """Return the names of the nodes that a finding concerns, and of their processes."""
    nodes = {finding.subject, *finding.nodes}
    processes = (each.process for each in (plan.nodes if plan else ()) if each.full_name in nodes)
    return frozenset((*nodes, *processes))


def _concerns(event: Event | None, names: frozenset[str]) -> bool:
    told = (getattr(event, each, "") for each in ("node", "process", "subject"))
    return any(each in names for each in told if each)


def _is_same(one: Finding | JudgedFinding, other: Finding) -> bool:
    return (one.rule, one.subject, one.node) == (other.rule, other.subject, other.node)


def _turned(past: Sequence[Moment], finding: Finding) -> tuple[tuple[str, ...], int, float]:
    """Return what changed in the look that first showed a finding, and when that was.

    A finding that may pass by itself is in the looks a moment before it is in the verdict. One of
    the supervisor's own is in none: then the last look is taken.
    """
    looks = [index for index, each in enumerate(past) if each.line.look is not None]
    if not looks:
        return (), 0, past[-1].line.elapsed_s
    chosen = looks[-1]
    for index in reversed(looks):
        look = past[index].line.look
        assert look is not None
        if not any(_is_same(each, finding) for each in look.findings):
            break
        chosen = index
    before = past[chosen - 1].seen if chosen else None
    now = past[chosen].seen
    saw_s = past[chosen].line.elapsed_s
    if before is None or now is None:
        return (), 0, saw_s
    words = {finding.subject, *finding.nodes, *re.split(r"[\s:→]+", finding.subject)} - {""}
    facts = tuple(differences(before, now))
    about = tuple(text for names, text in facts if names & words)
    return about, len(facts) - len(about), saw_s


def differences(before: Observation, now: Observation) -> Iterator[tuple[frozenset[str], str]]:
    """Yield how two observations differ: names that a difference concerns, and it in words."""
    yield from _differences(
        {each.full_name: each for each in before.nodes},
        {each.full_name: each for each in now.nodes},
        lambda name, _: (frozenset({name}), f"node {name}"),
    )
    yield from _differences(
        {(each.kind, each.node, each.name, each.gid): each for each in before.endpoints},
        {(each.kind, each.node, each.name, each.gid): each for each in now.endpoints},
        lambda _, each: (
            frozenset({each.node, each.name}),
            f"{each.kind.noun} {each.name} of {each.node or 'an unknown node'}",
        ),
    )
    reports = {each.name: each for each in before.configurations}
    for each in now.configurations:
        was = reports.pop(each.name, None)
        if was is None:
            yield frozenset({each.name}), f"report of {each.name}: there now, {each.state}"
            continue
        if was == each:
            continue
        yield from _differences(
            {each.name: dataclasses.replace(was, endpoints=(), connections=(), checksum="")},
            {each.name: dataclasses.replace(each, endpoints=(), connections=(), checksum="")},
            lambda name, _: (frozenset({name}), f"report of {name}"),
        )
        yield from _differences(
            {(one.kind, one.resolved, one.name): one for one in was.endpoints},
            {(one.kind, one.resolved, one.name): one for one in each.endpoints},
            lambda _, one, node=each.name: (
                frozenset({node, one.resolved}),
                f"{one.kind.noun} {one.resolved} as {node} reports it",
            ),
        )
        yield from _differences(
            {one.name: one for one in was.connections},
            {one.name: one for one in each.connections},
            lambda name, _, node=each.name: (
                frozenset({node}),
                f"connection {name or 'of its own participant'} of {node}",
            ),
        )
    for name in reports:
        yield frozenset({name}), f"report of {name}: gone"
    yield from _differences(
        {each.node: each for each in before.parameters},
        {each.node: each for each in now.parameters},
        lambda name, _: (frozenset({name}), f"parameters of {name}"),
    )


def _differences(
    before: dict[Any, Any], now: dict[Any, Any], describe: Any
) -> Iterator[tuple[frozenset[str], str]]:
    for key, value in before.items():
        if key not in now:
            names, what = describe(key, value)
            yield names, f"{what}: gone"
    for key, value in now.items():
        names, what = describe(key, value)
        was = before.get(key)
        if was is None:
            yield names, f"{what}: there now"
        elif was != value:
            yield names, f"{what}: {', '.join(_fields(was, value))}"


_LONGEST_VALUE = 120


def _fields(was: Any, now: Any) -> Iterator[str]:
    """Yield the fields that two values of a type differ in, `state inactive → active`."""
    for field in dataclasses.fields(was):
        one, other = getattr(was, field.name), getattr(now, field.name)
        if one != other:
            yield f"{field.name} {_short(one)} → {_short(other)}"


def _short(value: object) -> str:
    plain = codec.to_plain(value)
    text = plain if isinstance(plain, str) and plain else codec.to_json(plain).decode()
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 1]}…"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Rejudged:
    """An observation that today's rules judge otherwise than when it was recorded.

    Attributes:
        at: when it was seen, seconds since the epoch.
        elapsed_s: likewise since the supervisor began.
        was: what was found then.
        now: what is found now.
        lost: findings that are not there any more, or have another outcome.
        new: findings that were not there, or had another outcome.
    """

    at: float
    elapsed_s: float
    was: Outcome
    now: Outcome
    lost: tuple[JudgedFinding, ...]
    new: tuple[JudgedFinding, ...]


def replayed(recorded: RecordedRun) -> Iterator[Rejudged | None]:
    """Judge every recorded observation with today's rules; None where the result is the same."""
    for each in recorded.moments:
        look = each.line.look
        if look is None or each.plan is None or each.seen is None:
            continue
        verdict = verify(
            each.plan,
            each.seen,
            stage=look.stage,
            machines=None if look.machines is None else frozenset(look.machines),
            ahead=frozenset(look.ahead),
            over=look.over,
        )
        now = tuple(map(judged_finding, verdict.findings))
        lost = tuple(one for one in look.findings if one not in now)
        new = tuple(one for one in now if one not in look.findings)
        if not lost and not new and verdict.verdict is look.outcome:
            yield None
            continue
        yield Rejudged(
            at=each.line.at,
            elapsed_s=each.line.elapsed_s,
            was=look.outcome,
            now=verdict.verdict,
            lost=lost,
            new=new,
        )
