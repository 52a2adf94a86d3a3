"""Discovery and messages come by different ways: what the one shows must not undo the other."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from lifecycle.graph import (
    GraphEvents,
    GraphReporter,
    GraphState,
    InMemoryNetwork,
    ManualScheduler,
    every,
)
from lifecycle.graph.discovery import Discovery
from lifecycle.manifest.model import EndpointKind
from lifecycle.verify.observation import EndpointReport, Identity, NodeConfiguration

ITS_OWN = NodeConfiguration(
    identity=Identity(machine_id="m", process_id=1, node_id="/it"),
    name="/it",
    state="inactive",
    connected=True,
    rmw="rmw_fastrtps_cpp",
    transports=("udpv4",),
    serializations=("cdr",),
    paradigms=("publish-subscribe",),
    endpoints=(
        EndpointReport(
            kind=EndpointKind.PUBLISHER, name="out", resolved="/out", type="std_msgs/msg/String"
        ),
    ),
    checksum="1",
)


def test_a_node_that_reports_is_asked_although_its_services_are_not_shown_yet(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The graph shows /it, and nothing on it yet.
    filtering = "lifecycle.middleware.rcl.stale_node_filter"
    monkeypatch.setattr(f"{filtering}.node_names", lambda _: ["/it"])
    monkeypatch.setattr(f"{filtering}.endpoints_of", lambda *_, **__: [])
    monkeypatch.setattr("lifecycle.graph.discovery.endpoints_of_node", lambda *_: [])
    scheduler = ManualScheduler()
    network = InMemoryNetwork(scheduler)
    events = GraphEvents(network.transport(), scheduler)
    asker = SimpleNamespace(get_configuration=lambda _, done: done(ITS_OWN))
    discovery = Discovery(
        SimpleNamespace(),  # type: ignore[arg-type]
        events,
        asker,  # type: ignore[arg-type]
        reread=lambda _: None,
    )
    state = GraphState(events, discovery.fetch)
    scheduler.post(discovery.look)
    scheduler.advance(0.5)
    seen = state.node("/it")
    assert seen is not None
    assert (seen.incarnation, seen.endpoints) == ("", ())

    reporter = GraphReporter(network.transport(), "/it", every=every(scheduler), period_s=3600.0)
    reporter.joined("inactive", connected=True, checksum="1")
    scheduler.advance(0.5)
    told = state.node("/it")
    assert told is not None
    assert (told.incarnation, told.configuration) == (reporter.incarnation, ITS_OWN)
