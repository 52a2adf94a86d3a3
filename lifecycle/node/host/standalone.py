"""Run one node in a terminal, with a manifest's part of a plan, or without; no supervisor."""

from __future__ import annotations

import contextlib
import signal
import sys
import traceback
from collections.abc import Callable
from typing import Any, NoReturn

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import Run, RunKind
from lifecycle.middleware.fastdds.factory import initialised
from lifecycle.middleware.fastdds.profiles import ParticipantSettings
from lifecycle.node.callbacks import CallbackOutcome
from lifecycle.node.host.adoption import Adoption, Hosted
from lifecycle.node.host.loop import NodeLoop, on_signal
from lifecycle.node.managed import Managed
from lifecycle.node.planned import is_auto
from lifecycle.plan.model import PlannedNode


def report(line: str) -> None:
    """Print a line if it is still read: a closed pipe does not end a node."""
    with contextlib.suppress(BrokenPipeError):
        print(line, flush=True)


def run(
    node_class: Callable[..., Any],
    *,
    lifecycle: str | None = None,
    spec: PlannedNode | None = None,
    domain_id: int | None = None,
    arguments: list[str] | None = None,
    say: Callable[[str], None] = report,
    interrupted: ExitCode = ExitCode.OK,
) -> NoReturn:
    """Run a node until Ctrl-C or SIGTERM, shut it down, and end the process; never returns.

    Example:
        >>> if __name__ == "__main__":
        ...     lifecycle.run(Talker, lifecycle="auto")

    Args:
        node_class: of a LifecycleNode, constructed with what `spec` gives it. With a `spec` any
            class of rclpy nodes will do, or a function that returns one.
        lifecycle: "auto" brings the node up, "manual" leaves that to others; None leaves it to
            what the class's constructor says.
        spec: the node's part of a plan; None for a node that declares its endpoints in code.
        domain_id: 0–232; None takes ROS_DOMAIN_ID, else 0.
        arguments: command line with --ros-args; None takes the process's own.
        say: called with each step; it prints to standard output.
        interrupted: exit code after Ctrl-C; of another than 0 launch says that the node died.

    Exit codes: 0 after SIGTERM, `interrupted` after Ctrl-C, 1 when a callback raised an exception,
    6 when the node could not be brought up.
    """
    auto = lifecycle is not None and is_auto(lifecycle)
    settings = ParticipantSettings() if spec is None else ParticipantSettings.of(spec)
    context = initialised(settings, domain_id, args=sys.argv if arguments is None else arguments)
    planned = Run(kind=RunKind.PYTHON) if spec is None else spec.run
    loop = NodeLoop(context, executor=planned.executor, threads=planned.threads)

    def end(number: signal.Signals) -> None:
        say(f"{number.name}: shutting down")
        loop.stop(number.name, code=interrupted if number is signal.SIGINT else ExitCode.OK)

    with on_signal(end, {}):
        adoption = Adoption(context, loop, use_global_arguments=True)
        hosted: Hosted
        if spec is None:
            hosted = adoption.make_unplanned(node_class)
        else:
            (hosted,) = adoption.make(spec, [spec], node_class)
        name = hosted.full_name
        loop.add(hosted)
        said = ""

        def say_state(_: object) -> None:
            nonlocal said
            if said != (state := _state(hosted)):
                said = state
                say(f"{name}: {state}")

        hosted.listeners.append(say_state)
        say_state(hosted)
        if lifecycle is None:
            auto = isinstance(hosted, Managed) and hosted.auto
        if auto and hosted.spec.managed:
            loop.call_soon(_bring_up, hosted, loop, say)
        loop.spin_and_exit()
    raise AssertionError("spin_and_exit returned")


async def _bring_up(hosted: Hosted, loop: NodeLoop, say: Callable[[str], None]) -> None:
    name = hosted.full_name
    try:
        result = await hosted.bring_up()
    except Exception as error:  # noqa: BLE001 - shown, then the process ends
        traceback.print_exc()
        say(f"cannot bring up {name}: {error}")
    else:
        if result.outcome is CallbackOutcome.SUCCESS:
            return
        say(f"cannot bring up {name}: {result.error}")
    loop.stop("a failed bring-up", code=ExitCode.BRING_UP_FAILED)


def _state(hosted: Hosted) -> str:
    if isinstance(hosted, Managed):
        return hosted.state.value
    return hosted.reported.label or "running"
