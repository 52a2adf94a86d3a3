"""Environment, process control and shared memory rules that need no ROS."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.discovery import all_by_multicast
from lifecycle.middleware.fastdds.profiles import discovery_environment, discovery_profile
from lifecycle.middleware.fastdds.sockets import widen_discovery_buffers
from lifecycle.network.ports import participant_ports

VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"


@pytest.mark.parametrize(
    ("machines", "own", "environment", "expected"),
    [
        (["", ""], {""}, {}, True),
        (["a", "b"], {"", "a", "b"}, {"ROS_STATIC_PEERS": ""}, True),
        (["a", "b"], {"a"}, {}, False),
        ([""], {""}, {"ROS_STATIC_PEERS": "10.0.2.1"}, False),
    ],
)
def test_endpoints_go_by_multicast_only_where_no_other_host_is_looked_for(
    machines: list[str], own: set[str], environment: dict[str, str], *, expected: bool
) -> None:
    assert all_by_multicast(machines, own, environment) is expected


def test_the_environment_names_a_complete_file(tmp_path: Path) -> None:
    environment = discovery_environment(tmp_path)
    assert environment == {VARIABLE: str(tmp_path / "quick_discovery.xml")}
    assert Path(environment[VARIABLE]).read_text(encoding="utf-8") == discovery_profile()
    assert list(tmp_path.iterdir()) == [tmp_path / "quick_discovery.xml"]


@pytest.mark.parametrize("variable", [VARIABLE, "FASTDDS_DEFAULT_PROFILES_FILE"])
def test_a_users_own_profile_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variable: str
) -> None:
    monkeypatch.setenv(variable, "/own.xml")
    assert discovery_environment(tmp_path) == {}
    assert list(tmp_path.iterdir()) == []


def test_a_users_profile_in_the_working_directory_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "DEFAULT_FASTRTPS_PROFILES.xml").touch()
    assert discovery_environment(tmp_path) == {}


def test_a_directory_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(MiddlewareError) as refused:
        discovery_environment(tmp_path / "missing")
    assert str(refused.value) == (
        f"cannot write the discovery profile '{tmp_path}/missing/quick_discovery.xml': "
        "No such file or directory"
    )


def test_only_sockets_that_receive_discovery_of_the_domain_get_more_room() -> None:
    ports = participant_ports(231, 50)

    def room(port: int) -> tuple[int, int]:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
            bound.bind(("127.0.0.1", port))
            before = bound.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
            counted = widen_discovery_buffers(231)
            after = bound.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
            assert counted == (after > before)
            return before, after

    before, after = room(ports.discovery_unicast)
    assert after > before
    before, after = room(ports.user_unicast)
    assert after == before
