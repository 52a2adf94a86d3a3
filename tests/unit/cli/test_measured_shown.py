"""What was measured of flows, in tables, in a line, and in a file."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.cli import flow_tables
from lifecycle.cli.flow_tables import RECORDED, Record, bar, cells, watched_flows
from lifecycle.errors import UsageError
from lifecycle.manifest.model import UniqueHow
from lifecycle.measure.flows import FlowMeasurement, Kind, MeasuredBound, measured_summary
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import FlowReport
from tests.unit.supervisor.fakes import verdict_of


def bound(kind: Kind, outcome: str, share: float | None, text: str = "") -> MeasuredBound:
    return MeasuredBound(name="a_key", kind=kind, outcome=outcome, share=share, text=text)


def measured(*bounds: MeasuredBound, topic: str = "/robot/video", to: str = "/operator/station"):
    return FlowMeasurement(
        topic=topic,
        publisher="/robot/camera",
        subscription=to,
        messages=74,
        lost=1,
        rate_hz=14.8,
        p50_ms=0.4201,
        p99_ms=58.24,
        bounds=bounds,
    )


LATE = bound(Kind.DELAY, "violated", 11.648, "delay p99 58.2 ms > 5 ms")
IN_TIME = bound(Kind.DELAY, "ok", 0.5, "delay p99 58.2 ms ≤ 116 ms")
SLOW = bound(Kind.RATE, "violated", 0.5, "14.8 Hz < 30 Hz - 5%")
UNSURE = bound(Kind.NETWORK_DELAY, "unverifiable", 0.97)
LOSES = bound(Kind.LOSS, "measuring", 0.013, "1 of 75 lost, measuring ≤ 1")


@pytest.mark.parametrize(
    ("share", "expected"),
    [(0, "   "), (0.001, "▏  "), (0.5, "█▌ "), (1, "███"), (7.5, "███"), (1 / 3, "█  ")],
)
def test_a_bar_is_as_long_as_its_share_and_never_longer_than_its_column(
    share: float, expected: str
) -> None:
    assert bar(share) == expected


@pytest.mark.parametrize(
    ("flow", "expected"),
    [
        (None, ("–", "–", "–", "–")),
        (measured(), ("14.8", "0.42", "58.2", "1/75")),
        (measured(LATE, SLOW), ("14.8!█▌", "0.42", "58.2!███", "1/75")),
        (measured(IN_TIME, LOSES), ("14.8", "0.42", "58.2 █▌", "1/75?▏")),
        (
            measured(IN_TIME, replace(LATE, kind=Kind.NETWORK_DELAY)),
            ("14.8", "0.42", "58.2!███", "1/75"),
        ),
        (measured(IN_TIME, UNSURE), ("14.8", "0.42", "58.2?██▉", "1/75")),
        (measured(bound(Kind.DELAY, "measuring", None)), ("14.8", "0.42", "58.2?", "1/75")),
        (replace(measured(), lost=None, p50_ms=None, p99_ms=1234.5), ("14.8", "–", "1234", "–")),
    ],
)
def test_a_number_has_its_bar_and_says_without_colours_whether_it_is_kept(
    flow: FlowMeasurement | None, expected: tuple[str, ...]
) -> None:
    plain = cells(flow, colour=False)
    assert tuple(each.strip() for each in plain) == expected
    coloured = cells(flow, colour=True)
    assert tuple(re.sub("\x1b\\[\\d*m", "", each) for each in coloured) == plain
    for each in coloured:
        assert ("\x1b[31m" in each, "\x1b[33m" in each) == ("!" in each, "?" in each)


def flow_of(measurement: FlowMeasurement, outcome: Outcome = Outcome.OK) -> FlowReport:
    return FlowReport(
        topic=measurement.topic,
        publisher=measurement.publisher,
        subscription=measurement.subscription,
        source=(),
        destination=(),
        unique=UniqueHow.STRONGLY,
        dscp=46,
        requirement=(UniqueRequirement.NOT_REQUIRED,) * 2,
        demanded=UniqueHow.NOT,
        outcome=outcome,
        effective_transport="udpv4",
    )


def shown(monkeypatch: pytest.MonkeyPatch, *flows: FlowMeasurement, width: int = 80) -> list[str]:
    """The rows of `flows --watch` on a terminal, without colours."""
    monkeypatch.setattr(flow_tables, "terminal_width", lambda: width)
    unmeasured = measured(topic="/robot/cmd_vel", to="/robot/health")
    verdict = replace(
        verdict_of(Outcome.VIOLATED),
        flows=(flow_of(unmeasured), *map(flow_of, flows)),
        measured=flows,
    )
    text = re.sub("\x1b\\[\\d*m", "", watched_flows(verdict, "text")).splitlines()
    assert all(len(line) <= width for line in text), text
    return text


def test_a_watch_has_the_worst_first_in_columns_that_fit_80(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows = shown(monkeypatch, measured(IN_TIME, to="/robot/base"), measured(LATE, SLOW, LOSES))
    assert "measured: 1 flow ok, 1 violated:" in " ".join(rows)
    assert [row.split() for row in rows[-4:]] == [
        ["verdict", "Hz", "p50", "ms", "p99", "ms", "lost", "flow"],
        [
            "violated",
            "14.8!█▌",
            "0.42",
            "58.2!███",
            "1/75?▏",
            "/robot/video",
            "camera",
            "→",
            "station",
        ],
        ["ok", "–", "–", "–", "–", "/robot/cmd_vel", "camera", "→", "health"],
        ["ok", "14.8", "0.42", "58.2", "█▌", "1/75", "/robot/video", "camera", "→", "base"],
    ]


def test_a_wide_terminal_shows_the_rest_and_a_system_without_numbers_no_columns_for_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows = shown(monkeypatch, measured(IN_TIME), width=120)
    video = ("/robot/video", "camera", "→", "station")
    assert rows[-1].split()[-7:] == ["strongly", "EF", "udpv4", *video]
    rows = shown(monkeypatch)
    assert rows[-2].split() == ["verdict", "unique", "dscp", "transport", "flow"]


def test_nodes_of_one_name_are_shown_with_their_namespaces(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = shown(monkeypatch, measured(to="/left/viewer"), measured(to="/right/viewer"))
    assert [row.split()[-1] for row in rows[-2:]] == ["/left/viewer", "/right/viewer"]


def test_a_summary_counts_the_flows_with_declared_numbers_and_names_the_worst_first() -> None:
    assert measured_summary([]) == measured_summary([measured()]) == ""
    assert measured_summary([measured(IN_TIME), measured()]) == "measured: 1 flow ok"
    assert measured_summary([measured(LOSES), measured(LOSES)]) == "measured: 2 flows measuring"
    # Half of a rate is worse than a delay of 1.2 times its bound, and not as bad as 11 times.
    later = replace(LATE, share=1.2, text="delay p99 6 ms > 5 ms")
    flows = [measured(later, to="/a"), measured(SLOW, to="/b"), measured(LATE, SLOW, to="/c")]
    head, *named = measured_summary([*flows, measured(IN_TIME), measured(LOSES)]).split("; ")
    assert head == (
        "measured: 1 flow ok, 3 violated, 1 measuring: /robot/video /robot/camera → /c: "
        "delay p99 58.2 ms > 5 ms, 14.8 Hz < 30 Hz - 5%"
    )
    assert [each.split(": ")[0][-2:] for each in named] == ["/b", "/a"]
    assert measured_summary([*flows, *flows]).endswith("; and 3 more")


def test_a_record_has_a_row_for_each_flow_that_is_on_disk_at_once(tmp_path: Path) -> None:
    path = tmp_path / "flows.csv"
    record = Record(path)
    assert path.read_text() == ",".join(RECORDED) + "\n"
    unknown = replace(measured(), lost=None, p50_ms=None, p99_ms=None)
    record.add([measured(LATE, LOSES), unknown])
    rows = list(csv.DictReader(path.read_text().splitlines()))
    assert record.rows == len(rows) == 2
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}\+00:00", rows[0]["time"])
    assert 0 <= float(rows[0]["seconds"]) < 10
    assert [*rows[0].values()][2:] == [
        *("/robot/video", "/robot/camera", "/operator/station"),
        *("74", "1", "14.800", "0.420", "58.240", "violated"),
    ]
    assert [*rows[1].values()][5:] == ["74", "", "14.800", "", "", ""]
    record.close()


def test_a_record_replaces_a_file_and_says_why_it_cannot_be_written(tmp_path: Path) -> None:
    path = tmp_path / "flows.csv"
    path.write_text("kept")
    Record(path).close()
    assert path.read_text() == ",".join(RECORDED) + "\n"
    with pytest.raises(UsageError, match=r"cannot write .*/none/flows.csv': No such file"):
        Record(tmp_path / "none" / "flows.csv")
    with pytest.raises(UsageError, match="cannot write '/dev/full': No space left on device"):
        Record(Path("/dev/full"))
