"""Run one node in a terminal, without a supervisor: with a manifest's part of a plan, or without.

Owns: what happens between the shell and the node: rclpy.init with the command line's --ros-args,
the drive up in auto mode, one printed line per change of state, and the way out.
"""

from __future__ import annotations

import contextlib
import functools
import signal
import sys
import traceback
from collections.abc import Callable
from typing import NoReturn

import rclpy
from rclpy.signals import SignalHandlerOptions

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import Timeouts
from lifecycle.middleware import ParticipantSettings, participant_settings
from lifecycle.node.author.node import LifecycleNode
from lifecycle.node.author.spec import Construction, Mode, constructing, parse_mode
from lifecycle.node.host.loop import NodeLoop, on_signal
from lifecycle.node.lifecycle.machine import Outcome
from lifecycle.node.reporting.heard import Heard
from lifecycle.plan.model import PlannedNode


def run(
    node_class: type[LifecycleNode],
    *,
    lifecycle: str | None = None,
    spec: PlannedNode | None = None,
    domain_id: int | None = None,
    arguments: list[str] | None = None,
    say: Callable[[str], None] | None = None,
    interrupted: ExitCode = ExitCode.OK,
) -> NoReturn:
    """Run a node until Ctrl-C or SIGTERM, shut it down, and end the process; never returns.

    Example:
        >>> if __name__ == "__main__":
        ...     lifecycle.run(Talker, lifecycle="auto")

    Args:
        node_class: constructed without arguments.
        lifecycle: "auto" brings the node up, "manual" leaves that to others; None leaves it to
            what the class's constructor says.
        spec: the node's part of a plan; None for a node that declares its endpoints in code.
        domain_id: 0–232; None takes ROS_DOMAIN_ID, else 0.
        arguments: command line with --ros-args; None takes the process's own.
        say: told each step; None prints to standard output.
        interrupted: exit code after Ctrl-C; OK as for other ROS nodes, since launch calls a node
            that exits otherwise died.

    Exit codes: 0 after SIGTERM, `interrupted` after Ctrl-C, 1 when a callback raised an exception,
    6 when the node could not be brought up.
    """
    tell = functools.partial(_tell, say or _print)
    mode = parse_mode(lifecycle) if lifecycle is not None else None
    rclpy.init(
        args=sys.argv if arguments is None else arguments,
        domain_id=domain_id,
        signal_handler_options=SignalHandlerOptions.NO,
    )
    context = rclpy.get_default_context()
    heard = Heard((spec.timeouts if spec is not None else Timeouts()).silent_s)
    loop = NodeLoop(context, heard.watchdog)
    with on_signal(lambda number: _on_signal(number, loop, tell, interrupted)):
        construction = Construction(
            spec=spec, mode=mode, context=context, use_global_arguments=True
        )
        with constructing(construction), participant_settings(context, _settings(spec)):
            node = node_class()
        loop.add(node)
        heard.open(node, loop.tell_names)
        node.lifecycle.add_listener(lambda each: tell(f"{_name(each)}: {_state(each)}"))
        tell(f"{_name(node)}: {_state(node)}")
        if node.lifecycle.mode is Mode.AUTO:
            loop.call_soon(_bring_up, node, loop, tell)
        loop.spin_and_exit()
    raise AssertionError("spin_and_exit returned")


async def _bring_up(node: LifecycleNode, loop: NodeLoop, tell: Callable[[str], None]) -> None:
    try:
        result = await node.lifecycle.bring_up()
    except Exception as error:  # noqa: BLE001 - shown, then the process ends
        traceback.print_exc()
        tell(f"cannot bring up {_name(node)}: {error}")
    else:
        if result.outcome is Outcome.SUCCESS:
            return
        tell(f"cannot bring up {_name(node)}: {result.error}")
    loop.stop("a failed bring-up", code=ExitCode.BRING_UP_FAILED)


def _on_signal(
    number: signal.Signals, loop: NodeLoop, tell: Callable[[str], None], interrupted: ExitCode
) -> None:
    tell(f"{number.name}: shutting down")
    loop.stop(number.name, code=interrupted if number is signal.SIGINT else ExitCode.OK)


def _settings(spec: PlannedNode | None) -> ParticipantSettings:
    if spec is None:
        return ParticipantSettings()
    return ParticipantSettings.of(
        spec.connections,
        transports=spec.transports,
        max_datagram_bytes=spec.max_datagram_bytes,
    )


def _name(node: LifecycleNode) -> str:
    return node.lifecycle.full_name


def _state(node: LifecycleNode) -> str:
    return node.lifecycle.state.value


def _tell(say: Callable[[str], None], line: str) -> None:
    """Say `line` if anybody still listens: a closed pipe does not end a node."""
    with contextlib.suppress(BrokenPipeError):
        say(line)


def _print(line: str) -> None:
    print(line, flush=True)
