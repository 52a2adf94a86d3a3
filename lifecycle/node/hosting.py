"""The nodes of one process and the supervisor that is told of them and commands them.

Owns: the order of a host's life: construct every node, say "ready", obey, and at end of file shut
down and leave; and what is told unasked. It holds no state of its nodes.
"""

from __future__ import annotations

import logging
import threading
from typing import NoReturn

from rclpy.context import Context
from rclpy.node import Node

from lifecycle import codec
from lifecycle.middleware.busy_sign import BusySign
from lifecycle.middleware.retransmission import send_again_soon
from lifecycle.node.constructing import Participants, construct
from lifecycle.node.control import Command, Event, HostSpec, Operation
from lifecycle.node.host_channel import HostChannel, give_up
from lifecycle.node.host_commands import HostCommands
from lifecycle.node.loop import NodeLoop, on_signal
from lifecycle.node.node import LifecycleNode
from lifecycle.node.watchdog import Watchdog
from lifecycle.plan.model import PlannedNode
from lifecycle.verify.observation import NodeConfiguration


class Host:
    """The nodes of one process and the commands to them."""

    def __init__(self, spec: HostSpec, context: Context, channel: HostChannel) -> None:
        self._spec = spec
        self._context = context
        self._channel = channel
        watchdog = None
        if channel.descriptors:
            sign = BusySign(*channel.descriptors)
            watchdog = Watchdog(sign, lambda _: channel.write(Event(kind="beat")))
        self._loop = NodeLoop(context, watchdog)
        self._nodes: dict[str, LifecycleNode] = {}
        self._commands = HostCommands(
            self._nodes,
            {
                Operation.SEND_AGAIN_SOON: send_again_soon,
                Operation.TELL_NAMES: self._loop.tell_names,
            },
        )

    def run(self) -> NoReturn:
        """Construct, say ready, obey; never returns."""
        # Both before any constructor of the user's: whatever it does, the process can be ended.
        threading.Thread(target=self._obey, name="control", daemon=True).start()
        with on_signal(lambda number: self._loop.stop(number.name, code=0)):
            participants = Participants(self._context)
            for planned in self._spec.nodes:
                try:
                    with participants.carrying(planned) as context:
                        node = construct(planned, context, alone=len(self._spec.nodes) == 1)
                except Exception as error:  # noqa: BLE001 - told to the supervisor
                    give_up(self._channel, planned.full_name, error)
                self._add(planned, node)
            self._loop.call_soon(self._ready)
            self._loop.spin_and_exit()
        raise AssertionError("spin_and_exit returned")

    def _add(self, planned: PlannedNode, node: Node) -> None:
        if isinstance(node, LifecycleNode):
            self._nodes[planned.full_name] = node
            node.lifecycle.add_listener(self._tell_state)
            node.lifecycle.configuration_changes.listen(self._tell_configuration)
        self._loop.add(node)

    async def _ready(self) -> None:
        self._channel.write(Event(kind="ready"))

    def _tell_state(self, node: LifecycleNode) -> None:
        state = node.lifecycle.state
        self._channel.write(
            Event(
                kind="state",
                node=node.lifecycle.full_name,
                state=state.seen.label,
                connected=state.connected,
            )
        )

    def _tell_configuration(self, configuration: NodeConfiguration) -> None:
        self._channel.write(
            Event(
                kind="configuration",
                node=configuration.name,
                state=configuration.state,
                connected=configuration.connected,
                configuration=configuration,
            )
        )

    def _obey(self) -> None:
        """Read commands until the supervisor ends the channel; runs in its own thread."""
        while (line := self._channel.read()) is not None:
            try:
                command = codec.from_json(line, Command)
            except ValueError:
                # Both ends are ours: this is a bug, and the log is where it can be found.
                logging.getLogger(__name__).exception("cannot read command %r", line)
                continue
            self._loop.call_soon(self._execute, command)
        self._loop.stop("end of the control channel", code=0)

    async def _execute(self, command: Command) -> None:
        self._channel.write(await self._commands.execute(command))
