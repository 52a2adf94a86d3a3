"""The supervisor's control socket: what `lifecycle status`, `down`, `pause` and others ask.

Owns: the requests and replies, one JSON object per line, on both sides. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import enum
import socket
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from lifecycle.codec import from_json, to_json
from lifecycle.errors import UsageError
from lifecycle.plan import Plan
from lifecycle.run_directory import connect, short_path
from lifecycle.supervisor.control.status import SystemStatus
from lifecycle.verify import Observation, Verdict

if TYPE_CHECKING:
    from lifecycle.supervisor.control.orders import Done, Order

_BURST_S = 0.05
_CLOSE_S = 1.0
"""In the end, a client that reads nothing for so long loses what it was not sent."""
_LARGEST_QUESTION = 64 * 2**20
"""Bytes of a line; a question may hold a whole plan."""
_LARGEST_ANSWER = 64 * 2**20
"""Bytes of a line; a look holds a whole plan and all that was seen."""
_ANSWER_S = 10.0
"""For the rest of an answer that has begun."""
_READ = 2**18


class ControlRequest(enum.Enum):
    """What a supervisor can be asked."""

    STATUS = "status"
    DOWN = "down"
    LOOK = "look"
    FOLLOW = "follow"
    PAUSE = "pause"
    RESUME = "resume"
    RESTART = "restart"
    DIFFERENCES = "differences"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """Client → supervisor.

    Attributes:
        node: for RESTART, manifest key or fully qualified name; empty for the whole system.
        plan: for DIFFERENCES and orders, the plan of the client's manifest as it is now;
            None if it was given none.
        reload: for RESTART, `plan` is to run from now on.
    """

    ask: ControlRequest
    node: str = ""
    plan: Plan | None = None
    reload: bool = False


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class SupervisorSnapshot:
    """All that a supervisor knows at one moment.

    Attributes:
        observation: what its last verdict was judged by; empty before the first.
        verdict: None before the first.
    """

    plan: Plan
    status: SystemStatus
    observation: Observation
    verdict: Verdict | None


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """Supervisor → client.

    Attributes:
        status: for STATUS.
        exit_code: for DOWN, of the supervisor, sent once nothing of the system runs any more; for
            an order, what came of it.
        error: why an order was not carried out; empty if it was.
        look: for LOOK; for FOLLOW one at once and one after each change.
        differences: for DIFFERENCES, how the plan of the question differs from what runs.
    """

    status: SystemStatus | None = None
    exit_code: int | None = None
    error: str = ""
    look: SupervisorSnapshot | None = None
    differences: tuple[str, ...] = ()


class ControlServer:
    """Answers on the control socket while the supervisor lives.

    Args:
        path: of the socket.
        status: for STATUS.
        down: for DOWN.
        look: for LOOK and FOLLOW.
        order: carries out an order.
        differences: says how a plan differs from what runs.
    """

    def __init__(
        self,
        path: Path,
        status: Callable[[], SystemStatus],
        down: Callable[[], None],
        *,
        look: Callable[[], SupervisorSnapshot] | None = None,
        order: Callable[[Order], Awaitable[Done]] | None = None,
        differences: Callable[[Plan], tuple[str, ...]] = lambda _: (),
    ) -> None:
        self._path = path
        self._status = status
        self._down = down
        self._look = look
        self._order = order
        self._differences = differences
        self._changed = asyncio.Event()
        self._server: asyncio.AbstractServer | None = None
        self._open: set[asyncio.StreamWriter] = set()
        self._waiting: set[asyncio.StreamWriter] = set()

    async def open(self) -> None:
        """Listen.

        Raises:
            UsageError: the socket cannot be made, on a full disk say.
        """
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._path.unlink(missing_ok=True)
            with short_path(self._path) as name:
                sock.bind(name)
        except OSError as error:
            sock.close()
            raise UsageError(f"cannot listen at {str(self._path)!r}: {error.strerror}") from error
        self._server = await asyncio.start_unix_server(
            self._serve, sock=sock, limit=_LARGEST_QUESTION
        )

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._open.add(writer)
        try:
            while line := await reader.readline():
                question = from_json(line, Question)
                if question.ask is ControlRequest.DOWN:
                    self._waiting.add(writer)
                    self._down()
                elif question.ask is ControlRequest.FOLLOW:
                    await self._follow(reader, writer)
                else:
                    await _say(writer, await self._answer(question))
        except (ConnectionError, ValueError):
            # A client that went away or speaks another language ends its own connection only.
            pass
        finally:
            if writer not in self._waiting:
                self._open.discard(writer)
                writer.close()

    def changed(self) -> None:
        """Notify those who follow that there is something new to see."""
        self._changed.set()
        self._changed = asyncio.Event()

    async def _answer(self, question: Question) -> Answer:
        if question.ask is ControlRequest.LOOK and self._look is not None:
            return Answer(look=self._look())
        from lifecycle.supervisor.control.orders import Order, OrderKind  # clients need neither

        if self._order is not None and question.ask.value in {each.value for each in OrderKind}:
            order = Order(
                kind=OrderKind(question.ask.value),
                node=question.node,
                plan=question.plan,
                reload=question.reload,
            )
            done = await self._order(order)
            return Answer(exit_code=done.exit_code, error=done.error)
        if question.ask is ControlRequest.DIFFERENCES and question.plan is not None:
            return Answer(differences=self._differences(question.plan))
        return Answer(status=self._status())

    async def _follow(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Send what is known now and after each change, until the client goes away."""
        gone = asyncio.ensure_future(reader.read())
        try:
            while self._look is not None and not gone.done():
                changed = self._changed
                await _say(writer, Answer(look=self._look()))
                waiting = asyncio.ensure_future(changed.wait())
                await asyncio.wait({gone, waiting}, return_when=asyncio.FIRST_COMPLETED)
                waiting.cancel()
                # Changes come in bursts; nothing reads pictures faster than this.
                await asyncio.wait({gone}, timeout=_BURST_S)
        finally:
            gone.cancel()

    async def close(self, exit_code: int) -> None:
        """Answer those who asked for it that all is over, and stop listening; bounded."""
        if self._server is None:
            return
        self._server.close()
        for writer in self._waiting:
            with contextlib.suppress(ConnectionError):
                writer.write(to_json(Answer(exit_code=exit_code)) + b"\n")
        for writer in self._open:
            writer.close()
        left = {asyncio.ensure_future(each.wait_closed()): each for each in self._open}
        if left:
            _, late = await asyncio.wait(left, timeout=_CLOSE_S)
            for each in late:
                left[each].transport.abort()
            # A connection that was cut counts as closed.
            await asyncio.gather(*left, return_exceptions=True)
        self._server = None


async def _say(writer: asyncio.StreamWriter, answer: Answer) -> None:
    writer.write(to_json(answer) + b"\n")
    await writer.drain()


def ask(path: Path, question: Question, timeout_s: float) -> Answer | None:
    """Ask the supervisor that listens at `path`.

    Returns:
        Its answer; None if it ended without one.

    Raises:
        TimeoutError: no whole answer within `timeout_s`.
        UsageError: what answers is no supervisor of this version.
        OSError: no supervisor listens there.
    """
    deadline = time.monotonic() + timeout_s
    with connect(path, timeout_s) as sock:
        sock.sendall(to_json(question) + b"\n")
        return _answer(path, sock, bytearray(), deadline)


def follow(path: Path) -> Iterator[SupervisorSnapshot]:
    """Yield what the supervisor that listens at `path` knows, now and after each change.

    It ends with the supervisor.

    Raises:
        TimeoutError: an answer was begun, and does not end.
        UsageError: what answers is no supervisor of this version.
        OSError: no supervisor listens there.
    """
    with connect(path, _ANSWER_S) as sock:
        sock.sendall(to_json(Question(ask=ControlRequest.FOLLOW)) + b"\n")
        rest = bytearray()
        while (answer := _answer(path, sock, rest, None)) is not None:
            if answer.look is not None:
                yield answer.look


def _answer(
    path: Path, sock: socket.socket, rest: bytearray, deadline_s: float | None
) -> Answer | None:
    """Read one answer, bounded in time and size; None if there is none any more.

    Args:
        path: of the socket.
        sock: connected to it.
        rest: what was read beyond the answer before.
        deadline_s: monotonic; None to wait for ever until one begins, and not long for its end.
    """
    searched = 0
    while (end := rest.find(b"\n", searched)) < 0:
        searched = len(rest)
        if searched > _LARGEST_ANSWER:
            raise strange(path, f"{searched} bytes without an end")
        left_s = None if deadline_s is None else deadline_s - time.monotonic()
        if left_s is not None and left_s <= 0:
            raise TimeoutError
        sock.settimeout(left_s)
        data = sock.recv(_READ)
        if not data:
            return None
        if deadline_s is None:
            deadline_s = time.monotonic() + _ANSWER_S
        rest += data
    line = bytes(rest[:end])
    del rest[: end + 1]
    try:
        return from_json(line, Answer)
    except ValueError as error:
        raise strange(path, str(error)) from error


def strange(path: Path, why: str) -> UsageError:
    """Return the error that an answer is which no supervisor of this version gives."""
    return UsageError(
        f"cannot understand the answer of {path.parent.name!r}: {why}",
        hint="use the version of lifecycle that started it, or end the process that listens at "
        f"{path}",
    )
