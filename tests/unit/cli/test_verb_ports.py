"""`lifecycle ports` as a person and as a script see it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lifecycle.cli import main
from lifecycle.errors import ExitCode
from lifecycle.network.ports import LINUX


@pytest.fixture(autouse=True)
def linux(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ephemeral ports as Linux has them by default."""
    monkeypatch.setattr("lifecycle.cli.verbs.ports.read_ephemeral_range", lambda _: LINUX)


def test_the_four_ports_the_safe_domains_and_what_fits_are_printed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    code = main(["ports", "--domain", "101", "--participant", "53"])
    assert code == ExitCode.OK
    assert (
        capsys.readouterr().out
        == """\
domain 101, participant 53
  discovery multicast   32650
  user multicast        32651
  discovery unicast     32766
  user unicast          32767
  unique subscriptions  7000–7399 (Fast DDS; shared by all domains of a host)
this machine: ephemeral ports 32768–60999
  safe domains          0–101, 215–232
  fit in domain 101     54 participants per host, then the ephemeral ports 32768–60999
  find each other       33 with 'range: localhost'
"""
    )


def test_an_overlap_with_the_next_domain_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    main(["ports", "--domain", "1", "--participant", "120"])
    assert capsys.readouterr().out.splitlines()[6] == (
        "  overlaps with         ports of the domains after it"
    )


def test_json_holds_the_same_for_a_script(capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["ports", "--domain", "2", "--format", "json"])
    assert code == ExitCode.OK
    assert json.loads(capsys.readouterr().out) == {
        "domain_id": 2,
        "participant_id": 0,
        "ports": {
            "discovery_multicast": 7900,
            "user_multicast": 7901,
            "discovery_unicast": 7910,
            "user_unicast": 7911,
        },
        "ephemeral": [32768, 60999],
        "safe_domains": [[0, 101], [215, 232]],
        "capacity": {"participants": 120, "limit": "the ports of domain 3, from 8150"},
        "localhost_participants": 33,
        "unique_subscription_ports": [7000, 7399],
    }


def test_the_domain_comes_from_the_environment_where_nothing_names_one(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()  # this machine's own ephemeral ports
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    main(["ports"])
    out = capsys.readouterr().out
    assert out.startswith("domain 42, participant 0\n")
    first, last = Path("/proc/sys/net/ipv4/ip_local_port_range").read_text("ascii").split()
    assert f"this machine: ephemeral ports {first}–{last}\n" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--domain", "233"],
            "cannot use domain id 233: its ports would lie outside 1 to 65535; use 0 to 232\n",
        ),
        (["--participant", "-1"], "cannot use participant id -1; use 0 or more\n"),
    ],
)
def test_a_question_without_an_answer_is_a_usage_error(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["ports", "--domain", "0", *arguments]) == ExitCode.USAGE
    assert capsys.readouterr().err == message
