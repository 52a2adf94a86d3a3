"""Run one node in a terminal, without a supervisor: with a manifest's part of a plan, or without.

A supervisor that attaches to it learns by DDS that its process runs, and from a thread of it that
its executor hangs, unless a callback holds the lock of the interpreter.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
import traceback
import typing
from collections.abc import Callable
from typing import Any, NoReturn

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import Run, RunKind, Timeouts
from lifecycle.manifest.names import node_alive_topic
from lifecycle.middleware.fastdds.profiles import ParticipantSettings
from lifecycle.middleware.process.busy_sign import BusySign, Overdue, brief
from lifecycle.middleware.services.supervisor_topics import AliveNotice, AlivePublisher
from lifecycle.node.callbacks import CallbackOutcome
from lifecycle.node.host.adoption import Adoption, Hosted, initialised
from lifecycle.node.host.loop import NodeLoop, on_signal
from lifecycle.node.managed import Managed
from lifecycle.node.planned import is_auto
from lifecycle.plan.model import PlannedNode

_REPEATED_AFTER_S = (0.1, 0.3)
"""Fast DDS repeats what was lost after up to 3 s: too late for a silence."""


@typing.final
class OwnLiveliness:
    """The liveliness of one process without a supervisor; its sign is for what spins the node."""

    def __init__(self, limit_s: float) -> None:
        self.sign = BusySign.make(limit_s)
        self.sign.show_stacks()
        self._lock = threading.Lock()
        self._silent: dict[str, str] = {}
        self._publisher: AlivePublisher | None = None
        self._name = ""

    def open(self, hosted: Managed, republish_names: Callable[[], None]) -> None:
        """Assert its liveliness from now on; a subscriber that is matched may have lost names."""
        self._name = hosted.full_name
        self._publisher = AlivePublisher(
            hosted.node, node_alive_topic(self._name), on_listener=republish_names
        )
        threading.Thread(target=self._watch, name="watchdog", daemon=True).start()

    def _watch(self) -> None:
        while True:
            why, again_s = self.sign.look()
            if why is Overdue.HANGS:
                what = f" {self.sign.what}" if self.sign.what else ""
                where = brief(self.sign.where(os.getpid()))
                self.announce(
                    f"a callback{what} in its process (pid {os.getpid()}) has been running for "
                    f"more than {self.sign.limit_s:g} s{where and f', in {where}'}"
                )
            elif why is Overdue.UNSERVED:
                self.announce(
                    f"its process (pid {os.getpid()}) gets no processor for its callback: the "
                    "machine is overloaded"
                )
            time.sleep(again_s)

    def announce(self, why: str) -> None:
        """Say why it is silent, or that it is not any more."""
        silent = self._silent = {self._name: why} if why else {}

        def publish() -> None:
            with self._lock:
                # Only what still holds is said again.
                if silent is self._silent and self._publisher is not None:
                    self._publisher.notify(AliveNotice(silent=silent))

        publish()
        for after_s in _REPEATED_AFTER_S:
            timer = threading.Timer(after_s, publish)
            timer.daemon = True
            timer.start()


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
    limit_s = (spec.timeouts if spec is not None else Timeouts()).silent_s
    liveliness = OwnLiveliness(limit_s)
    loop = NodeLoop(
        context,
        liveliness.sign,
        lambda _: liveliness.announce(""),
        executor=planned.executor,
        threads=planned.threads,
    )

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
        if isinstance(hosted, Managed):
            liveliness.open(hosted, loop.republish_names)
        hosted.listeners.append(lambda _: say(f"{name}: {_state(hosted)}"))
        say(f"{name}: {_state(hosted)}")
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
