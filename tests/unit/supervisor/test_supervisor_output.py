"""What a run looks like: plain lines, JSON lines, a terminal, status and flows."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.cli.flow_tables import render_flows, watched_flows
from lifecycle.cli.up_output import JsonLines, Narrator, PlainLines, TerminalLines
from lifecycle.cli.verbs.control import status_text
from lifecycle.errors import ExitCode
from lifecycle.manifest.model import Run, RunKind, UniqueHow
from lifecycle.network.nfe import TransportProtocol, UniqueRequirement
from lifecycle.node.host.control import Operation
from lifecycle.supervisor.control.protocol import NodeStatus, ProcessState, Reach, SystemStatus
from lifecycle.supervisor.control.status import system_status
from lifecycle.supervisor.run.events import (
    Event,
    Failure,
    GateOpened,
    LogLine,
    NodeChanged,
    ProcessChanged,
    RequestSent,
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
from tests.unit.supervisor.fakes import World, verdict_of

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
NODE = NodeStatus(
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
)
STATUS = SystemStatus(
    system="robot",
    domain_id=30,
    phase="active",
    verdict=Outcome.OK,
    supervisor=1,
    elapsed_s=1.5,
    nodes=(NODE,),
)
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
    outcome=Outcome.OK,
    five_qi=85,
    five_qi_reason="the least demanding class",
    effective_transport="shm",
)


class Into(io.StringIO):
    """A sink that takes everything at once."""

    is_behind = False

    def put(self, text: str, *, kept: bool = True) -> None:
        self.write(text)

    def close(self) -> None:
        """What was written can still be read."""

    @property
    def lines(self) -> list[str]:
        return self.getvalue().splitlines()


def written(
    kind: type[PlainLines | JsonLines], *events: Event, finish: UpResult | None = None
) -> list[str]:
    """Return the lines about events."""
    into = Into()
    output = kind(into)
    for each in events:
        output(each)
    if finish is not None:
        output.finish(finish)
    return into.lines


async def on_terminal(
    *events: Event, status: SystemStatus = STATUS, finish: UpResult | None = None
) -> list[str]:
    """Return what a terminal shows in the end, line for line."""
    into = Into()
    output = TerminalLines(into)
    output.watch(lambda: status)
    for each in events:
        output(each)
    if finish is not None:
        output.finish(finish)
    text = re.sub(r"\x1b\[\d*m", "", into.getvalue())
    return [row.rpartition("\x1b[K")[2].strip("\r") for row in text.split("\n")]


# Lines


def test_lines_are_what_happens_for_people_and_one_object_each_for_programs() -> None:
    assert written(PlainLines, *EVENTS, finish=RESULT) == [
        "process camera: running (pid 7)",
        "/camera: connected",
        "[camera] shutter is open",
        "connected: verdict ok",
        "gate open on verdict ok: activating 1 node",
        "system active after 1.25 s",
        "failed: /camera (run.process-died)",
        "verdict: ok",
    ]
    lines = [*map(json.loads, written(JsonLines, *EVENTS, finish=RESULT))]
    kinds = ["process", "request", "node", "log", "verdict", "gate", "system", "failure"]
    assert [line.get("event") for line in lines] == [*kinds, None]
    assert lines[1] == {"event": "request", "node": "/camera", "operation": "configure"}
    assert lines[-1]["verdict"] == "ok"


def test_what_the_others_print_while_a_failed_run_is_rolled_back_does_not_bury_the_cause() -> None:
    def says(process: str, line: str) -> LogLine:
        return LogLine(process=process, stream="stderr", line=line)

    def said(*events: Event) -> list[str]:
        return [each for each in written(PlainLines, *events) if each.startswith("[")]

    ends = [
        ProcessChanged(process=each, state=ProcessState.STOPPING) for each in ("camera", "viewer")
    ]
    after = (*ends, says("viewer", "Traceback"), says("camera", "shutter is stuck"))
    # The cause may be read from its pipe after the end was noticed.
    assert said(EVENTS[-1], says("viewer", "hello"), *after) == [
        "[viewer] hello",
        "[camera] shutter is stuck",
    ]
    assert said(*after) == ["[viewer] Traceback", "[camera] shutter is stuck"]


def test_an_event_writes_findings_as_every_report_does() -> None:
    unmatched = verdict_of(Outcome.VIOLATED, "graph.unmatched-link")
    pair = replace(unmatched.findings[0], ends=("/camera", "/viewer"))
    verdict = replace(unmatched, findings=(pair,))
    record = to_record(VerdictChanged(stage=Stage.ACTIVE, verdict=verdict))
    written = json.loads(json.dumps(record))["verdict"]["findings"]
    assert written == json.loads(to_json(verdict))["findings"]


def test_a_verdict_is_said_once_and_before_active_as_what_is_still_wrong() -> None:
    ok = VerdictChanged(stage=Stage.ACTIVE, verdict=RESULT.verdict)
    wrong = replace(ok, verdict=verdict_of(Outcome.VIOLATED, "state.wrong-state"))
    active = SystemReached(reached="active", elapsed_s=1.0)
    assert written(PlainLines, wrong, active, ok, ok, EVENTS[0], ok, wrong, wrong, ok) == [
        "not active yet; /camera (state.wrong-state)",
        "system active after 1.00 s",
        "active: verdict ok",
        "process camera: running (pid 7)",
        "active: verdict violated; /camera (state.wrong-state)",
        "active: verdict ok",
    ]


def test_what_is_missing_is_said_once_while_it_becomes_less() -> None:
    rules = ("graph.missing-node", "graph.missing-endpoint", "state.wrong-state")

    def judged(*rules: str) -> VerdictChanged:
        outcome = Outcome.VIOLATED if rules else Outcome.OK
        return VerdictChanged(stage=Stage.CONNECTED, verdict=verdict_of(outcome, *rules))

    events = [judged(*rules), judged(*rules[:2]), judged(rules[0]), judged(rules[1]), judged()]
    said = [line.partition(";")[0] for line in written(PlainLines, *events)]
    assert said == ["not verified yet", "not verified yet", "connected: verdict ok"]


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


# A terminal


async def test_a_terminal_shows_lines_below_them_what_goes_on_and_in_the_end_the_verdict() -> None:
    head = "robot: active, verdict ok, domain 30, supervisor 1, up for 1.5 s"
    lines = written(PlainLines, *EVENTS)
    assert await on_terminal(*EVENTS) == [*lines, head]
    violated = UpResult(exit_code=ExitCode.VIOLATED, verdict=verdict_of(Outcome.VIOLATED))
    shown = await on_terminal(*EVENTS, finish=violated)
    assert shown[: len(lines)] == lines
    assert (shown[len(lines)], head in shown) == ("verdict: violated", False)
    why = "wrong: " + ", ".join(f"/node_{number}" for number in range(99))
    assert len((await on_terminal(status=replace(STATUS, not_ok=why)))[-1]) == 79


@pytest.mark.parametrize("count", [3, 60])
def test_a_status_fits_the_screen(count: int) -> None:
    nodes = [replace(NODE, node=f"/{'n' * 90}_{number}") for number in range(count)]
    nodes[-1] = replace(NODE, node="/late", state="inactive")
    status = replace(STATUS, nodes=tuple(nodes))
    rows = status_text(status, width=80, height=24).splitlines()
    assert len(rows) == min(count + 2, 24)
    assert max(map(len, rows)) <= 80
    late = next(row for row in rows if row.startswith("/late "))
    assert late.split()[1:] == ["running", "7", "inactive", "1/2", "1/3"]
    more = [row for row in rows if "more nodes: lifecycle status robot" in row]
    assert bool(more) == (count > 24)


# Status and flows


def test_a_status_is_a_head_a_line_for_each_node_and_its_connections_below_it() -> None:
    died = "pid 7 died: killed by SIGKILL"
    exited = {"process_state": ProcessState.EXITED, "state": "", "matched": 0, "died": died}
    udp, tcp = "udpv4://10.77.0.1:7911", "tcpv4://10.77.0.1:5100"
    carries = {"established": True, "mappings": ("publishers/video",)}
    connections = (
        ConnectionReport(name="net", urls=(udp,), **carries),
        ConnectionReport(name="far", urls=(tcp,), error="no route"),
        ConnectionReport(name="idle", urls=("shm://",)),
    )
    nodes = (
        replace(NODE, node="/arm", **exited),
        replace(NODE, connections=connections),
        replace(NODE, node="/lamp", matched=0, unreported=2),  # which nobody reports
    )
    assert status_text(replace(STATUS, nodes=nodes)) == (
        "robot: active 2/3, verdict ok, domain 30, supervisor 1, up for 1.5 s\n"
        "node     process  pid  state   matched  unique flows\n"
        "/arm     exited   7    dead    0/2      1/3           pid 7 died: killed by SIGKILL\n"
        "/camera  running  7    active  1/2      1/3\n"
        "  connection net established; udpv4://10.77.0.1:7911; carries publishers/video\n"
        "  connection far failed: no route; tcpv4://10.77.0.1:5100; carries nothing\n"
        "  connection idle waits for peers; shm://; carries nothing\n"
        "/lamp    running  7    active  –/2      1/3"
    )


def test_a_status_and_flows_fit_a_terminal_and_say_what_is_wrong_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("lifecycle.cli.flow_tables.terminal_width", lambda: 80)
    why = "wrong: " + ", ".join(f"/robot/topic_{number} (qos.incompatible)" for number in range(9))
    said = status_text(replace(STATUS, not_ok=why), width=80).splitlines()
    flows = (FLOW, replace(FLOW, outcome=Outcome.VIOLATED))
    rows = watched_flows(replace(verdict_of(Outcome.VIOLATED), flows=flows), "text").splitlines()
    assert max(map(len, (*said, *rows))) <= 80
    assert "/robot/topic_8 (qos.incompatible)" in " ".join(said)
    assert [line.split()[0] for line in rows[-2:]] == ["violated", "ok"]


def test_a_flow_shows_its_tuple_dscp_and_tos_requirement_and_verdict() -> None:
    head, row, ends = render_flows([FLOW], "text").splitlines()
    assert " ".join(head.split()) == (
        "verdict Hz p50 ms p99 ms lost unique required demanded dscp 5qi transport flow"
    )
    assert row.split()[0] == "ok"
    assert " shm  " in row  # what carries it, not what could
    for cell in ("85 (auto)", "46", "184", "strongly", "weakly"):
        assert cell in row
    assert ends == "    udp 10.0.0.1:40000 → 10.0.0.1:7000"
    _, row, _ = render_flows([replace(FLOW, reader_dscp=48)], "text").splitlines()
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
    system = World(plan, tmp_path).system
    command = system.nodes["camera"]
    command.state = "active"
    hosted = command.planned
    command.core.planned = replace(hosted, run=Run(kind=RunKind.COMMAND))
    (wrong,) = verdict_of(Outcome.VIOLATED, "state.wrong-state").findings
    wrong = replace(wrong, observed="inactive")
    verdict = replace(verdict_of(Outcome.OK), findings=(wrong,), flows=(FLOW,))
    system.run.judged.verdict = verdict
    (shown,) = system_status(system).nodes
    assert (shown.state, shown.matched, shown.unreported, shown.endpoints) == ("inactive", 1, 1, 2)
    command.core.planned = hosted
    (shown,) = system_status(system).nodes
    assert shown.state == "active"
