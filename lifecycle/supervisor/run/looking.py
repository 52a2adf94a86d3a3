"""Pictures of a system that runs: through its supervisor, or from outside where it has none.

Owns: where the observation of a picture comes from and when the next picture is due. What is drawn
is export's. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from lifecycle.export.picture import Picture, Supervised, build_picture
from lifecycle.plan.model import Plan
from lifecycle.run_directory import is_held, run_name, runtime_root
from lifecycle.supervisor.control.client import look
from lifecycle.supervisor.control.server import Look, follow
from lifecycle.supervisor.control.status import SystemStatus
from lifecycle.supervisor.processes.states import ProcessState
from lifecycle.supervisor.run.attach import Seen, following, judge_running
from lifecycle.supervisor.run.events import Reach
from lifecycle.verify import Stage, verify


def supervisor_of(environment: Mapping[str, str], plan: Plan, machine: str) -> Path | None:
    """Return the run directory of the supervisor of a plan on this host; None without one."""
    path = runtime_root(environment) / run_name(plan, machine)
    return path if is_held(path) else None


def supervised_picture(path: Path) -> Picture:
    """Return what the supervisor of a run directory sees.

    Raises:
        UsageError: it runs no more.
        TimeoutError: it does not answer.
    """
    return _drawn(look(path))


def supervised_pictures(path: Path) -> Iterator[Picture]:
    """Yield what a supervisor sees, again whenever it differs, until the supervisor ends.

    Raises:
        OSError: nobody listens there.
    """
    last: Picture | None = None
    for seen in follow(path / "control"):
        picture = _drawn(seen)
        if picture != last:
            last = picture
            yield picture


def attached_picture(plan: Plan, *, timeout_s: float) -> Picture:
    """Look from outside, and give what is not as declared so long to become so.

    Raises:
        MiddlewareError: no participant can be made.
    """
    seen = judge_running(plan, timeout_s=timeout_s, strict=False)
    return build_picture(seen.plan, seen.observation, seen.verdict)


def attached_pictures(plan: Plan, on_picture: Callable[[Picture], None]) -> None:
    """Look from outside and hand over each picture that differs from the last, for ever."""
    last: Picture | None = None

    def take(seen: Seen) -> None:
        nonlocal last
        picture = build_picture(seen.plan, seen.observation, seen.verdict)
        if picture != last:
            last = picture
            on_picture(picture)

    asyncio.run(following(plan, take))


def _drawn(seen: Look) -> Picture:
    verdict = seen.verdict or verify(seen.plan, seen.observation, stage=Stage.ACTIVE)
    return build_picture(
        seen.plan,
        seen.observation,
        verdict,
        phase=seen.status.phase,
        supervised=_supervised(seen.status),
    )


def _supervised(status: SystemStatus) -> dict[str, Supervised]:
    return {
        each.node: Supervised(
            pid=each.pid,
            dead=each.process_state is ProcessState.EXITED and each.reach is not Reach.STOPPED,
            silent=bool(each.silent),
            doing=each.doing or each.silent,
        )
        for each in status.nodes
    }
