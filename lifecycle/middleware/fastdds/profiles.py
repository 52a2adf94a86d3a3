"""Fast DDS participant profiles applied through the environment, and the XML elements of profiles.

Owns: the quick discovery profile, and text elements and locators as Fast DDS's XML parser reads
them. Must not import rclpy.

Fast DDS announces a new participant five times at 100 ms and then once each 3 s; where those five
are lost or arrive too early, discovery stalls. Announcements for 2 s remove the stall, and later
ones each second the same for who is started again. One that is dropped without a word (its process
was killed, its link is cut) is there for its lease: 20 s by default. The environment is used, not
Fast DDS's C++ API: the children of a supervisor, whatever they are written in, inherit it.

Endpoints are sent to each participant by itself unless a profile asks for multicast
(`avoid_builtin_multicast`): of fifty processes on one host, each endpoint and each heartbeat fifty
times (docs/performance.md has the measurement).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from xml.etree import ElementTree as ET

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.versions import DISTRIBUTIONS, installed
from lifecycle.network.medium import Medium, udp_to

PROFILE_NAME = "lifecycle_quick_discovery"
_FILE_NAME = "quick_discovery.xml"


_ANNOUNCEMENTS = 10
_PERIOD_NS = 200_000_000

LEASE_S = 10
"""As long as a machine may be too busy for a participant to announce itself, or to take it in."""

_BY_MULTICAST = "<avoid_builtin_multicast>false</avoid_builtin_multicast>"

_ONE_SAMPLE = (
    "<topic><resourceLimitsQos><allocated_samples>1</allocated_samples></resourceLimitsQos></topic>"
)
"""A service takes 47 KiB and not 104 KiB: histories grow to their depth when they are used."""

_AGAIN_S = 1
"""Who was there before and who was started again know each other within so long."""


def discovery_profile(
    *, peers: Iterable[tuple[str, int]] = (), multicast_endpoints: bool = False
) -> str:
    """Return the profile as XML: it sets discovery, and how many samples are allocated ahead.

    Args:
        peers: IP addresses and UDP ports that it is announced to; all of them, because they replace
            the groups by which Fast DDS otherwise does.
        multicast_endpoints: endpoints are sent once by multicast to all participants that listen to
            it, and not to each. Only where all that have to find each other are on this host:
            routers pass no multicast, and WLANs send it slowly.
    """
    locators = "".join(
        f"<locator><{kind}><address>{address}</address><port>{port}</port></{kind}></locator>"
        for address, port in peers
        for kind in (udp_to(address),)
    )
    searched = f"<initialPeersList>{locators}</initialPeersList>" if locators else ""
    multicast = _BY_MULTICAST if multicast_endpoints else ""
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <profiles>
    <participant profile_name="{PROFILE_NAME}" is_default_profile="true">
      <rtps><builtin><discovery_config><initialAnnouncements>
        <count>{_ANNOUNCEMENTS}</count>
        <period><nanosec>{_PERIOD_NS}</nanosec></period>
      </initialAnnouncements>
      <leaseDuration><sec>{LEASE_S}</sec></leaseDuration>
      <leaseAnnouncement><sec>{_AGAIN_S}</sec></leaseAnnouncement>
      </discovery_config>{multicast}{searched}</builtin></rtps>
    </participant>
    <data_writer profile_name="lifecycle_writer" is_default_profile="true">
      {_ONE_SAMPLE}
    </data_writer>
    <data_reader profile_name="lifecycle_reader" is_default_profile="true">
      {_ONE_SAMPLE}
    </data_reader>
  </profiles>
</dds>
"""


def discovery_environment(
    directory: Path,
    environment: Mapping[str, str] | None = None,
    *,
    peers: Iterable[tuple[str, int]] = (),
    multicast_endpoints: bool = False,
) -> dict[str, str]:
    """Write the profile into `directory` and return the variables that apply it.

    They count for participants created after they are set. A profile of the user's own is never
    replaced: then nothing is written and the result is empty.

    Args:
        directory: exists; it must outlive every process that is given the variables.
        environment: what those processes otherwise get; None for this process's.
        peers: see `discovery_profile`.
        multicast_endpoints: see `discovery_profile`.

    Raises:
        MiddlewareError: the file cannot be written.
    """
    current = os.environ if environment is None else environment
    version = installed()
    variables = (each.profiles_variable for each in DISTRIBUTIONS)
    if any(map(current.get, variables)) or Path(version.default_profiles).exists():
        return {}
    path = directory.absolute() / _FILE_NAME
    # Renamed into place: a process that starts meanwhile reads the whole file or an older one.
    part = path.with_name(f".{_FILE_NAME}.{os.getpid()}")
    try:
        xml = discovery_profile(peers=peers, multicast_endpoints=multicast_endpoints)
        part.write_text(xml, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        raise MiddlewareError(
            f"cannot write the discovery profile {str(path)!r}: {error.strerror}"
        ) from error
    return {version.profiles_variable: str(path)}


def announcements(count: int, period_ms: int) -> ET.Element:
    """Return how often a participant announces itself at first."""
    element = ET.Element("initialAnnouncements")
    text(element, "count", str(count))
    text(child(element, "period"), "nanosec", str(period_ms * 1_000_000))
    return element


def announced_again() -> ET.Element:
    """Return how often a participant announces itself later."""
    element = ET.Element("leaseAnnouncement")
    text(element, "sec", str(_AGAIN_S))
    return element


def child(parent: ET.Element, tag: str) -> ET.Element:
    """Return the first child of this name; made if there is none."""
    found = parent.find(tag)
    return ET.SubElement(parent, tag) if found is None else found


def text(parent: ET.Element, tag: str, content: str) -> None:
    """Add a child with text."""
    ET.SubElement(parent, tag).text = content


def locator(parent: ET.Element, kind: Medium, address: str, port: int | None) -> None:
    """Add a UDP locator to a list.

    Args:
        parent: the list.
        kind: UDPV4 or UDPV6.
        address: empty for any.
        port: None for the well-known one.
    """
    element = ET.SubElement(ET.SubElement(parent, "locator"), kind.value)
    if address:
        text(element, "address", address)
    if port is not None:
        text(element, "port", str(port))


def tcp_locator(
    parent: ET.Element, kind: Medium, address: str, physical: int | None, logical: int | None
) -> None:
    """Add a TCP locator to a list.

    Args:
        parent: the list.
        kind: TCPV4.
        address: empty for any.
        physical: the port that is listened on; None for the transport's.
        logical: the port inside the connection, which Fast DDS separates traffic by; None for
            the well-known ones.
    """
    element = ET.SubElement(ET.SubElement(parent, "locator"), kind.value)
    if address:
        text(element, "address", address)
    if physical is not None:
        text(element, "physical_port", str(physical))
    if logical is not None:
        text(element, "port", str(logical))
