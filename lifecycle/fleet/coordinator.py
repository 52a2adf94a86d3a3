"""Starts, watches and ends the supervisors of all hosts of one system: `lifecycle up --hosts`.

Owns: `Coordinator` and its events. It owns no supervisor: what runs on a host goes on if
this process dies or a link is cut, and is followed again. Every wait has a deadline. Must not
import rclpy.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import enum
import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Union, get_args

from lifecycle import dataclasses
from lifecycle.codec import from_json, to_plain
from lifecycle.errors import ExitCode
from lifecycle.fleet.asking import (
    ANSWER_S,
    HEARTBEAT_S,
    HELLO_S,
    READINGS,
    down_one,
    hello,
    worst,
)
from lifecycle.fleet.protocol import (
    AGENT_MARK,
    LONGEST_LINE,
    NOTABLE_S,
    PROTOCOL,
    ClockOffset,
    Do,
    Order,
    Part,
    RoundTrip,
    Said,
    Word,
    clock_offset,
    line,
)
from lifecycle.fleet.transport import Channel, Transport

AGAIN_HELLO_S = 15.0
"""The same, of a host that answered before."""

CUT_S = 4.0
"""A link on which nothing came for so long is cut."""

AGAIN_S = (0.5, 1.0, 2.0, 4.0)
"""Between tries to reach a host again; the last for ever."""

END_S = 90.0
"""For a supervisor to take its part down."""

CLEAN_S = 30.0
"""For what a supervisor that was killed left running."""

CUT_END_S = 10.0
"""How long a host that cannot be reached is waited for when it is to end."""

_ACTIVE = "active"

Record = dict[str, Any]
Listener = Callable[[str, Record], None]
"""Takes the host, empty for all of them, and an event as `--format json` has it."""


class LinkState(enum.Enum):
    """What there is to say of one host's part."""

    CONNECTED = "connected"
    STARTED = "started"
    ATTACHED = "attached"
    CUT = "cut"
    HEALED = "healed"
    TAKEN = "taken"
    ENDED = "ended"
    FAILED = "failed"
    LEFT = "left"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class HostsFound:
    """Where the machines of the system are; the first event.

    Attributes:
        destinations: by machine.
    """

    kind: ClassVar[str] = "hosts"
    system: str
    destinations: Mapping[str, str]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class HostChanged:
    """The connection to a host, or the supervisor there, changed.

    Attributes:
        state: STARTED by us; ATTACHED to one that ran; CUT: it runs on unseen, and HEALED after
            `lost_s`; TAKEN by another coordinator; LEFT: it runs on, and cannot be ended by us.
        message: why, a whole sentence; empty where the state says all.
        hint: the next thing to do.
        pid: of the supervisor.
        exit_code: of a supervisor that ENDED.
        status: of one that ATTACHED or HEALED, as `lifecycle status` has it.
    """

    kind: ClassVar[str] = "host"
    state: LinkState
    message: str = ""
    hint: str = ""
    pid: int = 0
    exit_code: int | None = None
    lost_s: float = 0.0
    status: object = None


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ClockMeasured:
    """How far the clock of a host is ahead of ours, see protocol.ClockOffset.

    Attributes:
        differs: by more than its uncertainty, and more than 10 ms.
    """

    kind: ClassVar[str] = "clock"
    offset_s: float
    uncertainty_s: float
    round_trips: int
    differs: bool


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class HostStderr:
    """A line that a host's supervisor wrote to standard error."""

    kind: ClassVar[str] = "stderr"
    line: str


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class HostsActive:
    """The system is active and verified, as every host's supervisor sees it."""

    kind: ClassVar[str] = "active"
    hosts: tuple[str, ...]
    elapsed_s: float


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class HostsReached:
    """The system has come as far as it is to come, short of active, on all hosts.

    Attributes:
        reached: "connected" or "verified".
    """

    kind: ClassVar[str] = "reached"
    reached: str
    hosts: tuple[str, ...]
    elapsed_s: float


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class HostsEnding:
    """All are being taken down; with a reason, `interrupted`, `done`, or what failed."""

    kind: ClassVar[str] = "ending"
    reason: str


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class HostsEnded:
    """The last event.

    Attributes:
        exit_code: the worst of all, which is ours.
        exit_codes: by host; None for one that runs on.
    """

    kind: ClassVar[str] = "end"
    reason: str
    exit_code: int
    exit_codes: Mapping[str, int | None]
    elapsed_s: float


HostEvent = Union[  # noqa: UP007 - a run-time alias on Python 3.10
    HostsFound,
    HostChanged,
    ClockMeasured,
    HostStderr,
    HostsActive,
    HostsReached,
    HostsEnding,
    HostsEnded,
]


_OURS = frozenset(each.kind for each in get_args(HostEvent))


def to_record(event: HostEvent, host: str = "") -> Record:
    """Return an event of ours as the JSON object that `--format json` prints."""
    plain = to_plain(event)
    assert isinstance(plain, dict)
    return {"host": host, "event": event.kind, **plain}


class Place(NamedTuple):
    """One machine: what is to run there, and the way to it.

    Attributes:
        rank: machines of a higher one are ended first.
    """

    part: Part
    transport: Transport
    rank: int = 0


class _Host:
    """What is known of one host.

    Attributes:
        is_ready: its agent answered, at least once.
        is_begun: it has a supervisor, ours or found.
        is_ours: which we started.
        is_taken: which another coordinator follows now.
        until: how far it is to come.
        is_up: it has come so far, at least once.
        is_cut: its link is.
        tries: how often it was tried to reach it since.
        starts: how often we asked for a supervisor.
        asked_s: since when an answer is due to START or ATTACH.
        was_killed: its supervisor was, and may have left what it ran.
        exit_code: of its supervisor; None while that runs, or none was started.
        has_failed: there will be no supervisor.
    """

    def __init__(self, place: Place, until: str) -> None:
        self.until = until
        self.part, self.transport, self.rank = place
        self.name = place.part.machine
        self.channel: Channel | None = None
        self.is_ready = self.is_begun = self.is_ours = self.is_taken = False
        self.is_up = self.is_cut = self.is_ending = self.has_failed = False
        self.was_killed = False
        self.exit_code: int | None = None
        self.reached = ""
        self.last_received_s = 0.0
        self.cut_s = 0.0
        self.tries = 0
        self.starts = 0
        self.asked_s: float | None = None
        self.pings: dict[int, tuple[float, float]] = {}
        self.readings: collections.deque[RoundTrip] = collections.deque(maxlen=READINGS)
        self.clock: ClockOffset | None = None
        self._said_code: int | None = None

    @property
    def is_over(self) -> bool:
        """Whether there is nothing to follow any more."""
        return self.has_failed or self.is_taken or self.exit_code is not None

    @property
    def runs(self) -> bool:
        """Whether it may have a supervisor that we can end."""
        return self.is_begun and not self.is_over

    def note(self, record: Record) -> None:
        """Note what a line of the supervisor says of the whole."""
        kind = record.get("event")
        if kind == "system":
            self.reached = str(record.get("reached"))
            self.is_up = self.reached == self.until or self.is_up
        elif kind == "stopped":
            self._said_code = _code(record.get("exit_code"))
        elif kind is None and isinstance(run := record.get("run"), dict):
            self._said_code = _code(run.get("exit_code"))

    def ended(self, said: Said) -> int:
        """Return the exit code of its supervisor, as far as anything shows it."""
        if said.exit_code is not None:
            return said.exit_code
        if said.signal or self._said_code is None:
            return ExitCode.BRING_UP_FAILED
        return self._said_code


class Coordinator:
    """One run of `lifecycle up --hosts`.

    Args:
        system: its name.
        places: its machines, at least one.
        listener: takes every event, in this loop, and does not block.
        version: of this package: agents have the same.
        bring_up_s: from the start of the supervisors to all of them being active.
        until: how far to bring it: "connected", "verified" or "active".
        stop_after_s: hold it so long; None for until it is asked to end, and not at all where it is
            only connected or verified.
        keep_going: a supervisor that fails does not end the others.
        again: what a person types to follow it again, and to end it.
        clock: seconds since the epoch.
    """

    def __init__(
        self,
        system: str,
        places: Sequence[Place],
        listener: Listener,
        *,
        version: str,
        bring_up_s: float,
        again: tuple[str, str],
        until: str = _ACTIVE,
        stop_after_s: float | None = None,
        keep_going: bool = False,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._system = system
        self._hosts = tuple(_Host(each, until) for each in places)
        self._until_reached = until
        self._listener = listener
        self._version = version
        self._bring_up_s = bring_up_s
        is_brief = stop_after_s is None and until != _ACTIVE
        self._stop_after_s = 0.0 if is_brief else stop_after_s
        self._keep_going = keep_going
        self._again = again
        self._clock = clock
        self._changed = asyncio.Event()
        self._goes = False
        self._reason = ""
        self._wanted: ExitCode | None = None
        self._leaves = self._was_up = False
        self._numbers = 0
        self._began_s = 0.0

    def stop(self, reason: str, exit_code: ExitCode) -> None:
        """End all supervisors in order; asked again, at once and without any politeness.

        Args:
            reason: for people.
            exit_code: where it ended well before it was active.
        """
        if self._wanted is None:
            self._reason, self._wanted = reason, exit_code
            self._changed.set()
            return
        for each in self._hosts:
            if each.runs:
                each.is_ending = True
                self._send(each, Order(do=Do.END))

    def leave(self, reason: str) -> None:
        """End this process, and no supervisor."""
        self._reason, self._leaves = reason, True
        self._changed.set()

    async def run(self) -> ExitCode:
        """Bring all up, follow them, and take them down; return the worst exit code."""
        self._began_s = self._now_s
        self._emit(
            HostsFound(
                system=self._system,
                destinations={each.name: each.transport.destination for each in self._hosts},
            )
        )
        tasks = [asyncio.ensure_future(self._attend(each)) for each in self._hosts]
        for task in tasks:
            task.add_done_callback(self._attended)
        try:
            failure = await self._run()
        finally:
            for each in tasks:
                each.cancel()
            results = await asyncio.gather(*tasks, return_exceptions=True)
        for result in results:
            if isinstance(result, Exception):
                raise result
        return self._conclude(failure)

    def _attended(self, task: asyncio.Future[None]) -> None:
        if not task.cancelled() and task.exception() is not None:
            self.leave("a bug of ours")  # which `run` raises; no supervisor is to end for it

    async def _run(self) -> str:
        """Return what failed; empty if nothing did."""

        def is_answered() -> bool:
            return self._is_asked or all(each.is_ready or each.has_failed for each in self._hosts)

        if not await self._until(is_answered, 2 * HELLO_S):
            return "not all hosts answered"
        if self._is_asked or any(each.has_failed for each in self._hosts):
            return "" if self._is_asked else "not all hosts can be reached"
        self._goes = True
        for each in self._hosts:
            if each.channel is not None:
                self._ask(each)
        failure = await self._come_up()
        if self._leaves:
            return ""
        if failure:
            # What ran before us is not ours to end because we failed.
            ours = [each for each in self._hosts if each.is_ours or not each.is_begun]
            await self._end(ours, failure)
            return failure
        if not self._is_asked:
            failure = await self._hold()
        if not self._leaves:
            await self._end(self._hosts, failure or self._reason or "done")
        return failure

    @property
    def _is_asked(self) -> bool:
        return self._leaves or self._wanted is not None

    @property
    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()

    @property
    def _elapsed_s(self) -> float:
        return self._now_s - self._began_s

    async def _come_up(self) -> str:
        """Wait until all are as far as they are to come; return what failed, if anything."""
        hosts, until = self._hosts, self._until_reached

        def is_over() -> bool:
            return self._is_asked or any(each.is_over for each in hosts)

        in_time = await self._until(
            lambda: is_over() or all(each.is_up for each in hosts), self._bring_up_s
        )
        if self._is_asked:
            return ""
        if not in_time:
            lacking = ", ".join(
                f"{each.name} ({'its link is cut' if each.is_cut else each.reached or 'started'})"
                for each in hosts
                if not each.is_up
            )
            return f"not {until} on all hosts within {self._bring_up_s:g} s: {lacking}"
        if over := [each.name for each in hosts if each.is_over]:
            return f"not {until}, and over on {', '.join(over)}"
        self._was_up = True
        names = tuple(each.name for each in hosts)
        if until == _ACTIVE:
            self._emit(HostsActive(hosts=names, elapsed_s=self._elapsed_s))
        else:
            self._emit(HostsReached(reached=until, hosts=names, elapsed_s=self._elapsed_s))
        return ""

    async def _hold(self) -> str:
        """Wait for an end of the active system; return what failed, if anything."""

        def has_ended() -> bool:
            if self._is_asked or all(each.is_over for each in self._hosts):
                return True
            return not self._keep_going and bool(self._lost())

        if not await self._until(has_ended, self._stop_after_s) or self._is_asked:
            return ""
        if lost := self._lost():
            return f"the supervisor of {lost} failed"
        return "" if self._stop_after_s is None else f"ended before {self._stop_after_s:g} s"

    def _lost(self) -> str:
        """Name the hosts whose supervisor ended in another way than well."""
        return ", ".join(each.name for each in self._hosts if each.exit_code or each.has_failed)

    async def _end(self, hosts: Iterable[_Host], reason: str) -> None:
        """End supervisors, those first whose nodes come last, and what killed ones have left."""
        hosts = tuple(hosts)
        left = [each for each in hosts if each.is_begun or each.starts]
        left = [each for each in left if not each.is_over]
        if left:
            self._emit(HostsEnding(reason=reason))
        for rank in sorted({each.rank for each in left}, reverse=True):
            await asyncio.gather(*(self._end_one(each) for each in left if each.rank == rank))
        if not self._leaves:
            await asyncio.gather(*(self._clean_up(each) for each in hosts if each.was_killed))

    async def _clean_up(self, host: _Host) -> None:
        code, message = await down_one(host.part, host.transport, CLEAN_S)
        if code is not ExitCode.OK:
            self._emit(
                HostChanged(
                    state=LinkState.LEFT,
                    message=f"what its killed supervisor left could not be ended: {message}",
                    hint=f"on that host: lifecycle down {host.part.name}",
                ),
                host,
            )

    async def _end_one(self, host: _Host) -> None:
        host.is_ending = True
        if host.channel is not None and host.is_begun:
            self._send(host, Order(do=Do.END))
        deadline_s = self._now_s + END_S
        while not host.is_over and self._now_s < deadline_s and not self._leaves:
            if host.is_cut and self._now_s - host.cut_s > CUT_END_S:
                break
            await self._until(lambda: host.is_over or self._leaves, HEARTBEAT_S)
        if not host.is_over:
            why = "its link is cut" if host.is_cut else f"it did not end within {END_S:g} s"
            self._emit(
                HostChanged(
                    state=LinkState.LEFT,
                    message=f"its supervisor still runs: {why}",
                    hint=f"on that host: lifecycle down {host.part.name}",
                ),
                host,
            )

    def _conclude(self, failure: str) -> ExitCode:
        codes = {each.name: each.exit_code for each in self._hosts}
        if self._leaves:
            code = ExitCode.HUNG_UP
            for each in self._hosts:
                if each.runs:
                    follow, end = self._again
                    self._emit(
                        HostChanged(
                            state=LinkState.LEFT,
                            message="its supervisor runs on",
                            hint=f"follow it: {follow}; end it: {end}",
                        ),
                        each,
                    )
        else:
            code = worst(each for each in codes.values() if each is not None)
            wanted = self._wanted
            if wanted is not None and code in _CUT_SHORT:
                is_done = self._was_up and code is ExitCode.OK
                code = code if is_done and wanted is not ExitCode.INTERRUPTED else wanted
            if failure:
                code = ExitCode.BRING_UP_FAILED if code in _CUT_SHORT else code
            elif any(each.runs for each in self._hosts):
                code = worst((code, ExitCode.BRING_UP_FAILED))
        is_taken = any(each.is_taken for each in self._hosts)
        reason = self._reason or failure or ("followed by another" if is_taken else "done")
        self._emit(
            HostsEnded(
                reason=reason,
                exit_code=int(code),
                exit_codes=codes,
                elapsed_s=self._elapsed_s,
            )
        )
        return code

    async def _until(self, holds: Callable[[], bool], seconds: float | None) -> bool:
        """Wait until something holds; False if it does not in time."""
        deadline_s = None if seconds is None else self._now_s + seconds
        while not holds():
            self._changed.clear()
            left_s = None if deadline_s is None else deadline_s - self._now_s
            if left_s is not None and left_s <= 0:
                return False
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._changed.wait(), left_s)
        return True

    def _emit(self, event: HostEvent, host: _Host | None = None) -> None:
        name = "" if host is None else host.name
        self._listener(name, to_record(event, name))

    async def _attend(self, host: _Host) -> None:
        """Keep a connection to a host for as long as there is something to follow."""
        while not host.is_over:
            failure = await self._connected(host)
            host.channel = None
            if host.is_over:
                break
            if not host.is_ready:
                self._fail(host, *failure)
                return
            self._note_cut(host, failure[0])
            await asyncio.sleep(AGAIN_S[min(host.tries, len(AGAIN_S) - 1)])
            host.tries += 1

    def _note_cut(self, host: _Host, why: str) -> None:
        """Say that a link is cut, once."""
        if host.is_cut:
            return
        host.is_cut, host.cut_s, host.tries = True, self._now_s, 0
        message = f"the link is cut: {why}"
        if host.is_begun:
            message += "; its supervisor runs on"
        self._emit(HostChanged(state=LinkState.CUT, message=message), host)
        self._notify()

    async def _connected(self, host: _Host) -> tuple[str, str]:
        """Connect, and follow the host until the end; return why that came, and a hint."""
        try:
            channel = await host.transport.open()
        except OSError as error:
            return f"cannot start {error.filename or 'ssh'}: {error.strerror}", ""
        why = ""
        noise: list[str] = []
        try:
            why = await self._speak(host, channel, noise)
            if why and host.is_ready and not host.is_over:
                # An ssh without a link takes seconds to end.
                host.channel = None
                self._note_cut(host, why)
        finally:
            # Also where this task is cancelled: the process at the other end is waited for.
            closed = await asyncio.shield(asyncio.ensure_future(channel.close()))
        if why:
            return why, ""
        return host.transport.explained(closed, "\n".join(noise))

    async def _speak(self, host: _Host, channel: Channel, noise: list[str]) -> str:
        """Follow a host over one channel; return why that is over, empty if its end says."""
        try:
            limit_s = AGAIN_HELLO_S if host.is_ready else HELLO_S
            said = await asyncio.wait_for(hello(channel, noise), limit_s)
        except (asyncio.TimeoutError, EOFError):
            return ""
        if (said.version, said.protocol) != (self._version, PROTOCOL):
            self._fail(
                host,
                f"its lifecycle is version {said.version}, and here it is {self._version}",
                "install the same version on all hosts",
            )
            return "another version"
        host.channel, host.last_received_s = channel, self._now_s
        host.pings.clear()
        if not host.is_ready:
            host.is_ready = True
            self._emit(HostChanged(state=LinkState.CONNECTED), host)
        self._notify()
        for _ in range(READINGS - 1):
            self._ping(host)
        if self._goes:
            self._ask(host)
        reading = asyncio.ensure_future(self._read(host, channel))
        try:
            while not reading.done():
                self._ping(host)
                left_s = host.last_received_s + CUT_S - self._now_s
                await asyncio.wait({reading}, timeout=max(0.0, min(HEARTBEAT_S, left_s)))
                if host.is_over:
                    return "over"
                now_s = self._now_s
                if now_s - host.last_received_s >= CUT_S:
                    return f"nothing came for {now_s - host.last_received_s:.1f} s"
                if host.asked_s is not None and now_s - host.asked_s > ANSWER_S:
                    return f"no answer within {ANSWER_S:g} s"
        finally:
            reading.cancel()
            with contextlib.suppress(asyncio.CancelledError, EOFError):
                await reading
        return ""

    async def _read(self, host: _Host, channel: Channel) -> None:
        while not host.is_over:
            data = await channel.receive()
            host.last_received_s = self._now_s
            if data.startswith(AGENT_MARK):
                try:
                    said = from_json(data, Said, longest=LONGEST_LINE)
                except ValueError as error:
                    raise EOFError from error
                self._take(host, said)
            else:
                self._pass_on(host, data)

    def _pass_on(self, host: _Host, data: bytes) -> None:
        try:
            record = json.loads(data)
        except (ValueError, RecursionError):
            record = None
        # What only a coordinator says is not for a host to say.
        if not isinstance(record, dict) or str(record.get("event")) in _OURS:
            self._emit(HostStderr(line=data.decode(errors="replace")), host)
            return
        was_up, was_reached = host.is_up, host.reached
        host.note(record)
        self._listener(host.name, {"host": host.name, **record} | {"host": host.name})
        if (host.is_up, host.reached) != (was_up, was_reached):
            self._notify()

    def _take(self, host: _Host, said: Said) -> None:
        """Take what an agent says."""
        if said.agent is Word.PONG:
            self._pong(host, said)
        elif said.agent is Word.STDERR:
            self._emit(HostStderr(line=said.message), host)
        elif said.agent in (Word.STARTED, Word.ATTACHED):
            self._follows(host, said)
        elif said.agent is Word.ABSENT:
            self._absent(host)
        elif said.agent is Word.REFUSED:
            self._fail(host, said.message, said.hint)
        elif said.agent is Word.TAKEN:
            host.is_taken = True
            self._emit(
                HostChanged(
                    state=LinkState.TAKEN,
                    message="another coordinator follows its supervisor from now on",
                ),
                host,
            )
        elif said.agent is Word.ENDED:
            host.exit_code = host.ended(said)
            host.was_killed = bool(said.signal)
            by = f"killed by signal {said.signal}" if said.signal else ""
            self._emit(
                HostChanged(state=LinkState.ENDED, exit_code=host.exit_code, message=by), host
            )
        self._notify()

    def _follows(self, host: _Host, said: Said) -> None:
        host.asked_s = None
        was_there = said.agent is Word.ATTACHED and not host.is_begun and host.starts <= 1
        if was_there and host.until != _ACTIVE:
            self._fail(
                host,
                "its supervisor runs already, and is left as it is",
                f"verify what runs, on that host: lifecycle verify {self._system}",
            )
            return
        state = LinkState.ATTACHED if said.agent is Word.ATTACHED else LinkState.STARTED
        message = ""
        lost_s = self._now_s - host.cut_s if host.is_cut else 0.0
        if host.is_cut:
            state = LinkState.HEALED if host.is_begun else state
            message = f"the link is there again after {lost_s:.1f} s"
        elif state is LinkState.ATTACHED:
            message = "its supervisor runs already, and is followed"
        if not host.is_begun:  # the answer to an earlier START may have been lost
            host.is_ours = said.agent is Word.STARTED or host.starts > 1
        host.is_begun, host.is_cut = True, False
        if isinstance(said.status, dict) and _is_up(said.status, host.until):
            host.is_up = True
        self._emit(
            HostChanged(
                state=state, pid=said.pid, message=message, lost_s=lost_s, status=said.status
            ),
            host,
        )
        if host.is_ending:
            self._send(host, Order(do=Do.END))

    def _absent(self, host: _Host) -> None:
        """Take it that there is no supervisor any more: it ended while the link was cut."""
        known = host.ended(Said(agent=Word.ENDED))
        host.exit_code = int(ExitCode.OK) if host.is_ending else known
        self._emit(
            HostChanged(
                state=LinkState.ENDED,
                exit_code=host.exit_code,
                message="its supervisor ended while the link was cut",
                hint=f"what happened: lifecycle history {self._system}, on that host",
            ),
            host,
        )

    def _fail(self, host: _Host, message: str, hint: str) -> None:
        host.has_failed = True
        self._emit(HostChanged(state=LinkState.FAILED, message=message, hint=hint), host)
        self._notify()

    def _ask(self, host: _Host) -> None:
        """Have a supervisor started, or followed that runs."""
        starts = not host.is_begun and not self._is_asked
        if not starts and not host.is_begun and not host.starts:
            return
        host.asked_s = self._now_s
        host.starts += starts
        self._send(host, Order(do=Do.START if starts else Do.ATTACH, part=host.part))

    def _ping(self, host: _Host) -> None:
        self._numbers += 1
        host.pings[self._numbers] = (self._clock(), self._now_s)
        self._send(host, Order(do=Do.PING, number=self._numbers))

    def _pong(self, host: _Host, said: Said) -> None:
        sent = host.pings.pop(said.number, None)
        if sent is None:
            return
        sent_s, asked_s = sent
        back_s = self._clock()
        if abs((back_s - sent_s) - (self._now_s - asked_s)) > NOTABLE_S:
            host.readings.clear()  # our own clock was set: they tell how far it was off before
            return
        reading = RoundTrip(
            sent_s=sent_s, there_s=said.received_s, answered_s=said.sent_s, back_s=back_s
        )
        if reading.delay_s < -NOTABLE_S:
            return  # theirs was set while they answered
        host.readings.append(reading)
        if len(host.readings) < READINGS:
            return
        found, known = clock_offset(host.readings), host.clock
        if known is not None:
            apart_s = abs(found.offset_s - known.offset_s)
            if apart_s <= found.uncertainty_s + known.uncertainty_s + NOTABLE_S:
                return
        host.clock = found
        self._emit(
            ClockMeasured(
                offset_s=found.offset_s,
                uncertainty_s=found.uncertainty_s,
                round_trips=found.round_trips,
                differs=found.differs(NOTABLE_S),
            ),
            host,
        )

    @staticmethod
    def _send(host: _Host, order: Order) -> None:
        if host.channel is not None:
            host.channel.send(line(order))

    def _notify(self) -> None:
        self._changed.set()


_CUT_SHORT = frozenset((ExitCode.OK, ExitCode.HUNG_UP, ExitCode.INTERRUPTED, ExitCode.TERMINATED))


def _is_up(status: Mapping[str, Any], until: str) -> bool:
    """Whether a status shows what an event said that may be lost: how far the system came."""
    if status.get("phase") == _ACTIVE or until == _ACTIVE:
        return status.get("phase") == _ACTIVE
    nodes = status.get("nodes", ())
    connected = all(each["reach"] in {"connected", _ACTIVE} for each in nodes)
    return connected and (until == "connected" or status.get("verdict") == "ok")


def _code(value: object) -> int | None:
    return value if isinstance(value, int) else None
