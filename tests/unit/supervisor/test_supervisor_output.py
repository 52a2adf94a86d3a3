"""What a run looks like: plain lines, JSON lines, the live table, status and flows."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace
from rich.console import Console

from lifecycle.cli.live_view import Live
from lifecycle.cli.up_output import JsonLines, Narrator, PlainLines, Timings
from lifecycle.cli.verbs.control import status_text
from lifecycle.cli.verbs.flows import render_flows, watched_flows
from lifecycle.errors import ExitCode
from lifecycle.manifest.model import Run, RunKind, UniqueHow
from lifecycle.measure.bounds import Kind
from lifecycle.measure.flows import FlowMeasurement, MeasuredBound
from lifecycle.network.nfe import (
    TransportProtocol,
    UniqueRequirement,
)
from lifecycle.node.host.control import Operation
from lifecycle.supervisor.control.protocol import NodeStatus, ProcessState, Reach, SystemStatus
from lifecycle.supervisor.control.status import system_status
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.run.events import (
    Emitter,
    Event,
    Failure,
    GateOpened,
    LogLine,
    NodeChanged,
    ProcessChanged,
    RequestSent,
    RunStarted,
    SystemReached,
    VerdictChanged,
    to_record,
)
from lifecycle.supervisor.run.options import UpResult
from lifecycle.verify.outcome import ConnectionReport, Outcome
from lifecycle.verify.report import to_json
from lifecycle.verify.verdict import FlowReport, Stage
from tests.builders import nfe, node, publisher
from tests.builders import planned as planned_of
from tests.unit.supervisor.fakes import verdict_of

EVENTS: tuple[Event, ...] = (
    ProcessChanged(process="camera", state=ProcessState.RUNNING, pid=7),
    RequestSent(node="/camera", operation=Operation.CONFIGURE),
    NodeChanged(node="/camera", reach=Reach.CONNECTED, state="inactive", connected=True),
    LogLine(process="camera", stream="stdout", line="shutter is open"),
    VerdictChanged(stage=Stage.CONNECTED, verdict=verdict_of(Outcome.OK)),
    GateOpened(outcome="ok", nodes=("/camera",)),
    SystemReached(reached="active", elapsed_s=1.25),
    Failure(
        rule="run.process-died",
        subject="/camera",
        message="cannot keep '/camera' running: pid 7 died: killed by SIGSEGV",
        process="camera",
        log="/log/camera.log",
    ),
)
RESULT = UpResult(exit_code=ExitCode.OK, verdict=verdict_of(Outcome.OK))
STATUS = SystemStatus(
    system="robot",
    domain_id=30,
    phase="active",
    verdict=Outcome.OK,
    supervisor=1,
    elapsed_s=1.5,
    nodes=(
        NodeStatus(
            node="/camera",
            process="camera",
            process_state=ProcessState.RUNNING,
            pid=7,
            managed=True,
            reach=Reach.ACTIVE,
            state="active",
            doing="",
            matched=1,
            endpoints=2,
            unique_flows=1,
            flows=3,
            findings=0,
        ),
    ),
)


def test_plain_lines_tell_a_person_what_happens() -> None:
    stream = io.StringIO()
    output = PlainLines(_Into(stream))
    for event in EVENTS:
        output(event)
    output.finish(RESULT)
    assert stream.getvalue() == (
        "process camera: running (pid 7)\n"
        "/camera: connected\n"
        "[camera] shutter is open\n"
        "connected: verdict ok\n"
        "gate open on verdict ok: activating 1 node\n"
        "system active after 1.25 s\n"
        "failed: /camera (run.process-died)\n"
        "verdict: ok\n"
    )


def _timed(until: str, *events: tuple[float, Event]) -> list[str]:
    """Return the lines about stages, of events that come at a time."""
    stream = io.StringIO()
    times = iter([at_s for at_s, _ in events])
    output = Timings(PlainLines(_Into(stream)), until=until, clock=lambda: next(times))
    for _, event in events:
        output(event)
    return [line for line in stream.getvalue().splitlines() if line.startswith(("stage", "system"))]


def _came(node: str, reach: Reach) -> NodeChanged:
    return NodeChanged(node=node, reach=reach)


_RUN = RunStarted(
    system="robot",
    domain_id=30,
    rmw="rmw_fastrtps_cpp",
    discovery_range="localhost",
    nodes=("/camera", "/arm"),
    processes=("camera", "arm"),
    log_directory="/log",
)


def test_a_stage_is_over_with_the_last_node_that_came_so_far() -> None:
    judged = VerdictChanged(stage=Stage.CONNECTED, verdict=verdict_of(Outcome.VIOLATED))
    lines = _timed(
        "active",
        (0.5, _RUN),
        (1.0, _came("/camera", Reach.STARTED)),
        (1.2, _came("/camera", Reach.CONNECTED)),
        (1.5, _came("/arm", Reach.STARTED)),
        (1.6, _came("/arm", Reach.CONFIGURED)),
        (1.7, judged),
        (2.0, _came("/arm", Reach.CONNECTED)),
        (2.0, SystemReached(reached="connected", elapsed_s=1.5)),
        (2.25, judged),
        (2.5, VerdictChanged(stage=Stage.CONNECTED, verdict=verdict_of(Outcome.OK))),
        (3.0, SystemReached(reached="verified", elapsed_s=2.5)),
        (3.25, _came("/arm", Reach.ACTIVE)),
        (3.5, _came("/camera", Reach.ACTIVE)),
        (4.0, SystemReached(reached="active", elapsed_s=3.5)),
    )
    assert lines == [
        "system connected after 1.50 s",
        "system verified after 2.50 s",
        "system active after 3.50 s",
        "stage supervisor    0.500 s  at   0.500 s",
        "stage processes     1.000 s  at   1.500 s  last /arm",
        "stage configured    0.100 s  at   1.600 s  last /arm",
        "stage connected     0.400 s  at   2.000 s  last /arm",
        "stage observed      0.250 s  at   2.250 s",
        "stage verified      0.750 s  at   3.000 s",
        "stage active        1.000 s  at   4.000 s  last /camera",
        "stage total         4.000 s  at   4.000 s",
    ]


def test_stages_are_events_of_their_own_in_json() -> None:
    stream = io.StringIO()
    times = iter((0.5, 1.0))
    output = Timings(JsonLines(_Into(stream)), until="connected", clock=lambda: next(times))
    output(_came("/camera", Reach.STARTED))
    output(SystemReached(reached="connected", elapsed_s=0.75))
    assert [json.loads(line) for line in stream.getvalue().splitlines()][2:] == [
        {
            "event": "stage",
            "stage": "processes",
            "took_s": 0.5,
            "elapsed_s": 0.5,
            "last": "/camera",
        },
        {"event": "stage", "stage": "connected", "took_s": 0.5, "elapsed_s": 1.0, "last": ""},
        {"event": "stage", "stage": "total", "took_s": 1.0, "elapsed_s": 1.0, "last": ""},
    ]


class _Into:
    """A sink that takes everything at once."""

    def __init__(self, stream: io.StringIO) -> None:
        self._stream = stream

    def put(self, text: str, *, kept: bool = True) -> None:
        self._stream.write(text)

    def close(self) -> None:
        """Nothing is left."""


def _said(*events: Event) -> list[str]:
    stream = io.StringIO()
    console = Console(file=stream, width=100, force_terminal=False)
    for output in (PlainLines(_Into(stream)), Live(console)):
        for event in events:
            output(event)
    lines = [each for each in stream.getvalue().splitlines() if each.startswith("[")]
    assert lines[: len(lines) // 2] == lines[len(lines) // 2 :]
    return lines[: len(lines) // 2]


def test_what_the_others_print_while_a_failed_run_is_rolled_back_does_not_bury_the_cause() -> None:
    def says(process: str, line: str) -> LogLine:
        return LogLine(process=process, stream="stderr", line=line)

    ends = [
        ProcessChanged(process=each, state=ProcessState.STOPPING) for each in ("camera", "viewer")
    ]
    after = (*ends, says("viewer", "Traceback"), says("camera", "shutter is stuck"))
    # The cause may be read from its pipe after the end was noticed.
    assert _said(EVENTS[-1], says("viewer", "hello"), *after) == [
        "[viewer] hello",
        "[camera] shutter is stuck",
    ]
    assert _said(*after) == ["[viewer] Traceback", "[camera] shutter is stuck"]


def test_an_event_writes_findings_as_every_report_does() -> None:
    unmatched = verdict_of(Outcome.VIOLATED, "graph.unmatched-link")
    pair = replace(unmatched.findings[0], ends=("/camera", "/viewer"))
    verdict = replace(unmatched, findings=(pair,))
    record = to_record(VerdictChanged(stage=Stage.ACTIVE, verdict=verdict))
    written = json.loads(json.dumps(record))["verdict"]["findings"]
    assert written == json.loads(to_json(verdict))["findings"]
    assert "ends" not in written[0]


def test_a_verdict_that_reads_as_the_last_one_did_is_not_told_again() -> None:
    stream = io.StringIO()
    output = PlainLines(_Into(stream))
    ok = VerdictChanged(stage=Stage.ACTIVE, verdict=RESULT.verdict)
    wrong = VerdictChanged(
        stage=Stage.ACTIVE,
        verdict=replace(RESULT.verdict, verdict=Outcome.VIOLATED),
    )
    for event in (ok, ok, EVENTS[0], ok, wrong, wrong, ok):
        output(event)
    assert stream.getvalue() == (
        "active: verdict ok\n"
        "process camera: running (pid 7)\n"
        "active: verdict violated\n"
        "active: verdict ok\n"
    )


def test_a_node_on_its_way_to_active_is_waited_for_and_one_that_leaves_it_violates() -> None:
    stream = io.StringIO()
    lines = PlainLines(_Into(stream))
    wrong = VerdictChanged(
        stage=Stage.ACTIVE, verdict=verdict_of(Outcome.VIOLATED, "state.wrong-state")
    )
    for event in (wrong, SystemReached(reached="active", elapsed_s=1.0), wrong):
        lines(event)
    assert stream.getvalue() == (
        "not active yet; wrong: /camera (state.wrong-state)\n"
        "system active after 1.00 s\n"
        "active: verdict violated; wrong: /camera (state.wrong-state)\n"
    )


def test_json_lines_are_one_object_each_and_the_last_is_the_verdict() -> None:
    stream = io.StringIO()
    output = JsonLines(_Into(stream))
    for event in EVENTS:
        output(event)
    output.finish(RESULT)
    lines = [json.loads(line) for line in stream.getvalue().splitlines()]
    kinds = ["process", "request", "node", "log", "verdict", "gate", "system", "failure"]
    assert [line.get("event") for line in lines] == [*kinds, None]
    assert lines[1] == {"event": "request", "node": "/camera", "operation": "configure"}
    assert lines[-1]["verdict"] == "ok"


def test_the_live_table_shows_each_node_and_scrolls_what_it_prints() -> None:
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=True, width=100, color_system=None)
    with Live(console) as live:
        live.watch(lambda: STATUS)
        for event in EVENTS:
            live(event)
        live.finish(RESULT)
    shown = stream.getvalue()
    assert "[camera] shutter is open" in shown
    assert "connecting ▸ verifying ▸ activating ▸ measuring ▸ active" in shown
    row = next(line for line in shown.splitlines() if line.strip().startswith("/camera "))
    assert row.split() == ["/camera", "running", "7", "active", "1/2", "1/3"]
    assert "verdict: ok" in shown


def test_the_last_verdict_is_shown_alone() -> None:
    stream = io.StringIO()
    with Live(Console(file=stream, force_terminal=True, width=100, color_system=None)) as live:
        live.watch(lambda: STATUS)
        live(VerdictChanged(stage=Stage.ACTIVE, verdict=verdict_of(Outcome.OK)))
        stream.seek(0)
        stream.truncate()
        live.finish(UpResult(exit_code=ExitCode.VIOLATED, verdict=verdict_of(Outcome.VIOLATED)))
    assert "verdict: violated" in stream.getvalue()
    assert "verdict ok" not in stream.getvalue()


def test_states_on_the_way_down_have_no_lines_and_those_that_others_cause_have() -> None:
    def changed(state: str, reach: Reach = Reach.ACTIVE) -> NodeChanged:
        return NodeChanged(node="/camera", reach=reach, state=state, connected=True)

    down = (changed("deactivating"), changed("inactive"), changed("cleaningup"))
    asked = RequestSent(node="/camera", operation=Operation.DEACTIVATE)
    narrator = Narrator()
    events = (changed("active"), *down, asked, *down, changed("finalized", Reach.STOPPED))
    assert [line for event in events if (line := narrator.line(event))] == [
        "/camera: active",
        "/camera: active, but inactive",
        "/camera: stopped",
    ]


@pytest.mark.parametrize("count", [3, 60])
def test_the_live_table_fits_the_terminal(count: int) -> None:
    (node,) = STATUS.nodes
    nodes = [msgspec.structs.replace(node, node=f"/{'n' * 90}_{number}") for number in range(count)]
    nodes[-1] = msgspec.structs.replace(node, node="/late", state="inactive")
    status = msgspec.structs.replace(STATUS, nodes=tuple(nodes))
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=True, width=80, height=24, color_system=None)
    with Live(console) as live:
        live.watch(lambda: status)
    rows = [re.sub(r"\x1b\[[?\d]*[a-zA-Z]", "", row) for row in stream.getvalue().split("\n")]
    assert len(rows) <= 24 * 2  # drawn twice: at the start and in the end
    assert max(map(len, rows)) <= 81
    late = next(row for row in rows if row.strip().startswith("/late "))
    assert late.split()[1:] == ["running", "7", "inactive", "·", "connected", "1/2", "1/3"]
    more = [row for row in rows if "more nodes: lifecycle status robot --watch" in row]
    assert bool(more) == (count > 24)


CONNECTIONS = (
    ConnectionReport(
        name="net",
        urls=("udpv4://10.77.0.1:7911",),
        established=True,
        mappings=("publishers/video",),
    ),
    ConnectionReport(name="far", urls=("tcpv4://10.77.0.1:5100",), error="no route"),
    ConnectionReport(name="idle", urls=("shm://",)),
)


def test_a_status_is_a_head_a_line_for_each_node_and_its_connections_below_it() -> None:
    dead = msgspec.structs.replace(
        STATUS.nodes[0],
        node="/arm",
        process_state=ProcessState.EXITED,
        state="",
        matched=0,
        died="pid 7 died: killed by SIGKILL",
    )
    connected = msgspec.structs.replace(STATUS.nodes[0], connections=CONNECTIONS)
    assert status_text(msgspec.structs.replace(STATUS, nodes=(dead, connected))) == (
        "robot: active 1/2, verdict ok, domain 30, supervisor 1, up for 1.5 s\n"
        "node     process  pid  state   matched  unique flows\n"
        "/arm     exited   7    dead    0/2      1/3           pid 7 died: killed by SIGKILL\n"
        "/camera  running  7    active  1/2      1/3\n"
        "  connection net established; udpv4://10.77.0.1:7911; carries publishers/video\n"
        "  connection far failed: no route; tcpv4://10.77.0.1:5100; carries nothing\n"
        "  connection idle waits for peers; shm://; carries nothing"
    )


@pytest.mark.parametrize("is_measured", [False, True])
def test_what_was_measured_is_one_line_of_a_status_and_of_the_live_table(is_measured: bool) -> None:
    bound = MeasuredBound(
        name="max_delay_ms", kind=Kind.DELAY, outcome="violated", text="delay p99 7.2 ms > 5 ms"
    )
    flow = FlowMeasurement(
        topic="/video",
        publisher="/camera",
        subscription="/viewer",
        messages=74,
        lost=0,
        rate_hz=14.8,
        bounds=(bound,),
    )
    status = replace(STATUS, measured=(flow,) if is_measured else ())
    line = "measured: 1 flow violated: /video /camera → /viewer: delay p99 7.2 ms > 5 ms"
    assert status_text(status).splitlines()[1:][:is_measured] == [line] * is_measured
    assert ("measured" in status_text(status)) == is_measured
    console = Console(file=io.StringIO(), force_terminal=True, width=100, color_system=None)
    with Live(console) as live:
        live.watch(lambda: status)
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert (line in shown, "measured:" in shown) == (is_measured, is_measured)


def test_matches_that_nobody_reports_are_not_shown_as_none() -> None:
    (node,) = STATUS.nodes
    unknown = msgspec.structs.replace(node, matched=0, unreported=2)
    known = msgspec.structs.replace(node, matched=0, unreported=1)
    for each, cell in ((unknown, "–/2"), (known, "0/2"), (node, "1/2")):
        text = status_text(msgspec.structs.replace(STATUS, nodes=(each,)))
        assert text.splitlines()[2].split()[4] == cell


FLOW = FlowReport(
    topic="/video",
    publisher="/camera",
    subscription="/viewer",
    source=(nfe("10.0.0.1", 40000),),
    destination=(nfe("10.0.0.1", 7000), nfe("10.0.0.1", 7000, TransportProtocol.UNKNOWN)),
    unique=UniqueHow.STRONGLY,
    dscp=46,
    requirement=(UniqueRequirement.STRICTLY_REQUIRED, UniqueRequirement.NOT_REQUIRED),
    demanded=UniqueHow.WEAKLY,
    transport="shm or udp",
    outcome=Outcome.OK,
    five_qi=85,
    five_qi_reason="the least demanding class",
    effective_transport="shm",
)


def test_a_status_and_flows_fit_a_terminal_and_say_what_is_wrong_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("lifecycle.cli.verbs.flows.terminal_width", lambda: 80)
    why = "wrong: " + ", ".join(f"/robot/topic_{number} (qos.incompatible)" for number in range(9))
    told = status_text(replace(STATUS, not_ok=why), width=80).splitlines()
    verdict = replace(
        verdict_of(Outcome.VIOLATED), flows=(FLOW, replace(FLOW, outcome=Outcome.VIOLATED))
    )
    flows = watched_flows(verdict, "text").splitlines()
    assert max(map(len, (*told, *flows))) <= 80
    assert "/robot/topic_8 (qos.incompatible)" in " ".join(told)
    assert [line.split()[0] for line in flows[-2:]] == ["violated", "ok"]


def test_a_flow_shows_its_tuple_dscp_and_tos_requirement_and_verdict() -> None:
    head, row = render_flows([FLOW], "text").splitlines()
    assert " ".join(head.split()) == (
        "topic publisher subscription rate_hz p50_ms p99_ms lost source destination protocol "
        "flow_label dscp 5qi unique required demanded transport verdict"
    )
    assert row.split()[-2:] == ["shm", "ok"]  # what carries it, not what could
    for cell in (
        "85 (auto)",
        "10.0.0.1:40000",
        "10.0.0.1:7000 ",
        "udp",
        "46",
        "184",
        "strongly",
        "weakly",
    ):
        assert cell in row
    marked = replace(FLOW, reader_dscp=48)
    _, row = render_flows([marked], "text").splitlines()
    assert "EF = DSCP 46 = TOS 184 (0xb8); back CS6 = DSCP 48 = TOS 192 (0xc0)" in row
    assert render_flows([], "text") == "no flow"
    csv_head, csv_row = render_flows([FLOW], "csv").splitlines()
    cells = dict(zip(csv_head.split(","), csv_row.split(","), strict=True))
    assert (cells["dscp"], cells["dscp_name"], cells["tos"]) == ("46", "EF", "184")
    assert (cells["five_qi"], cells["effective_transport"]) == ("85", "shm")
    (shown,) = json.loads(render_flows([FLOW], "json"))
    assert (shown["topic"], shown["measured"]) == ("/video", None)


async def test_a_command_is_shown_as_it_was_judged_and_matches_where_its_flows_are_ok(
    tmp_path: Path,
) -> None:
    plan = planned_of(node("camera", publisher("/video"), publisher("/audio")))
    system = System(plan, emit=Emitter(), logs=tmp_path, processes=plan.processes)
    command = system.nodes["camera"]
    command.state = "active"
    hosted = command.planned
    command.core.planned = replace(hosted, run=Run(kind=RunKind.COMMAND))
    wrong = replace(
        verdict_of(Outcome.VIOLATED, "state.wrong-state").findings[0],
        node="/camera",
        observed="inactive",
    )
    verdict = replace(verdict_of(Outcome.OK), findings=(wrong,), flows=(FLOW,))
    system.run.judged.verdict = verdict
    (shown,) = system_status(system).nodes
    assert (shown.state, shown.matched, shown.unreported, shown.endpoints) == ("inactive", 1, 1, 2)
    command.core.planned = hosted
    (shown,) = system_status(system).nodes
    assert shown.state == "active"
