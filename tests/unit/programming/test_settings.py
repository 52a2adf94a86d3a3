"""Settings files and tokens: what is refused, and that nothing quotes a secret."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lifecycle.errors import UsageError
from lifecycle.programming.camara import CamaraSettings
from lifecycle.programming.http import Token, load_settings
from lifecycle.programming.ledger import TargetRecord
from lifecycle.programming.nef import NefSettings
from lifecycle.programming.target import Means, SettingsError, read_targets, target_kind
from tests.unit.programming.samples import camara_settings, ledger_in, nef_settings, settings_file

NEF_YAML = """
nef:
  url: https://nef.example.net
  scs_as_id: robots
  token: {file: token.txt}
  notification_destination: https://robots.example.net/events
  devices: [10.45.0.0/16]
  qos_references: {85: robot-control}
"""


def test_yaml_and_json_are_read_alike(tmp_path: Path) -> None:
    file = tmp_path / "targets.yaml"
    file.write_text(NEF_YAML)
    of_yaml = load_settings(file, "nef", NefSettings)
    same = nef_settings("https://nef.example.net", token={"file": "token.txt"})
    of_json = load_settings(settings_file(tmp_path, nef=same), "nef", NefSettings)

    assert of_yaml == of_json
    assert isinstance(of_yaml, NefSettings)
    assert of_yaml.qos_references == {85: "robot-control"}
    assert of_yaml.token == Token(file=str(tmp_path / "token.txt"))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"url": "ftp://x"}, "cannot use url 'ftp://x'; use http:// or https:// and a host"),
        (
            {"url": "http://nef.example.net"},
            "cannot send a token to 'http://nef.example.net': anyone could read it; use https://",
        ),
        (
            {"url": "https://me:hunter2@nef.example.net"},
            "cannot use a url with a password in it; use token",
        ),
        (
            {"scs_as_id": "a/b"},
            "cannot use scs_as_id 'a/b'; use letters, digits and . _ ~ -",
        ),
        ({"timeout_s": 0}, "cannot use timeout_s 0; use a number > 0"),
        ({"tokn": 1}, "Object contains unknown field `tokn`"),
        ({"token": "hunter2"}, "Expected `object | null`, got `str`"),
        ({"token": {}}, "cannot find the token: give exactly one of env and file"),
        ({"qos_references": {"EF": "robot-control"}}, "Expected `int`, got `str`"),
    ],
)
def test_what_is_not_allowed_is_refused_where_it_stands(
    tmp_path: Path, changed: dict[str, object], message: str
) -> None:
    file = settings_file(tmp_path, nef={**nef_settings("https://nef.example.net"), **changed})

    with pytest.raises(SettingsError) as caught:
        load_settings(file, "nef", NefSettings)

    (key,) = changed
    inside = {"token": "nef.token", "qos_references": "a key of nef.qos_references"}
    where = inside.get(key, "nef")
    assert str(caught.value) == f"cannot use settings {file!r}: {where}: {message}"
    assert "hunter2" not in str(caught.value)


def test_text_that_is_no_yaml_is_not_quoted_for_it_may_hold_a_token(tmp_path: Path) -> None:
    file = tmp_path / "targets.yaml"
    file.write_text("nef: {token: hunter2\n  x: [")

    with pytest.raises(SettingsError) as caught:
        load_settings(file, "nef", NefSettings)

    assert str(caught.value).startswith(f"cannot read settings {str(file)!r}: no YAML at line 2")
    assert "hunter2" not in str(caught.value)


def test_a_file_that_is_not_there_is_one_clear_error() -> None:
    with pytest.raises(SettingsError) as caught:
        load_settings("/nowhere/targets.yaml", "nef", NefSettings)

    assert str(caught.value) == (
        "cannot read settings '/nowhere/targets.yaml': No such file or directory"
    )


def test_a_token_comes_from_the_environment_or_a_file_at_the_moment_it_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("T", " abc ")
    file = tmp_path / "token"
    file.write_text("first\n")
    token = Token(file=str(file))

    assert token.reveal() == "first"
    file.write_text("rotated\n")
    assert token.reveal() == "rotated"
    assert Token(env="T").reveal() == "abc"
    assert "rotated" not in repr(token)


@pytest.mark.parametrize("text", ["", "  \n", "two words", "a\r\nX-Evil: 1", "hunter2é"])
def test_what_is_no_token_is_refused_without_being_quoted(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("T", text)
    file = tmp_path / "token"
    file.write_text(text, encoding="utf-8")

    for token in (Token(env="T"), Token(file=str(file))):
        with pytest.raises(SettingsError, match="the token from") as caught:
            token.reveal()
        for part in ("hunter2", "words", "Evil"):
            assert part not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "cisco"}, "cannot program target 'cisco'; use nft, tc, nef, camara"),
        (
            {"kind": "tc"},
            (
                "cannot program tc without a device; only devices that are named are touched; "
                "give --device eth0 --rate 20mbit"
            ),
        ),
        (
            {"kind": "nef"},
            "cannot program nef without settings: where it is and who we are; give --config FILE",
        ),
    ],
)
def test_options_that_do_not_name_a_network_are_refused(
    options: dict[str, str], message: str
) -> None:
    with pytest.raises(UsageError) as caught:
        read_targets([options["kind"]], {})

    assert str(caught.value) == message


def test_settings_of_another_kind_are_refused(tmp_path: Path) -> None:
    file = settings_file(tmp_path, camara=camara_settings("https://x.example/qod"))

    with pytest.raises(SettingsError) as caught:
        read_targets(["nef"], {"config": file})[0].open(Means(ledger_in(tmp_path)))

    assert str(caught.value) == f"cannot program nef: settings {file!r} have no key 'nef'"


def test_what_a_ledger_lists_is_not_looked_for_at_another_server(tmp_path: Path) -> None:
    file = settings_file(tmp_path, nef=nef_settings("https://one.example"))

    there = "https://one.example/3gpp-as-session-with-qos/v1/robots"
    record = TargetRecord(target="nef", scope=there, settings=file)
    target_kind("nef").restore(record)
    Path(file).write_text(json.dumps({"nef": nef_settings("https://two.example")}))
    with pytest.raises(SettingsError) as caught:
        target_kind("nef").restore(record)

    assert str(caught.value) == (
        f"cannot remove what is at {there}: settings {file!r} are "
        "of https://two.example/3gpp-as-session-with-qos/v1/robots now"
    )


def test_the_settings_in_the_documentation_can_be_used(tmp_path: Path) -> None:
    page = Path(__file__).parents[3] / "docs" / "programming_networks.md"
    file = tmp_path / "targets.yaml"
    file.write_text(page.read_text(encoding="utf-8").split("```yaml\n")[1].split("```")[0])

    assert load_settings(file, "nef", NefSettings) is not None
    settings = load_settings(file, "camara", CamaraSettings)
    assert settings is not None
    assert settings.token == Token(file=str(tmp_path / "camara.token"))
