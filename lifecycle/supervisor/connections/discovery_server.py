"""The discovery server of a system: started before any node, watched like any process, ended last.

Owns: who starts it and when it counts as started. What it is and how it is run is middleware's.
Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from typing import TYPE_CHECKING

from lifecycle.errors import BringUpError, MiddlewareError
from lifecycle.graph.loop import within
from lifecycle.manifest.model import Run, RunKind
from lifecycle.middleware.fastdds.discovery import (
    discovery_server_command,
    discovery_server_listens,
)
from lifecycle.plan.model import PlannedProcess, PlannedServer
from lifecycle.supervisor.control.protocol import ProcessState
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.processes.process import ManagedProcess, ProcessExit
from lifecycle.supervisor.run.events import Failure, ProcessChanged, StepFailedError
from lifecycle.supervisor.run.options import own_machines
from lifecycle.verify.rules import Rule
from lifecycle.verify.rules.catalogue import DEADLINE, PROCESS_DIED, START_FAILED

if TYPE_CHECKING:
    from lifecycle.supervisor.processes.fork_server import ForkServer

NAME = "discovery_server"
"""Its process; no node can be called so, as keys of processes are manifest keys."""

START_S = 10.0
"""It listens within 50 ms; a loaded machine takes longer."""

_ESCALATION = ((signal.SIGINT, 2.0), (signal.SIGTERM, 1.0), (signal.SIGKILL, 5.0))
"""Signals that end it, and seconds to wait for its end after each."""

LOOK_AGAIN_S = 0.02
"""Between two looks whether it listens: a process that is not ours to change does not notify us."""


async def begin(system: System, spawner: ForkServer) -> None:
    """Start the plan's discovery server, or wait for the one of another machine.

    Raises:
        StepFailedError: it cannot be started or ended again, or does not listen in time.
    """
    planned = system.plan.server
    if planned is None:
        return
    if planned.machine not in own_machines(system.plan, system.run.options.machine):
        await _until_it_listens(planned, None)
        return
    if discovery_server_listens(planned):
        # Fast DDS's server goes on without the port, and its owner seems to be the server.
        raise _failed(
            f"cannot start the discovery server at {_where(planned)}: that port is not free on "
            "this host; end who has it (`ss -lnp`), or choose another 'discovery: first_port'"
        )
    try:
        argv, environment = discovery_server_command(planned)
    except MiddlewareError as error:
        raise _failed(error.message) from error
    # What it must not have would be inherited: `env` takes it away and becomes the program.
    without = [f"--unset={name}" for name in os.environ if name not in environment]
    argv = ("env", *without, *argv)
    process = system.make_process(
        PlannedProcess(
            name=NAME,
            machine=planned.machine,
            run=Run(kind=RunKind.COMMAND, command=argv),
            nodes=(),
            argv=argv,
            environment=tuple(environment.items()),
        )
    )
    system.server = process
    try:
        await process.spawn(spawner, None)
    except (BringUpError, OSError) as error:
        raise _failed(f"cannot start the discovery server: {error}") from error
    _say(system, ProcessState.STARTING)
    await _until_it_listens(planned, process)
    _say(system, ProcessState.RUNNING)


async def end(system: System, hurry: asyncio.Event) -> None:
    """End it, if it is ours; nothing of the system may need it any more. Again is harmless."""
    server = system.server
    if server is None or not server.pid:
        return
    if not server.ended.done():
        _say(system, ProcessState.STOPPING)
    for number, wait_s in _ESCALATION:
        if not server.ended.done() and (number == signal.SIGKILL or not hurry.is_set()):
            server.signal(number)
            await asyncio.wait({server.ended}, timeout=wait_s)
    await server.release()
    if server.ended.done():
        _say(system, ProcessState.EXITED)
    system.server = None


def _say(system: System, state: ProcessState) -> None:
    server = system.server
    assert server is not None
    detail = str(server.ended.result()) if server.ended.done() else ""
    system.emit(ProcessChanged(process=NAME, state=state, pid=server.pid, detail=detail))


def death(server: ManagedProcess, end: ProcessExit) -> Failure:
    """Return the failure that its end is; the run ends of it.

    Another one in its place does not mend that: Fast DDS 2.14 does not notify super clients, as our
    observer is one, of participants that join after it (0 of 4 tries; other clients 10 of 12).
    """
    words = f": {server.last_words}" if server.last_words else ""
    return Failure(
        rule=PROCESS_DIED.id,
        subject=NAME,
        message=f"cannot keep process {NAME!r} running: pid {server.pid} died: {end}{words}",
        process=NAME,
        log=server.log.shown,
    )


async def _until_it_listens(planned: PlannedServer, process: ManagedProcess | None) -> None:
    """Wait until it listens; there is no event of that."""
    loop = asyncio.get_running_loop()
    deadline = loop.time() + START_S
    log = "" if process is None else str(process.log.path)
    while True:
        if process is not None and process.ended.done():
            text = f"cannot start the discovery server at {_where(planned)}"
            raise _failed(f"{text}: {process.ended.result()}", process=NAME, log=log)
        if (left_s := deadline - loop.time()) <= 0:
            machine = f" of machine {planned.machine!r}" if planned.machine else ""
            whose = "" if process is not None else f"{machine}, whose supervisor starts it,"
            text = f"cannot reach the discovery server{whose} at {_where(planned)}"
            raise _failed(f"{text}: nobody listened for {START_S:g} s", DEADLINE, log=log)
        if process is not None and discovery_server_listens(planned, process.pid):
            return
        if process is None and await _answers(planned, left_s):
            return
        await asyncio.sleep(LOOK_AGAIN_S)


async def _answers(planned: PlannedServer, timeout_s: float) -> bool:
    """Return whether it takes a connection from here; over UDP nothing shows that, and it may."""
    if planned.tcp:
        try:
            opening = asyncio.open_connection(planned.address, planned.port)
            _, writer = await within(timeout_s, opening)
        except (OSError, asyncio.TimeoutError):
            return False
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()
    return True


def _failed(
    message: str, rule: Rule = START_FAILED, *, process: str = "", log: str = ""
) -> StepFailedError:
    failure = Failure(rule=rule.id, subject=NAME, message=message, process=process, log=log)
    return StepFailedError(failure)


def _where(planned: PlannedServer) -> str:
    return f"{'tcp' if planned.tcp else 'udp'} {planned.address}:{planned.port}"
