"""The supervisor's control socket: what `lifecycle status`, `down`, `pause` and others ask.

Owns: listening, answering, and following what a supervisor knows; what is asked and answered is
protocol.py's. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from lifecycle.codec import from_json, to_json
from lifecycle.errors import ExitCode, UsageError
from lifecycle.plan.model import Plan
from lifecycle.run_directory import connect, short_path
from lifecycle.supervisor.control.protocol import (
    ANSWER_S,
    Answer,
    ControlRequest,
    Question,
    SystemStatus,
    read_answer,
)
from lifecycle.verify.observation import Observation
from lifecycle.verify.verdict import Verdict

if TYPE_CHECKING:
    from lifecycle.supervisor.core.state import Order
    from lifecycle.supervisor.shell.supervisor import Supervisor

_BURST_S = 0.05
_CLOSE_S = 1.0
"""In the end, a client that reads nothing for so long loses what it was not sent."""
_LARGEST_QUESTION = 64 * 2**20
"""Bytes of a line; a question may hold a whole plan."""


class SupervisorSnapshot(msgspec.Struct, frozen=True, kw_only=True):
    """All that a supervisor knows at one moment.

    Attributes:
        observation: what its last verdict was judged by; empty before the first.
        verdict: None before the first.
    """

    plan: Plan
    status: SystemStatus
    observation: Observation
    verdict: Verdict | None


class LookAnswer(Answer, frozen=True, kw_only=True):
    """Answer to LOOK and FOLLOW.

    Attributes:
        look: for FOLLOW one at once and one after each change.
    """

    look: SupervisorSnapshot | None = None


class ControlServer:
    """Answers on the control socket while the supervisor lives.

    Args:
        path: of the socket.
        session: what is asked.
    """

    def __init__(self, path: Path, session: Supervisor) -> None:
        self._path = path
        self._session = session
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
        from lifecycle.supervisor.core.state import Order  # clients do not need it

        self._open.add(writer)
        try:
            while line := await reader.readline():
                question = from_json(line, Order)
                if question.ask is ControlRequest.DOWN:
                    self._waiting.add(writer)
                    self._session.stop("lifecycle down", ExitCode.BRING_UP_FAILED)
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

    async def _answer(self, question: Order) -> Answer:
        if question.ask is ControlRequest.STATUS:
            plan = question.plan
            differs = () if plan is None else self._session.differences(plan)
            return Answer(status=self._session.status(), differences=differs)
        if question.ask is ControlRequest.LOOK:
            return LookAnswer(look=self._session.look())
        return await self._session.order(question)

    async def _follow(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Send what is known now and after each change, until the client goes away."""
        gone = asyncio.ensure_future(reader.read())
        try:
            while not gone.done():
                changed = self._changed
                await _say(writer, LookAnswer(look=self._session.look()))
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


def follow(path: Path) -> Iterator[SupervisorSnapshot]:
    """Yield what the supervisor that listens at `path` knows, now and after each change.

    It ends with the supervisor.

    Raises:
        TimeoutError: an answer was begun, and does not end.
        UsageError: what answers is no supervisor of this version.
        OSError: no supervisor listens there.
    """
    with connect(path, ANSWER_S) as sock:
        sock.sendall(to_json(Question(ask=ControlRequest.FOLLOW)) + b"\n")
        rest = bytearray()
        while (answer := read_answer(path, sock, rest, None, LookAnswer)) is not None:
            if answer.look is not None:
                yield answer.look
