"""Starts processes, sends them signals, and ends what they left: Spawn, Signal and Sweep.

Owns: the inputs about processes, `Spawned`, `Exited`, `Swept`. When it is asked for is the
core's alone.
"""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING

from lifecycle.errors import BringUpError
from lifecycle.manifest.model import RunKind
from lifecycle.node.host.control import HostSpec, Operation
from lifecycle.run_directory import FORK_SERVER, start_ticks
from lifecycle.supervisor.control.protocol import ProcessState
from lifecycle.supervisor.core import messages
from lifecycle.supervisor.processes.control_channel import ControlChannel
from lifecycle.supervisor.run.events import Notice
from lifecycle.verify.tool_filter import PREFIX_DIGITS

if TYPE_CHECKING:
    from collections.abc import Iterable

    from lifecycle.supervisor.nodes.system import NodeRun
    from lifecycle.supervisor.processes.process import ManagedProcess
    from lifecycle.supervisor.shell.supervisor import Supervisor

_WORDS_S = 0.1
"""For what a process wrote to its channel just before it ended."""


class Processes:
    """The processes of one supervisor.

    Args:
        shell: gets the inputs.

    Attributes:
        ends: of processes are being said, and what they had open is closed; each within a second.
    """

    def __init__(self, shell: Supervisor) -> None:
        self._shell = shell
        self._system = shell.system
        self._means = shell.means
        self._belonging: dict[str, set[int]] = {}  # what processes had started as they were ended
        self._is_recorded = True
        self.ends: list[asyncio.Task[None]] = []

    def spawn(self, effect: messages.Spawn) -> None:
        """Start a process."""
        system = self._system
        before = system.processes.get(effect.process)
        process = system.make_process(system.run.processes[effect.process].planned)
        process.is_restarted = before is not None
        system.processes[effect.process] = process
        for node in system.carried_by(effect.process):
            node.begin()
        nodes = [system.nodes[key] for key in process.planned.nodes]
        hung = system.liveliness.watch_over(process, [node.name for node in nodes])
        channel = None
        if process.planned.run.kind is RunKind.PYTHON:
            files = (node.planned.at.file for node in nodes)
            folders = (str(Path(each).absolute().parent) for each in files if each)
            spec = HostSpec(
                system=system.plan.system,
                process=process.name,
                domain_id=system.plan.domain_id,
                discovery_range=system.plan.discovery_range,
                nodes=tuple(node.planned for node in nodes),
                folders=tuple(dict.fromkeys(folders)),
                log=process.log.shown,
                joins=system.run.held_s is not None,
                measures=bool(system.plan.bounds),
                apart=self._apart(process),
            )
            channel = ControlChannel(spec, system.on_host_event, hung)
        self._shell.start(self._spawn(process, channel))

    async def _spawn(self, process: ManagedProcess, channel: ControlChannel | None) -> None:
        try:
            await process.spawn(self._means.fork_server, channel)
        except (BringUpError, OSError) as error:
            text = error.message if isinstance(error, BringUpError) else str(error)
            self._shell.give(
                messages.Spawned(process=process.name, log=process.log.shown, error=text)
            )
            await process.release()
            return
        process.ended.add_done_callback(
            lambda _: self.ends.append(self._shell.start(self._say_end(process)))
        )
        self._shell.give(
            messages.Spawned(process=process.name, pid=process.pid, log=process.log.shown)
        )
        self._record()

    def _record(self) -> None:
        """Write down which processes run, for who finds them should this supervisor be killed."""
        directory = self._means.directory
        names = {each.pid: each.name for each in self._system.living}
        try:
            directory.record({**names, self._means.fork_server.pid: FORK_SERVER})
            self._is_recorded = True
        except OSError as error:
            if self._is_recorded:
                text = (
                    f"cannot write {str(directory.path / 'record.json')!r}: {error.strerror}; the "
                    "run goes on, but should this supervisor be killed, the next one may not find "
                    "all that it leaves"
                )
                self._system.emit(Notice(message=text))
            self._is_recorded = False

    def _apart(self, process: ManagedProcess) -> tuple[str, ...]:
        """Return the topics whose messages come by the clock of another host."""
        nodes, remote = process.planned.nodes, self._system.remote
        return tuple(
            each.topic
            for each in self._system.plan.flows
            if each.publisher in remote and each.subscription in nodes
        )

    def measure(self) -> None:
        """Have hosts count what the plan that is now in force has numbers of."""
        if self._system.plan.bounds:
            self._system.have_hosts(Operation.MEASURE, self._apart)

    async def _say_end(self, process: ManagedProcess) -> None:
        """Say how a process ended; of one that was starting, once all is read that it said."""
        system, channel = self._system, process.channel
        known = system.run.processes.get(process.name)
        if channel is not None and known is not None and known.state is ProcessState.STARTING:
            await channel.drained(_WORDS_S)
        end = process.ended.result()
        carried = system.carried_by(process.name)
        self.forget(process.pid, carried)
        self._shell.give(
            messages.Exited(
                process=process.name,
                status=end.status,
                signal=end.signal or 0,
                text=str(end),
                words=process.last_words,
                stderr=process.last_stderr,
                clean=end.is_clean,
                crash=end.is_crash,
                reports=tuple(
                    (each.node, each.message)
                    for each in (() if channel is None else channel.failures)
                ),
            )
        )
        await process.release()

    def signal(self, effect: messages.Signal) -> None:
        """Send a process a signal, or close its channel, by which a host of ours ends."""
        process = self._system.processes.get(effect.process)
        if process is None:
            return
        if self._system.run.ending is None and effect.process not in self._belonging:
            # What writes to it may end as soon as nobody reads a process's output any more.
            pids = {process.pid: process.name}
            self._belonging[effect.process] = set(self._means.fork_server.belonging(pids))
        if process.channel is not None:
            self._shell.start(process.channel.close())
        if effect.number:
            process.signal(effect.number)

    async def sweep(self, effect: messages.Sweep) -> None:
        """End what a process left."""
        system, fork_server = self._system, self._means.fork_server
        process = system.processes[effect.process]
        carried = system.carried_by(effect.process)
        known = self._belonging.pop(effect.process, set())
        if system.run.ending is None:
            left = await fork_server.end_left({process.pid: process.name}, known)
            if left:
                pids = ", ".join(map(str, left))
                text = f"ended what {process.name!r} left behind: {pids}"
                system.emit(Notice(message=text))
            for pid in {*left, *known}:
                if start_ticks(pid) is None:
                    self.forget(pid, carried)
        names = {each.name for each in system.nodes.values()}
        self._shell.again |= {node.name for node in carried}
        self._shell.give(
            messages.Swept(
                process=effect.process,
                reported={
                    each.name: {report.name: report.urls for report in each.connections}
                    for each in self._shell.looks.seen.configurations
                    if each.name not in names
                },
            )
        )

    def forget(self, pid: int, nodes: Iterable[NodeRun]) -> None:
        """Count what a process left in the graph no more: the kernel says that it has ended."""
        nodes = tuple(nodes)
        self._means.participant.discovery.ended(
            pid,
            nodes=[node.name for node in nodes],
            reported=[prefix for node in nodes for prefix in _reported(node)],
        )
        for node in nodes:
            self._means.participant.graph.drop_configuration(node.name)


def _reported(node: NodeRun) -> Iterable[str]:
    """Yield the GUID prefixes that a node said are its own."""
    configuration = node.configuration
    if configuration is None:
        return
    yield configuration.identity.node_id.rpartition("@")[2]
    for each in configuration.endpoints:
        yield each.gid[:PREFIX_DIGITS]
