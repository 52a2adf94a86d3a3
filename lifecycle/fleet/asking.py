"""Asks the agents of all hosts one question at once: how a system is, or that it be ended.

Owns: `statuses`, `down`, and what a connection begins with. Every wait has a deadline, and a host
that does not answer is an answer. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Iterable, Mapping

from lifecycle import dataclasses
from lifecycle.codec import from_json
from lifecycle.errors import ExitCode
from lifecycle.fleet.protocol import (
    AGENT_MARK,
    LONGEST_LINE,
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

HELLO_S = 30.0
"""For a connection, the login shell there, and the start of the agent."""

ANSWER_S = 20.0
"""For an agent to start a supervisor, or follow one."""

HEARTBEAT_S = 1.0

READINGS = 8
"""Round trips that a clock's offset is the best of."""


_SEVERITY = (
    ExitCode.OK,
    ExitCode.HUNG_UP,
    ExitCode.INTERRUPTED,
    ExitCode.TERMINATED,
    ExitCode.UNVERIFIABLE,
    ExitCode.VIOLATED,
    ExitCode.SUPERVISION_GAVE_UP,
    ExitCode.BRING_UP_FAILED,
    ExitCode.MANIFEST_INVALID,
    ExitCode.USAGE,
    ExitCode.INTERNAL,
)


def worst(codes: Iterable[int]) -> ExitCode:
    """Return the exit code that says most of several; one that is none of ours is our bug."""
    known = {int(each): each for each in _SEVERITY}
    found = (known.get(each, ExitCode.INTERNAL) for each in codes)
    return max(found, key=_SEVERITY.index, default=ExitCode.OK)


async def hello(channel: Channel, noise: list[str]) -> Said:
    """Return the first word of an agent, after what login shells print.

    Raises:
        EOFError: there is none.
    """
    while True:
        data = await channel.receive()
        if data.startswith(AGENT_MARK):
            with contextlib.suppress(ValueError):
                return from_json(data, Said, longest=LONGEST_LINE)
        noise.append(data.decode(errors="replace"))
        del noise[:-READINGS]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class HostStatus:
    """How one machine of a system is, as far as its host says.

    Attributes:
        host: name of the machine.
        destination: where it is.
        status: as `lifecycle status` has it; None where there is none.
        is_absent: the host answers, and no supervisor of the machine runs there.
        message: why there is no status, a whole sentence.
        hint: what to do about it.
        clock: None where it was not measured.
    """

    host: str
    destination: str
    status: object = None
    is_absent: bool = False
    message: str = ""
    hint: str = ""
    clock: ClockOffset | None = None


async def statuses(
    parts: Iterable[Part], transports: Mapping[str, Transport], *, version: str
) -> tuple[HostStatus, ...]:
    """Ask all hosts at once how their part of a system is.

    Args:
        parts: of the system; their files are not sent.
        transports: by machine.
        version: of this package: agents have the same.
    """
    return tuple(
        await asyncio.gather(*(_status(each, transports[each.machine], version) for each in parts))
    )


async def _status(part: Part, transport: Transport, version: str) -> HostStatus:
    host = HostStatus(host=part.machine, destination=transport.destination)
    question = Order(do=Do.STATUS, name=part.name, whole=part.whole)
    found = await _asked(transport, question, ANSWER_S, version=version)
    host = dataclasses.replace(host, clock=found.clock)
    said = found.said
    if said is None:
        return dataclasses.replace(host, message=found.message, hint=found.hint)
    if said.agent is Word.ABSENT:
        return dataclasses.replace(host, is_absent=True, message="no supervisor runs there")
    if said.agent is Word.STATUS:
        return dataclasses.replace(host, status=said.status)
    return dataclasses.replace(host, message=said.message, hint=said.hint)


async def down(
    parts: Iterable[Part], transports: Mapping[str, Transport], timeout_s: float
) -> dict[str, tuple[ExitCode, str]]:
    """End the runs of all hosts at once, whoever started them.

    Args:
        parts: of the system; their files are not sent.
        transports: by machine.
        timeout_s: for each.

    Returns:
        By machine, the exit code of each, and what there is to say.
    """
    parts = tuple(parts)
    outcomes = await asyncio.gather(
        *(down_one(each, transports[each.machine], timeout_s) for each in parts)
    )
    return {each.machine: outcome for each, outcome in zip(parts, outcomes, strict=True)}


async def down_one(part: Part, transport: Transport, timeout_s: float) -> tuple[ExitCode, str]:
    """End the run of one host, see `down`."""
    order = Order(do=Do.DOWN, name=part.name, whole=part.whole, timeout_s=timeout_s)
    found = await _asked(transport, order, timeout_s + ANSWER_S)
    said = found.said
    if said is None:
        why = f"{found.message}; {found.hint}" if found.hint else found.message
        return ExitCode.BRING_UP_FAILED, why
    if said.agent is Word.ABSENT:
        return ExitCode.OK, "did not run"
    if said.agent is Word.DONE and said.exit_code is not None:
        return worst([said.exit_code]), said.message
    return ExitCode.BRING_UP_FAILED, said.message


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _Asked:
    said: Said | None = None
    message: str = ""
    hint: str = ""
    clock: ClockOffset | None = None


async def _asked(
    transport: Transport, order: Order, timeout_s: float, *, version: str = ""
) -> _Asked:
    """Return what an agent says to one order, or why it says nothing.

    Args:
        transport: the way to it.
        order: what to ask.
        timeout_s: for the answer.
        version: that the agent must have; empty for any.
    """
    try:
        channel = await transport.open()
    except OSError as error:
        return _Asked(message=f"cannot start {error.filename or 'ssh'}: {error.strerror}")
    noise: list[str] = []
    found = _Asked()
    is_late = False
    try:
        first = await asyncio.wait_for(hello(channel, noise), HELLO_S)
        if version and (first.version, first.protocol) != (version, PROTOCOL):
            return _Asked(
                message=f"its lifecycle is version {first.version}, and here it is {version}",
                hint="install the same version on all hosts",
            )
        try:
            found = await asyncio.wait_for(_outcome(channel, order), timeout_s)
        except asyncio.TimeoutError:
            is_late = True
    except (asyncio.TimeoutError, EOFError):
        pass
    finally:
        closed = await asyncio.shield(asyncio.ensure_future(channel.close()))
    if found.said is not None:
        return found
    if is_late:
        return _Asked(message=f"no answer within {timeout_s:g} s")
    message, hint = transport.explained(closed, "\n".join(noise))
    return _Asked(message=message, hint=hint)


_ANSWERS = frozenset((Word.STATUS, Word.DONE, Word.ABSENT, Word.REFUSED))


async def _outcome(channel: Channel, order: Order) -> _Asked:
    """Return what came of an order; asks meanwhile, because a silent coordinator is left."""
    sent: dict[int, float] = {}

    def ping() -> None:
        sent[len(sent) + 1] = time.time()
        channel.send(line(Order(do=Do.PING, number=len(sent))))

    for _ in range(READINGS):
        ping()
    channel.send(line(order))
    reading = asyncio.ensure_future(_answered(channel, sent))
    try:
        while not reading.done():
            await asyncio.wait({reading}, timeout=HEARTBEAT_S)
            if not reading.done():
                ping()
        return reading.result()
    finally:
        reading.cancel()
        with contextlib.suppress(asyncio.CancelledError, EOFError):
            await reading


async def _answered(channel: Channel, sent: Mapping[int, float]) -> _Asked:
    readings: list[RoundTrip] = []
    while True:
        data = await channel.receive()
        if not data.startswith(AGENT_MARK):
            continue
        try:
            said = from_json(data, Said, longest=LONGEST_LINE)
        except ValueError as error:
            raise EOFError from error
        if said.agent is Word.PONG and said.number in sent:
            readings.append(
                RoundTrip(
                    sent_s=sent[said.number],
                    there_s=said.received_s,
                    answered_s=said.sent_s,
                    back_s=time.time(),
                )
            )
        if said.agent in _ANSWERS:
            clock = clock_offset(readings) if readings else None
            return _Asked(said=said, clock=clock)
