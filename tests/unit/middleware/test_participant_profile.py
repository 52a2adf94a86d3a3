"""Profiles of Fast DDS, of participants and endpoints, and the processes that they are for."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.profiles import (
    DefaultProfile,
    ParticipantSettings,
    default_profile,
    discovery_environment,
    discovery_profile,
    profile,
)
from lifecycle.middleware.fastdds.sockets import widen_discovery_buffers
from lifecycle.network.ports import participant_ports
from lifecycle.plan.model import ParticipantConnections

UDP = ParticipantSettings(transports=("udpv4",))
USERS = """<?xml version="1.0"?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
  <data_reader profile_name="/in"/>
  <participant profile_name="other"/>
  <participant profile_name="mine" is_default_profile="true">
    <rtps>
      {extra}
      <propertiesPolicy><properties>
        <property><name>fastdds.max_message_size</name><value>9000</value></property>
        <property><name>color</name><value>red</value></property>
      </properties></propertiesPolicy>
      <builtin>
        <initialPeersList><locator><udpv4><address>10.0.0.9</address></udpv4></locator>
        </initialPeersList>
        <metatrafficMulticastLocatorList><locator><udpv4/></locator>
        </metatrafficMulticastLocatorList>
      </builtin>
    </rtps>
  </participant>
</profiles></dds>"""


def users(tmp_path: Path, extra: str = "") -> DefaultProfile:
    path = tmp_path / "mine.xml"
    path.write_text(USERS.format(extra=extra))
    found = default_profile({"FASTRTPS_DEFAULT_PROFILES_FILE": str(path)})
    assert found is not None
    return found


def made(settings: ParticipantSettings, **options: Any) -> ET.Element:
    """Return the profile, parsed, without its namespace."""
    text = profile("p", settings, **options)
    return ET.fromstring(text.replace(' xmlns="http://www.eprosima.com', ' x="'))


def texts(root: ET.Element, path: str) -> list[str]:
    return [(each.text or "").strip() for each in root.findall(path)]


def test_non_blocking_send_is_set_on_udp_and_keeps_shared_memory_where_none_is_chosen() -> None:
    root = made(ParticipantSettings(non_blocking_send=True))
    found = [
        (each.findtext("type"), each.findtext("non_blocking_send"))
        for each in root.findall(".//transport_descriptor")
    ]
    assert found == [("SHM", None), ("UDPv4", "true")]


def test_a_datagram_size_alone_leaves_transports_alone() -> None:
    root = made(ParticipantSettings(max_datagram_bytes=1400))
    assert root.findall(".//userTransports") == []
    assert root.findall(".//useBuiltinTransports") == []


def test_discovery_is_left_alone_unless_it_is_localhost() -> None:
    assert made(UDP).findall(".//builtin") == []


def test_localhost_is_discovered_as_rmw_fastrtps_does_for_each_transport() -> None:
    root = made(
        ParticipantSettings(transports=("udpv4", "udpv6")),
        localhost_peers=("10.0.0.7", "fd00::7", "robot.local"),
    )
    assert texts(root, ".//maxInitialPeersRange") == ["32", "32"]
    listened = root.findall(".//metatrafficUnicastLocatorList/locator/*")
    assert [(each.tag, len(each)) for each in listened] == [("udpv4", 0), ("udpv6", 0)]
    searched = root.findall(".//initialPeersList/locator/*")
    assert [(each.tag, each.findtext("address")) for each in searched] == [
        ("udpv4", "10.0.0.7"),
        ("udpv4", "robot.local"),
        ("udpv4", "127.0.0.1"),
        ("udpv6", "fd00::7"),
        ("udpv6", "robot.local"),
        ("udpv6", "::1"),
    ]


def test_a_profile_of_the_users_is_kept_but_for_what_is_added(tmp_path: Path) -> None:
    base = users(tmp_path)
    before = ET.tostring(base.element)
    settings = ParticipantSettings(transports=("udpv4",), max_datagram_bytes=1400)
    root = made(settings, base=base, localhost_peers=())
    assert texts(root, ".//initialPeersList//address") == ["10.0.0.9", "127.0.0.1"]
    assert root.findall(".//metatrafficMulticastLocatorList") == []
    assert texts(root, ".//property/name") == ["color", "fastdds.max_message_size"]
    assert texts(root, ".//property/value") == ["red", "1400"]
    assert ET.tostring(base.element) == before


@pytest.mark.parametrize(
    ("protocol", "made_so"),
    [("CLIENT", "SUPER_CLIENT"), ("SIMPLE", "SIMPLE"), ("SERVER", "SERVER")],
)
def test_of_a_server_that_a_profile_names_only_a_client_becomes_a_super_client(
    tmp_path: Path, protocol: str, made_so: str
) -> None:
    path = tmp_path / "theirs.xml"
    path.write_text(
        f"""<dds><profiles><participant profile_name="theirs" is_default_profile="true"><rtps>
        <builtin><discovery_config><discoveryProtocol>{protocol}</discoveryProtocol>
        </discovery_config></builtin></rtps></participant></profiles></dds>"""
    )
    base = default_profile({"FASTRTPS_DEFAULT_PROFILES_FILE": str(path)})
    connections = ParticipantConnections(super_client=True)
    root = made(ParticipantSettings(connections=connections), base=base)
    assert texts(root, ".//discoveryProtocol") == [made_so]


@pytest.mark.parametrize(
    "choice",
    [
        "<builtinTransports>UDPv6</builtinTransports>",
        "<useBuiltinTransports>false</useBuiltinTransports>",
        "<userTransports><transport_id>t</transport_id></userTransports>",
    ],
)
def test_transports_that_the_user_chose_are_not_replaced(tmp_path: Path, choice: str) -> None:
    base, tag = users(tmp_path, choice), choice[1 : choice.index(">")]
    with pytest.raises(MiddlewareError) as refused:
        made(UDP, base=base)
    assert str(refused.value) == (
        "cannot give a participant udpv4: the default participant profile 'mine' of "
        f"'{tmp_path}/mine.xml' already chooses its transports (<{tag}>); take <{tag}> out of it, "
        "or what needs udpv4 out of the manifest"
    )
    made(ParticipantSettings(max_datagram_bytes=1400), base=base)


def test_the_environments_choice_of_transports_is_not_replaced_by_a_default(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = ParticipantSettings(non_blocking_send=True)
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "UDPv6")
    with pytest.raises(MiddlewareError) as refused:
        profile("p", settings)
    assert str(refused.value) == (
        "cannot give a participant a non-blocking send: FASTDDS_BUILTIN_TRANSPORTS='UDPv6' already "
        "chooses its transports; unset it, or say "
        "FASTDDS_BUILTIN_TRANSPORTS=UDPv6?non_blocking=true"
    )
    assert "UDPv4" in profile("p", UDP), "the manifest is more precise"


def test_without_a_file_there_is_no_default_profile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert default_profile({}) is None


def test_the_file_of_the_working_directory_counts_last_unless_it_is_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    named = tmp_path / "named.xml"
    named.write_text(USERS.format(extra=""))
    Path("DEFAULT_FASTRTPS_PROFILES.xml").write_text(USERS.replace("mine", "local"))
    environment = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(named)}
    both, one = (
        default_profile({**environment, **each}) for each in ({}, {"SKIP_DEFAULT_XML": "1"})
    )
    assert both is not None
    assert one is not None
    assert (both.name, one.name) == ("local", "mine")


@pytest.mark.parametrize(
    ("content", "reason"),
    [(None, "No such file or directory"), ("<dds>", "no element found: line 1, column 5")],
)
def test_a_profiles_file_that_cannot_be_read_is_named(
    tmp_path: Path, content: str | None, reason: str
) -> None:
    path = tmp_path / "p.xml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(MiddlewareError) as refused:
        default_profile({"FASTRTPS_DEFAULT_PROFILES_FILE": str(path)})
    assert str(refused.value) == f"cannot read profiles {str(path)!r}: {reason}"


def connected(*urls: str, super_client: bool = False) -> ET.Element:
    connections = ParticipantConnections(urls=urls, super_client=super_client)
    return made(ParticipantSettings(connections=connections), domain_id=3)


def locators(root: ET.Element, path: str) -> list[dict[str, str]]:
    return [
        {"kind": each.tag, **{value.tag: value.text or "" for value in each}}
        for each in root.findall(f".//{path}/locator/*")
    ]


@pytest.mark.parametrize(("super_client", "protocol"), [(True, "SUPER_CLIENT"), (False, "CLIENT")])
def test_several_servers_count_their_prefix_up(super_client: bool, protocol: str) -> None:
    root = connected(
        "tcpv4://10.77.0.1:5101?server=10.77.0.3:42100&server=10.77.0.4:42100",
        super_client=super_client,
    )
    assert root.findtext(".//discoveryProtocol") == protocol
    prefixes = [each.get("prefix") for each in root.findall(".//RemoteServer")]
    assert prefixes == [f"44.53.0{n}.5f.45.50.52.4f.53.49.4d.41" for n in (0, 1)]


def test_urls_that_one_participant_cannot_have_together_are_refused() -> None:
    with pytest.raises(MiddlewareError, match="cannot use 'shm://' beside 'udpv4://:7911'"):
        connected("shm://", "udpv4://:7911")


@pytest.mark.parametrize("url", ["tcpv4://10.77.0.1:5100", "shm://"])
def test_who_cannot_be_asked_announces_itself_each_half_second(url: str) -> None:
    assert connected(url).findtext(".//leaseAnnouncement/nanosec") == "500000000"


def test_who_can_be_asked_announces_itself_as_seldom_as_always() -> None:
    root = connected("udpv4://10.77.0.1:7911?metatraffic_port=7910&multicast=off")
    assert root.findall(".//leaseAnnouncement") == []


def test_over_tcp_data_arrive_at_the_port_inside_a_connection_that_discovery_has() -> None:
    """Fast DDS may lose the request for one: who is discovered is then reached by data, too."""
    root = connected("tcpv4://10.77.0.1:5100")
    lists = ("metatrafficUnicastLocatorList", "defaultUnicastLocatorList")
    (discovery,), (data,) = (locators(root, each) for each in lists)
    assert data == discovery
    assert data["physical_port"] == "5100"


VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"


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
            widen_discovery_buffers(231)
            return before, bound.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)

    before, after = room(ports.discovery_unicast)
    assert after > before
    before, after = room(ports.user_unicast)
    assert after == before
