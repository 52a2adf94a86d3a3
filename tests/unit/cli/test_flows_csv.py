"""Flow reports as CSV."""

from __future__ import annotations

import csv
import io

from msgspec.structs import replace

from lifecycle.cli.flow_tables import COLUMNS, flows_to_csv
from lifecycle.manifest.model import UniqueHow
from lifecycle.measure.flows import NUMBERS, FlowMeasurement
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import FlowReport
from tests.builders import nfe

VIDEO = FlowReport(
    topic="/robot/video",
    publisher="/robot/camera",
    subscription="/viewer",
    source=(nfe("0.0.0.0", 45000), nfe("10.0.0.1", 45001)),
    destination=(nfe("10.0.0.2", 7001),),
    unique=UniqueHow.STRONGLY,
    dscp=46,
    requirement=(UniqueRequirement.STRICTLY_REQUIRED, UniqueRequirement.NOT_REQUIRED),
    demanded=UniqueHow.WEAKLY,
    outcome=Outcome.OK,
    max_delay_ms=5.0,
    five_qi=85,
    five_qi_reason="5QI 85, because",
    effective_transport="udpv4",
)


def rows(*reports: FlowReport) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(flows_to_csv(reports))))


def test_a_flow_is_one_line_with_its_5_tuple_dscp_and_verdict() -> None:
    header, line = flows_to_csv([VIDEO]).splitlines()
    assert header == ",".join((*COLUMNS, *NUMBERS))
    assert line == (
        "/robot/video,/robot/camera,/viewer,udp,ipv4,0.0.0.0,45000,10.0.0.2,7001,,46,EF,184,"
        "strongly,weakly,strictly_required,not_required,5,ok,85,"
        '"5QI 85, because",udpv4,,,,,'
    )
    counted = FlowMeasurement(
        topic=VIDEO.topic,
        publisher=VIDEO.publisher,
        subscription=VIDEO.subscription,
        messages=74,
        lost=None,
        rate_hz=14.8,
        p99_ms=0.6062,
    )
    _, line = flows_to_csv([VIDEO], {VIDEO.pair: counted}).splitlines()
    assert line.endswith(",udpv4,74,,14.800,,0.606")


def test_a_pair_with_several_flows_has_one_line_each() -> None:
    report = replace(VIDEO, destination=(nfe("10.0.0.2", 7001), nfe("10.1.0.2", 7001)))
    assert [row["destination_address"] for row in rows(report)] == ["10.0.0.2", "10.1.0.2"]


def test_what_is_not_known_is_an_empty_cell_and_not_a_guess() -> None:
    report = replace(
        VIDEO,
        source=(),
        destination=(),
        unique=None,
        dscp=None,
        max_delay_ms=None,
        five_qi=None,
        five_qi_reason="",
        outcome=Outcome.UNVERIFIABLE,
    )
    (row,) = rows(report)
    assert {name for name, value in row.items() if not value} == {
        *NUMBERS,
        "transport_protocol",
        "internet_protocol",
        "source_address",
        "source_port",
        "destination_address",
        "destination_port",
        "flow_label",
        "dscp",
        "dscp_name",
        "tos",
        "unique",
        "max_delay_ms",
        "five_qi",
        "five_qi_reason",
    }
    assert row["outcome"] == "unverifiable"
