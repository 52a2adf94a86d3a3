"""Messages between `lifecycle up --hosts` and its agent on each host, and how clocks compare.

Owns: `Order` (coordinator → agent) and `Said` (agent → coordinator), one JSON object a line; what a
supervisor prints there travels between them as it is. Owns also `clock_offset`, after NTP (RFC 5905
§8). Must not import rclpy, and next to nothing else: an agent is started for every connection.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable

from lifecycle import dataclasses
from lifecycle.codec import to_json

PROTOCOL = 2
"""Changes with what an agent of another version could not understand."""

NOTABLE_S = 0.01
"""Clocks that differ by less are not worth a line."""

LONGEST_LINE = 64 * 2**20
"""Bytes; a verdict on a large system has megabytes."""


class Do(enum.Enum):
    """What an agent can be asked."""

    PING = "ping"
    START = "start"
    ATTACH = "attach"
    END = "end"
    DOWN = "down"
    STATUS = "status"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class SentFile:
    """One file of a manifest.

    Attributes:
        path: relative to the manifest's folder, without `..`.
    """

    path: str
    data: bytes


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """One machine's part of a system: what its supervisor is started with.

    Attributes:
        name: of the run directory, see run_directory.run_name.
        whole: of the one that `lifecycle up` has there without --machine.
        manifest: which of the files it is; an absolute path for one that is there already.
        arguments: `name:=value` of the manifest.
        options: further options of `lifecycle up`.
        digest: of all that must be equal for a supervisor that runs to be this one.
    """

    name: str
    machine: str
    manifest: str
    files: tuple[SentFile, ...]
    arguments: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    digest: str = ""
    whole: str = ""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """Coordinator → agent.

    Attributes:
        number: of a PING, returned with its answer.
        part: for START and ATTACH. The latter starts nothing.
        name: for DOWN and STATUS, of the run; END is for the supervisor that the agent follows.
        whole: likewise of the run to take where there is none of that name, see Part.
        timeout_s: for DOWN.
    """

    do: Do
    number: int = 0
    part: Part | None = None
    name: str = ""
    whole: str = ""
    timeout_s: float = 60.0


class Word(enum.Enum):
    """What an agent can say."""

    HELLO = "hello"
    PONG = "pong"
    STARTED = "started"
    ATTACHED = "attached"
    ABSENT = "absent"
    REFUSED = "refused"
    STDERR = "stderr"
    ENDED = "ended"
    DONE = "done"
    STATUS = "status"
    TAKEN = "taken"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Said:
    """Agent → coordinator.

    Attributes:
        agent: STARTED and ATTACHED: it follows a supervisor now, whose pid it is. ABSENT: there is
            none, to attach to or to ask. ENDED: that supervisor has. DONE: of a DOWN. TAKEN:
            another coordinator follows the supervisor from now on.
        version: of HELLO, of the package; `protocol` too.
        number: of a PONG.
        received_s: of a PONG, when its PING came, in seconds since the epoch.
        sent_s: when the PONG was sent.
        status: of ATTACHED and STATUS, as `lifecycle status --format json` has it; None if none
            was given.
        message: of REFUSED, and of a DONE that failed, a whole sentence; of STDERR a line.
        hint: the next thing to do.
        exit_code: of ENDED and DONE; None where it is not known: the supervisor is no child of this
            agent, or was killed.
        signal: of ENDED, number of the signal that killed the supervisor; else 0.
    """

    agent: Word
    version: str = ""
    protocol: int = 0
    number: int = 0
    received_s: float = 0.0
    sent_s: float = 0.0
    pid: int = 0
    status: object = None
    message: str = ""
    hint: str = ""
    exit_code: int | None = None
    signal: int = 0


AGENT_MARK = b'{"agent":'
"""How a line begins that is a `Said`, and none of a supervisor."""


def line(message: Order | Said) -> bytes:
    """Return a message as it is sent."""
    return to_json(message) + b"\n"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class RoundTrip:
    """One question and its answer, in seconds since the epoch of each side's clock.

    Attributes:
        sent_s: ours, when it was asked.
        there_s: theirs, when the question came.
        answered_s: theirs, when the answer was sent.
        back_s: ours, when the answer came.
    """

    sent_s: float
    there_s: float
    answered_s: float
    back_s: float

    @property
    def delay_s(self) -> float:
        """Time on the way, there and back."""
        return (self.back_s - self.sent_s) - (self.answered_s - self.there_s)

    @property
    def offset_s(self) -> float:
        """How far their clock is ahead, if both ways took as long."""
        return ((self.there_s - self.sent_s) + (self.answered_s - self.back_s)) / 2


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ClockOffset:
    """How far the clock of another host is ahead of ours.

    Attributes:
        offset_s: seconds; negative if it is behind.
        uncertainty_s: it is that much more or less: half of the shortest way there and back, as
            the answer may have taken all of it and the question none.
        round_trips: of how many the shortest is.
    """

    offset_s: float
    uncertainty_s: float
    round_trips: int

    def differs(self, least_s: float) -> bool:
        """Whether the clocks differ by more than can be told, and by more than `least_s`."""
        return abs(self.offset_s) > max(self.uncertainty_s, least_s)


def clock_offset(readings: Iterable[RoundTrip]) -> ClockOffset:
    """Return the offset that the shortest of some round trips shows: it had least to wait for.

    Raises:
        ValueError: there is no reading.
    """
    found = tuple(readings)
    best = min(found, key=lambda each: each.delay_s)
    return ClockOffset(
        offset_s=best.offset_s,
        uncertainty_s=max(0.0, best.delay_s) / 2,
        round_trips=len(found),
    )
