"""`lifecycle flows --export` and the options of `up --program`, without ROS."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from lifecycle.cli.verbs import flows as verb
from lifecycle.cli.verbs import up
from lifecycle.programming import TARGETS
from lifecycle.programming.programmer import read_program
from lifecycle.verify.verdict import FlowReport
from tests.unit.programming.flow_samples import plan, report
from tests.unit.programming.samples import camara_settings, nef_settings, settings_file


def export(name: str, *flows: FlowReport, **given: object) -> None:
    """Export flows for a network, `given` what it takes."""
    program = read_program((name,), given, option="--export")
    verb.export(plan(), flows or [report()], program)


@pytest.mark.parametrize("name", TARGETS)
def test_every_export_shows_the_flow_and_names_what_it_left_out(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    devices = ["10.77.0.2"]
    file = settings_file(
        tmp_path,
        nef=nef_settings("https://nef.test", devices=devices),
        camara=camara_settings("https://camara.test", devices=devices),
    )
    needs = {"tc": {"device": "eth0", "rate": "10mbit"}}
    given = needs.get(name, {"config": file} if name in ("nef", "camara") else {})
    export(name, report(), report("/robot/status", source=(), destination=()), **given)
    text = capsys.readouterr().out
    assert text.endswith("\n")
    assert "/robot/video" in text
    assert "/robot/status" in text
    assert "its network flow endpoints are not known" in text
    assert "EF = DSCP 46 = TOS 184 (0xb8)" in text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--export", "nft", "--watch"], "cannot use --export with --watch; export once"),
        (
            ["--export", "nft", "--device", "e0"],
            "cannot use --device with --export nft",
        ),
        (["--device", "e0"], "cannot use --device without --export"),
    ],
)
def test_flows_refuses_options_that_do_not_fit(options: list[str], message: str) -> None:
    result = CliRunner().invoke(verb.command, ["m.yaml", *options])

    assert str(result.exception) == message


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--device", "e0"], "cannot use --device without --program"),
        (["--flow-labels"], "cannot use --dscp-from-5qi or --flow-labels without --program"),
    ],
)
def test_up_refuses_options_that_do_not_fit(options: list[str], message: str) -> None:
    manifest = Path(__file__).parents[3] / "manifests" / "first_node.lifecycle.yaml"

    result = CliRunner().invoke(up.command, [str(manifest), *options])

    assert str(result.exception) == message
