"""What processes leave in the graph when they end: whose it was is said to the graph once."""

from __future__ import annotations

from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

from msgspec.structs import replace

from lifecycle.supervisor.control.protocol import ProcessState
from lifecycle.supervisor.health.process_monitor import EndedProcesses
from lifecycle.supervisor.run.events import ProcessChanged

PREFIX = "010f7f015d3c1b4c00000000"
ENDED = ProcessChanged(process="camera", state=ProcessState.EXITED, pid=7)


def test_only_a_process_of_the_system_that_has_ended_counts_no_more() -> None:
    ended: list[tuple[int, list[str], list[str]]] = []

    def take(pid: int, *, nodes: Iterable[str], reported: Iterable[str]) -> None:
        ended.append((pid, list(nodes), list(reported)))

    configuration = SimpleNamespace(
        identity=SimpleNamespace(node_id=f"/camera@{PREFIX}"), endpoints=()
    )
    camera = SimpleNamespace(name="/camera", configuration=configuration)
    process = SimpleNamespace(pid=7, planned=SimpleNamespace(nodes=("camera",)))
    system: Any = SimpleNamespace(nodes={"camera": camera}, processes={"camera": process})
    participant: Any = SimpleNamespace(discovery=SimpleNamespace(ended=take))
    processes = EndedProcesses(system, participant)
    for event in (
        replace(ENDED, state=ProcessState.RUNNING),
        replace(ENDED, pid=6),
        replace(ENDED, process="discovery_server"),
    ):
        processes.on_event(event)
    assert ended == []
    processes.on_event(ENDED)
    assert ended == [(7, ["/camera"], [PREFIX])]
