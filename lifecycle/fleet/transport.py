"""How `lifecycle up --hosts` reaches the agent of a machine: over ssh(1), or as a child of ours.

Owns: the Protocols `Transport` and `Channel`, their two implementations, the command lines, and
what an end of ssh before the agent answered means to a person. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import shlex
from collections.abc import Sequence
from typing import Protocol

from lifecycle import dataclasses
from lifecycle.fleet.agent import COMMAND
from lifecycle.fleet.protocol import LONGEST_LINE

AGENT_VERB = "host-agent"

_OPTIONS = (
    "-T",
    *("-o", "BatchMode=yes"),  # a question that nobody answers would wait for ever
    *("-o", "ServerAliveInterval=5", "-o", "ServerAliveCountMax=3"),
    *("-o", "ControlMaster=no"),  # a master would live on in the background
    *("-o", "ClearAllForwardings=yes", "-o", "RemoteCommand=none"),
)
_LAST_LINES = 12
_CLOSE_S = 2.0
_NOT_FOUND, _NOT_EXECUTABLE, _SSH_FAILED, _USAGE = 127, 126, 255, 2


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Closed:
    """How a channel ended.

    Attributes:
        exit_code: of ssh or the agent; None where we ended it.
        text: the last lines that it wrote to standard error.
    """

    exit_code: int | None
    text: str


class Channel(Protocol):
    """A connection to one agent."""

    def send(self, data: bytes) -> None:
        """Send a line some time; one that cannot be sent any more shows as the end."""

    async def receive(self) -> bytes:
        """Return the next line, without its end; raises EOFError once there is none any more."""

    async def close(self) -> Closed:
        """End it, bounded; what the agent follows runs on. Again is harmless."""


class Transport(Protocol):
    """The way to one machine."""

    @property
    def destination(self) -> str:
        """Where that is, for people."""

    async def open(self) -> Channel:
        """Begin a connection; that it fails shows as the end of the channel.

        Raises:
            OSError: the program that makes it cannot be started.
        """

    def explained(self, closed: Closed, noise: str) -> tuple[str, str]:
        """Return why there is no agent, as part of a sentence, and what to do next.

        Args:
            closed: how the connection ended.
            noise: what came on it instead.
        """


class ProcessChannel:
    """A connection over the standard streams of a child process in a session of its own.

    A key that is pressed in our terminal signals us alone.
    """

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process
        self._last: collections.deque[str] = collections.deque(maxlen=_LAST_LINES)
        self._errors = asyncio.ensure_future(self._read_errors())
        self._was_ended = False

    @classmethod
    async def start(cls, argv: Sequence[str]) -> ProcessChannel:
        """Start the process.

        Raises:
            OSError: it cannot be started.
        """
        process = await asyncio.create_subprocess_exec(
            *argv,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            limit=LONGEST_LINE,
            start_new_session=True,
        )
        return cls(process)

    async def _read_errors(self) -> None:
        assert self._process.stderr is not None
        with contextlib.suppress(ValueError):  # a line without end
            async for each in self._process.stderr:
                self._last.append(each.decode(errors="replace").rstrip())

    def send(self, data: bytes) -> None:
        """Send a line."""
        assert self._process.stdin is not None
        if not self._process.stdin.is_closing():
            self._process.stdin.write(data)

    async def receive(self) -> bytes:
        """Return the next line."""
        assert self._process.stdout is not None
        try:
            data = await self._process.stdout.readline()
        except ValueError as error:
            raise EOFError from error
        if not data.endswith(b"\n"):
            raise EOFError
        return data[:-1]

    async def close(self) -> Closed:
        """Close its standard input, upon which it ends; make it end where it does not."""
        stdin = self._process.stdin
        assert stdin is not None
        stdin.close()
        if self._process.returncode is None:
            await self._ended_within(_CLOSE_S)
        for end in (self._process.terminate, self._process.kill):
            if self._process.returncode is None:
                self._was_ended = True
                end()
                await self._ended_within(_CLOSE_S)
        with contextlib.suppress(asyncio.TimeoutError):
            # Another process may have its standard error, too.
            await asyncio.wait_for(self._errors, _CLOSE_S)
        code = None if self._was_ended else self._process.returncode
        return Closed(exit_code=code, text="\n".join(self._last))

    async def _ended_within(self, seconds: float) -> None:
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self._process.wait(), seconds)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class LocalTransport:
    """This host: the agent is a child of ours, and what it starts outlives us as on any other.

    Attributes:
        command: this program.
    """

    command: tuple[str, ...] = COMMAND

    @property
    def destination(self) -> str:
        """This host."""
        return "this host"

    async def open(self) -> Channel:
        """Start the agent."""
        return await ProcessChannel.start((*self.command, AGENT_VERB))

    def explained(self, closed: Closed, noise: str) -> tuple[str, str]:
        """Say how the agent ended."""
        why = _last(closed.text) or _last(noise) or f"exit status {closed.exit_code}"
        return f"its agent ended: {why}", ""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class SshTransport:
    """Another host, by the user's own ssh(1), keys and configuration.

    Attributes:
        machine: its name in the manifest.
        destination: as ssh takes it: an address, a name of ssh_config(5), `user@host`.
        remote_command: text for the login shell there that runs `lifecycle`.
        ssh: the program, and options of the user's.
        connect_s: for a connection to be made.
    """

    machine: str
    destination: str
    remote_command: str = "lifecycle"
    ssh: tuple[str, ...] = ("ssh",)
    connect_s: int = 10

    def argv(self) -> tuple[str, ...]:
        """Return the command line; of what is not the user's own text, nothing reaches a shell."""
        return (
            *self.ssh,
            *_OPTIONS,
            *("-o", f"ConnectTimeout={self.connect_s}"),
            "--",
            self.destination,
            f"{self.remote_command} {AGENT_VERB}",
        )

    async def open(self) -> Channel:
        """Start ssh."""
        return await ProcessChannel.start(self.argv())

    def explained(self, closed: Closed, noise: str) -> tuple[str, str]:
        """Say what ssh, or the shell there, had to say."""
        return explained(
            closed,
            noise,
            machine=self.machine,
            remote_command=self.remote_command,
            by_hand=shlex.join((*self.ssh, self.destination)),
        )


_EXAMPLE = "--remote-command '. /opt/ros/jazzy/setup.sh && /PATH/TO/lifecycle'"
_FAILURES = (
    ("Host key verification failed", "connect once by hand and compare its key: {by_hand}"),
    ("REMOTE HOST IDENTIFICATION HAS CHANGED", "compare its key by hand: {by_hand}"),
    ("Permission denied", "have it accept a key of yours, or load it by ssh-add: {by_hand}"),
    ("Could not resolve hostname", "say where it is: --host {machine}=USER@ADDRESS"),
    ("Connection refused", "is there an sshd? Try {by_hand}, or --host {machine}=USER@ADDRESS"),
    ("Bad owner or permissions", "set them as ssh_config(5) says"),
)
"""What is in a message of ssh(1), and what to do then."""


def explained(
    closed: Closed, noise: str, *, machine: str, remote_command: str, by_hand: str
) -> tuple[str, str]:
    """Return why ssh brought no agent, as part of a sentence, and what to do next.

    Args:
        closed: how it ended.
        noise: what came from the other side instead.
        machine: its name in the manifest.
        remote_command: what was to be run there.
        by_hand: what a person types to connect.
    """
    code, last = closed.exit_code, _last(closed.text)
    for part, hint in _FAILURES:
        if part in closed.text:
            said = next(each for each in closed.text.splitlines() if part in each)
            return said.strip(), hint.format(by_hand=by_hand, machine=machine)
    if code in (_NOT_FOUND, _NOT_EXECUTABLE):
        return (
            f"its shell cannot run {remote_command!r}: {last or f'exit status {code}'}",
            f"install it there, or say how it is run: {_EXAMPLE}",
        )
    if code == _USAGE and AGENT_VERB in closed.text:
        return (
            f"its lifecycle is of a version without --hosts: {last}",
            "install the version there that is here",
        )
    if code is None:
        return f"no answer in time{f': {last}' if last else ''}", f"try by hand: {by_hand}"
    if code == _SSH_FAILED:
        return last or "ssh failed", f"try by hand: {by_hand}"
    why = last or _last(noise) or "nothing was written"
    return f"{remote_command!r} ended there with exit status {code}: {why}", f"try it: {by_hand}"


def _last(text: str) -> str:
    """Return the last line that says something."""
    return next((each.strip() for each in reversed(text.splitlines()) if each.strip()), "")


def ssh_command(environment_value: str) -> tuple[str, ...]:
    """Return the program and options in LIFECYCLE_SSH, `ssh -F file`; ssh(1) where it is empty.

    Raises:
        ValueError: quotes that do not end.
    """
    return tuple(shlex.split(environment_value)) or ("ssh",)
