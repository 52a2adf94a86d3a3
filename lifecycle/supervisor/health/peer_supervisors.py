"""Liveliness of the supervisors of other machines, and of attached nodes: found, lost, left.

Owns: announcing ourselves to other supervisors, noticing them and the attached nodes that announce
themselves, and what they report of silent nodes. Event driven. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine, Mapping
from typing import TYPE_CHECKING, Any

import msgspec

from lifecycle.errors import BringUpError
from lifecycle.manifest.model import RunKind
from lifecycle.node.host.control import Command, Operation
from lifecycle.supervisor.health.liveliness import Cause
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.processes.control_channel import ControlChannel
from lifecycle.supervisor.run.events import MachineConnection
from lifecycle.supervisor.run.failure import ended

if TYPE_CHECKING:
    from lifecycle.middleware.discovery.liveliness import AlivePublisher, AliveSubscription
    from lifecycle.supervisor.nodes.observer_participant import ObserverParticipant

SAID_AGAIN_S = (0.1, 0.3)
"""Fast DDS repeats what was lost after up to 3 s: too late for a silence."""


class Listener(msgspec.Struct, frozen=True, kw_only=True):
    """What an AliveSubscription calls, from any thread.

    Attributes:
        alive: with True when the peer is alive, with False when not any more.
        left: it left properly.
        silent: what it reports of silent nodes.
    """

    alive: Callable[[bool], None]
    left: Callable[[], None]
    silent: Callable[[Mapping[str, str]], None]


class _PeerSupervisor(msgspec.Struct):
    """One peer that should be alive.

    Attributes:
        what: for messages, "the supervisor of machine 'robot'".
        machine: empty for an attached node.
        nodes: fully qualified names of the nodes that are lost with it.
    """

    what: str
    machine: str
    nodes: tuple[str, ...]
    alive: bool = False
    lost_at_s: float | None = None


class PeerSupervisors:
    """Watches the peers that a system depends on; `open` it in a loop and `close` it."""

    def __init__(self, system: System, exchange: ObserverParticipant) -> None:
        self._system = system
        self._exchange = exchange
        self._loop = asyncio.get_running_loop()
        self._closed = False
        self._known: list[_PeerSupervisor] = []
        self._watches: list[AliveSubscription] = []
        self._attached: tuple[str, ...] = ()
        self._announcements: list[AlivePublisher] = []
        self._said: Mapping[str, str] = {}
        self._tasks: set[asyncio.Task[None]] = set()

    def open(self) -> None:
        """Begin to watch, and to announce ourselves where a peer may watch us."""
        plan = self._system.plan
        remote: dict[str, list[str]] = {}
        for each in self._system.remote.values():
            remote.setdefault(each.machine, []).append(each.full_name)
        for machine, nodes in remote.items():
            if machine:
                what = f"the supervisor of machine {machine!r}"
                listener = self._listener(_PeerSupervisor(what, machine, tuple(nodes)))
                self._watches.append(self._exchange.watch_machine(plan.system, machine, listener))
        self._attached = self._attached_nodes()
        for name in self._attached:
            listener = self._listener(_PeerSupervisor(repr(name), "", (name,)))
            self._watches.append(self._exchange.watch_node(name, listener))
        if remote:
            own = dict.fromkeys(node.planned.machine for node in self._system.nodes.values())
            self._announcements = [
                self._exchange.announce_machine(plan.system, each) for each in own if each
            ]
            self._system.liveliness.listen(self._tell)

    def renew(self) -> None:
        """Follow the attached nodes of the plan as it is now, where they are others."""
        if self._attached == self._attached_nodes():
            return
        self._destroy()
        for peer in self._known:
            # The return of one that is no longer planned is never reported.
            for cause in (Cause.LOST, Cause.REPORTED):
                self._system.liveliness.came_back(peer.nodes, cause)
        self._known.clear()
        self.open()

    def _attached_nodes(self) -> tuple[str, ...]:
        return tuple(
            node.name
            for node in self._system.nodes.values()
            if node.planned.run.kind is RunKind.ATTACH
        )

    @property
    def machines(self) -> frozenset[str]:
        """Machines whose supervisor is connected now."""
        return frozenset(each.machine for each in self._known if each.machine and each.alive)

    async def close(self) -> None:
        """Leave, and stop watching."""
        self._closed = True
        await ended(*self._tasks)
        self._destroy()

    def _destroy(self) -> None:
        for watch in self._watches:
            watch.destroy()
        for announcement in self._announcements:
            announcement.destroy()
        self._watches.clear()
        self._announcements.clear()

    def _listener(self, peer: _PeerSupervisor) -> Listener:
        self._known.append(peer)

        def soon(do: Callable[..., None]) -> Callable[..., None]:
            def in_loop(*arguments: object) -> None:
                # A receiver that was destroyed may have had a callback on its way.
                if any(each is peer for each in self._known):
                    do(peer, *arguments)

            def call(*arguments: object) -> None:
                with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
                    self._loop.call_soon_threadsafe(in_loop, *arguments)

            return call

        return Listener(alive=soon(self._alive), left=soon(self._left), silent=soon(self._silent))

    def _alive(self, peer: _PeerSupervisor, is_alive: bool) -> None:
        if self._closed or is_alive is peer.alive:
            return
        peer.alive = is_alive
        if is_alive:
            self._found(peer)
        else:
            self._lost(peer)

    def _lost(self, peer: _PeerSupervisor) -> None:
        peer.lost_at_s = self._loop.time()
        if peer.machine:
            self._system.emit(MachineConnection(machine=peer.machine, established=False))
        detail = f"{peer.what} is not heard any more"
        self._system.liveliness.fell_silent(peer.nodes, Cause.LOST, detail)
        self._exchange.send_again_soon()
        self._start(self._have_hosts(Operation.SEND_AGAIN_SOON))

    def _found(self, peer: _PeerSupervisor) -> None:
        lost_s = 0.0
        if peer.lost_at_s is not None:
            lost_s = self._loop.time() - peer.lost_at_s
            # DDS may have forgotten the node names of participants that it lost for long.
            self._exchange.republish_names()
            self._start(self._have_hosts(Operation.REPUBLISH_NAMES))
        peer.lost_at_s = None
        if peer.machine:
            self._system.emit(
                MachineConnection(machine=peer.machine, established=True, lost_s=lost_s)
            )
        self._system.liveliness.came_back(peer.nodes, Cause.LOST)

    def _left(self, peer: _PeerSupervisor) -> None:
        """It left properly, or DDS forgot it after it was lost."""
        if self._closed or not peer.alive:
            return
        peer.alive = False
        if peer.machine:
            self._system.emit(MachineConnection(machine=peer.machine, established=False, left=True))
        self._system.liveliness.came_back(peer.nodes, Cause.REPORTED)

    def _silent(self, peer: _PeerSupervisor, silent: Mapping[str, str]) -> None:
        if self._closed:
            return
        for name in peer.nodes:
            if name in silent:
                self._system.liveliness.fell_silent((name,), Cause.REPORTED, silent[name])
            else:
                self._system.liveliness.came_back((name,), Cause.REPORTED)

    def _tell(self) -> None:
        """Our own nodes fell silent or came back: say so."""
        liveliness = self._system.liveliness
        causes = (Cause.UNSERVED, Cause.HUNG, Cause.STOPPED)
        said = {name: why for cause in causes for name, why in liveliness.causes(cause).items()}
        if said != self._said and not self._closed:
            self._said = said
            self._start(self._say(said))

    async def _say(self, silent: Mapping[str, str]) -> None:
        for pause_s in (*SAID_AGAIN_S, None):
            if silent is not self._said:
                return
            for each in self._announcements:
                each.notify(silent)
            if pause_s is not None:
                await asyncio.sleep(pause_s)

    async def _have_hosts(self, operation: Operation) -> None:
        """Have our hosts do something with all of their process; one that hangs holds up none."""

        async def have(channel: ControlChannel, node: str) -> None:
            # One that ends meanwhile has nothing to do any more.
            with contextlib.suppress(BringUpError):
                await channel.request(Command(node=node, operation=operation))

        await asyncio.gather(
            *(
                have(each.channel, self._system.nodes[each.planned.nodes[0]].name)
                for each in self._system.processes.values()
                if each.channel is not None and not each.ended.done()
            )
        )

    def _start(self, doing: Coroutine[Any, Any, None]) -> None:
        task = asyncio.ensure_future(doing)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
