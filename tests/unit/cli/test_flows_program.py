"""`lifecycle flows apply|remove`: options, dispatch and exit codes, without ROS."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from click.testing import CliRunner

from lifecycle.cli.verbs import flows as flows_verb
from lifecycle.errors import ExitCode, UsageError
from lifecycle.programming.programmer import read_program
from lifecycle.programming.target import Program, ProgrammingError, read_targets
from lifecycle.run_directory import RunDirectory
from tests.builders import nfe
from tests.unit.programming.flow_samples import plan, report
from tests.unit.programming.samples import nef_settings, settings_file
from tests.unit.programming.servers import TOKEN, NefServer


@pytest.fixture
def options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run directory of its own, and a token."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("TEST_TOKEN", TOKEN)


def nef_options(tmp_path: Path, url: str) -> Program:
    settings = nef_settings(url, devices=["10.77.0.1"])
    given = {"config": settings_file(tmp_path, nef=settings)}
    return read_program(["nef"], given, option="--target")


def test_a_subcommand_is_a_subcommand_and_everything_else_is_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = CliRunner()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "lifecycle").mkdir(mode=0o700)
    held = RunDirectory.acquire(tmp_path / "lifecycle", "robot@3", "abc")
    missing = run.invoke(flows_verb.command, []).output
    assert "Missing argument 'TARGET'. It is a manifest, or a system; running: robot@3" in missing
    held.release()
    shown = run.invoke(flows_verb.command, ["a.yaml", "--export", "nft", "--watch"])
    assert str(shown.exception) == "cannot use --export with --watch; export once"
    for verb in ("apply", "remove"):
        assert "MANIFEST" in run.invoke(flows_verb.command, [verb, "--help"]).output
    listed = run.invoke(flows_verb.command, ["--help"]).output
    assert "apply" in listed
    assert "--watch" in listed


def test_options_of_tc_are_read_with_their_units() -> None:
    given = {"device": "e0", "rate": "20mbit", "guarantee": ("ef=2mbit",)}
    (options,) = read_targets(["tc"], given)

    settings = options.settings
    assert (settings.device, settings.link_kbit) == ("e0", 20_000)
    assert settings.guaranteed_kbit == {"ef": 2_000}


@pytest.mark.parametrize(
    ("targets", "given", "message"),
    [
        (
            ["nft"],
            {"device": "e0"},
            "cannot use --device with --target nft",
        ),
        (["nft"], {"config": "f"}, "cannot use --config with --target nft"),
        (["tc"], {"device": "e0", "rate": "fast"}, "cannot use rate 'fast'"),
        (["tc"], {"device": "e0", "rate": "1mbit", "queue": "50"}, "cannot use queue '50'"),
        (["tc"], {"device": "e0", "queue": "50ms"}, "cannot program tc without the rate"),
        (
            ["tc"],
            {"device": "e0", "guarantee": ("ef",)},
            "cannot read guarantee 'ef'; write CLASS=",
        ),
        (["tc"], {}, "cannot program tc without a device"),
    ],
)
def test_options_that_do_not_fit_are_refused(
    targets: list[str], given: dict[str, object], message: str
) -> None:
    with pytest.raises(UsageError) as caught:
        read_targets(targets, given)

    assert str(caught.value).startswith(message)


def test_a_5qi_mapping_is_one_of_ours_or_a_file(tmp_path: Path) -> None:
    file = tmp_path / "mapping.json"
    file.write_text('{"name": "own", "source": "us", "values": {"85": "EF"}}')

    given = {"mapping": str(file), "flow_labels": True}
    own = read_program(["nft"], given, option="--target").treatment

    assert own.label_flows
    assert own.mapping is not None
    assert own.mapping.dscp_for(85) == 46
    with pytest.raises(UsageError, match="cannot find 5QI to DSCP mapping 'nope'"):
        read_program(["nft"], {"mapping": "nope"}, option="--target")


@pytest.mark.usefixtures("options")
def test_without_httpx_a_server_is_refused_by_the_name_of_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = nef_options(tmp_path, "http://127.0.0.1:9")
    monkeypatch.setattr("lifecycle.programming.http.httpx", None)

    with pytest.raises(ProgrammingError) as caught:
        flows_verb.apply(plan(), [report()], options, dry_run=False)

    assert str(caught.value) == (
        "cannot reach http://127.0.0.1:9/3gpp-as-session-with-qos/v1/robots: httpx is not installed"
        "; install it: pip install 'ros-lifecycle-manifests[networks]'"
    )


@pytest.mark.usefixtures("options")
def test_apply_and_remove_go_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with NefServer() as server:
        options = nef_options(tmp_path, server.url)
        flows = [report(), report("/robot/status", source=(nfe("0.0.0.0", 45009),))]
        name = f"nef at {server.url}/3gpp-as-session-with-qos/v1/robots"

        assert flows_verb.apply(plan(), flows, options, dry_run=True)
        assert server.subscriptions == {}
        assert flows_verb.apply(plan(), flows, options, dry_run=False)
        capsys.readouterr()
        assert not flows_verb.apply(plan(), flows, options, dry_run=True)
        out, err = capsys.readouterr()
        assert flows_verb.remove(plan()) is ExitCode.OK
        removed = capsys.readouterr().out
        assert flows_verb.remove(plan()) is ExitCode.OK

        assert out.partition("\n")[0] == f"{name}: 1 unchanged"
        assert err == (
            "left out: /robot/status /robot/camera → /viewer: neither a dscp nor a five_qi\n"
        )
        assert removed.partition("\n")[0] == f"{name}: 1 deleted, 0 unchanged"
        assert capsys.readouterr().out == "nothing of system robot is in any network\n"
        assert server.subscriptions == {}
        assert not list(Path(os.environ["XDG_RUNTIME_DIR"]).rglob("programmed.json"))
