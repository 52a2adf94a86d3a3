"""Connection URLs in a profile: transports, locators, discovery, and what is refused."""

from __future__ import annotations

from xml.etree import ElementTree as ET

import pytest

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.profiles import ParticipantSettings, profile
from lifecycle.plan.model import ParticipantConnections


def made(*urls: str, super_client: bool = False) -> ET.Element:
    connections = ParticipantConnections(urls=urls, super_client=super_client)
    settings = ParticipantSettings(connections=connections)
    text = profile("p", settings, domain_id=3)
    return ET.fromstring(text.replace(' xmlns="http://www.eprosima.com', ' x="'))


def locators(root: ET.Element, path: str) -> list[dict[str, str]]:
    return [
        {"kind": each.tag, **{value.tag: value.text or "" for value in each}}
        for each in root.findall(f".//{path}/locator/*")
    ]


@pytest.mark.parametrize(("super_client", "protocol"), [(True, "SUPER_CLIENT"), (False, "CLIENT")])
def test_several_servers_count_their_prefix_up(super_client: bool, protocol: str) -> None:
    root = made(
        "tcpv4://10.77.0.1:5101?server=10.77.0.3:42100&server=10.77.0.4:42100",
        super_client=super_client,
    )
    assert root.findtext(".//discoveryProtocol") == protocol
    prefixes = [each.get("prefix") for each in root.findall(".//RemoteServer")]
    assert prefixes == [f"44.53.0{n}.5f.45.50.52.4f.53.49.4d.41" for n in (0, 1)]


def test_urls_that_one_participant_cannot_have_together_are_refused() -> None:
    with pytest.raises(MiddlewareError, match="cannot use 'shm://' beside 'udpv4://:7911'"):
        made("shm://", "udpv4://:7911")


@pytest.mark.parametrize("url", ["tcpv4://10.77.0.1:5100", "shm://"])
def test_who_cannot_be_asked_announces_itself_each_half_second(url: str) -> None:
    assert made(url).findtext(".//leaseAnnouncement/nanosec") == "500000000"


def test_who_can_be_asked_announces_itself_as_seldom_as_always() -> None:
    root = made("udpv4://10.77.0.1:7911?metatraffic_port=7910&multicast=off")
    assert root.findall(".//leaseAnnouncement") == []


def test_over_tcp_data_arrive_at_the_port_inside_a_connection_that_discovery_has() -> None:
    """Fast DDS may lose the request for one: who is discovered is then reached by data, too."""
    root = made("tcpv4://10.77.0.1:5100")
    lists = ("metatrafficUnicastLocatorList", "defaultUnicastLocatorList")
    (discovery,), (data,) = (locators(root, each) for each in lists)
    assert data == discovery
    assert data["physical_port"] == "5100"
