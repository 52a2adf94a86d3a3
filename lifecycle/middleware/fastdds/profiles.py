"""XML profiles of Fast DDS: what `up` gives its processes, the user's, one for a participant.

Owns: the quick discovery profile, which an environment variable applies so that children in any
language inherit it; the default participant profile that is in force; the profile of a participant
that needs more, which is that one with more added; and the table of static endpoint discovery
(STATIC EDP), whose lines the planner numbers. Nothing is applied here. Must not import rclpy.

By default Fast DDS announces a new participant five times at 100 ms and then each 3 s, and sends
endpoints to each participant by itself (docs/performance.md has the measurements).
"""

from __future__ import annotations

import copy
import functools
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree as ET

import msgspec

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.url_profile import (
    UrlTransport,
    add_transports,
    child,
    families,
    leaves_discovery_open,
    put,
)
from lifecycle.middleware.versions import DISTRIBUTIONS, installed
from lifecycle.network.connection_url import ConnectionUrl
from lifecycle.network.connection_url import parse as parse_url
from lifecycle.network.medium import RMW_DEFAULT, TRANSPORTS_VARIABLE, Medium, udp_to
from lifecycle.plan.model import (
    ParticipantConnections,
    PlannedNode,
    PlannedParticipant,
    StaticEndpoint,
    StaticParticipant,
)

PROFILE_NAME = "lifecycle_quick_discovery"
DISCOVERY_SERVER_VARIABLE = "ROS_DISCOVERY_SERVER"
"""Makes every participant a client of that server."""
RANGE_VARIABLE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
PEERS_VARIABLE = "ROS_STATIC_PEERS"
_FILE_NAME = "quick_discovery.xml"
_SKIP_DEFAULT_FILE_VARIABLE = "SKIP_DEFAULT_XML"
_NAMESPACE = "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"

PARTICIPANT_LEASE_S = 10
"""The lease in what `up` starts: as long as a machine may be too busy for it to announce itself."""

_ONE_SAMPLE = (
    "<topic><resourceLimitsQos><allocated_samples>1</allocated_samples></resourceLimitsQos></topic>"
)
"""A service takes 47 KiB and not 104 KiB: histories grow to their depth when they are used."""


def discovery_profile(
    *, peers: Iterable[tuple[str, int]] = (), multicast_endpoints: bool = False
) -> str:
    """Return the quick discovery profile: discovery, and how many samples are allocated ahead.

    Args:
        peers: IP addresses and UDP ports that participants are announced to; all of them, because
            they replace the groups by which Fast DDS otherwise does.
        multicast_endpoints: endpoints are sent once by multicast, and not to each participant. Only
            where all that have to find each other are on this host: routers pass no multicast.
    """
    locators = "".join(
        f"<locator><{kind}><address>{address}</address><port>{port}</port></{kind}></locator>"
        for address, port in peers
        for kind in (udp_to(address),)
    )
    searched = f"<initialPeersList>{locators}</initialPeersList>" if locators else ""
    multicast = "<avoid_builtin_multicast>false</avoid_builtin_multicast>"
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="{_NAMESPACE}">
  <profiles>
    <participant profile_name="{PROFILE_NAME}" is_default_profile="true">
      <rtps><builtin><discovery_config><initialAnnouncements>
        <count>10</count>
        <period><nanosec>200000000</nanosec></period>
      </initialAnnouncements>
      <leaseDuration><sec>{PARTICIPANT_LEASE_S}</sec></leaseDuration>
      <leaseAnnouncement><sec>1</sec></leaseAnnouncement>
      </discovery_config>{multicast if multicast_endpoints else ""}{searched}</builtin></rtps>
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
    directory: Path, *, peers: Iterable[tuple[str, int]] = (), multicast_endpoints: bool = False
) -> dict[str, str]:
    """Write the quick discovery profile into `directory` and return the variables that apply it.

    They count for participants created after they are set, while the directory is there. A profile
    of the user's own is never replaced: then nothing is written and the result is empty.

    Raises:
        MiddlewareError: the file cannot be written.
    """
    version = installed()
    variables = (each.profiles_variable for each in DISTRIBUTIONS)
    if any(map(os.environ.get, variables)) or Path(version.default_profiles).exists():
        return {}
    path = directory.absolute() / _FILE_NAME
    try:
        xml = discovery_profile(peers=peers, multicast_endpoints=multicast_endpoints)
        path.write_text(xml, encoding="utf-8")
    except OSError as error:
        raise MiddlewareError(
            f"cannot write the discovery profile {str(path)!r}: {error.strerror}"
        ) from error
    return {version.profiles_variable: str(path)}


class DefaultProfile(msgspec.Struct, frozen=True, kw_only=True):
    """A participant profile that every participant of the process gets.

    Attributes:
        file: that holds it.
        name: its `profile_name`.
        element: <participant>, without namespaces.
    """

    file: str
    name: str
    element: ET.Element

    @property
    def is_users(self) -> bool:
        """Whether it is not the quick discovery profile."""
        return self.name != PROFILE_NAME

    @property
    def chosen_transports(self) -> str:
        """The element by which it chooses transports; empty if it chooses none."""
        choices = ("userTransports", "useBuiltinTransports", "builtinTransports")
        return next(
            (each.tag for each in self.element.iterfind("rtps/*") if each.tag in choices), ""
        )


def default_profile(environment: Mapping[str, str] | None = None) -> DefaultProfile | None:
    """Return the default participant profile that Fast DDS loads; None if there is none.

    It reads the file that FASTRTPS_DEFAULT_PROFILES_FILE (Fast DDS 3: FASTDDS_…) names and then,
    unless SKIP_DEFAULT_XML=1, DEFAULT_FASTRTPS_PROFILES.xml (DEFAULT_FASTDDS_…) of the working
    directory; the last default profile counts.

    Args:
        environment: None for this process's.

    Raises:
        MiddlewareError: a file cannot be read, or is no XML.
    """
    current = os.environ if environment is None else environment
    version = installed()
    files = [each for each in map(current.get, version.profiles_variables) if each][:1]
    skipped = current.get(_SKIP_DEFAULT_FILE_VARIABLE, "").startswith("1")
    if not skipped and Path(version.default_profiles).exists():
        files.append(version.default_profiles)
    found = None
    for file in files:
        try:
            root = ET.fromstring(Path(file).read_bytes())  # noqa: S314 - Fast DDS trusts it, too
        except OSError as error:
            raise MiddlewareError(f"cannot read profiles {file!r}: {error.strerror}") from error
        except ET.ParseError as error:
            raise MiddlewareError(f"cannot read profiles {file!r}: {error}") from error
        for each in root.iter():
            # Fast DDS does not look at namespaces; with them, no name would be found here.
            if isinstance(each.tag, str):
                each.tag = each.tag.rpartition("}")[2]
        for each in root.iter("participant"):
            if each.get("is_default_profile") == "true":
                name = each.get("profile_name", "")
                found = DefaultProfile(file=file, name=name, element=each)
    return found


_OFTEN, _OFTEN_NS = 60, 50_000_000
"""One that is made while an observer announces itself so knows it at once, and not within 3 s."""

_CONNECTING_NS = 500_000_000
"""Over TCP Fast DDS 2.14 sends nothing while a connection or a port in it is being agreed on, and
dials again only when there is something to send: what gets lost so comes with the next
announcement, or with the one after it."""

_CONFIG = "builtin/discovery_config"


class ParticipantSettings(msgspec.Struct, frozen=True, kw_only=True, dict=True):
    """What a participant needs that the process's default does not give it.

    Attributes:
        transports: all that it may use, UDPV4 and UDPV6; empty leaves it to the RMW, which
            has shared memory and UDP over IPv4.
        max_datagram_bytes: largest UDP payload that it sends, 500–65500; longer messages are split
            by RTPS (DATA_FRAG). None leaves it to Fast DDS.
        non_blocking_send: a send that finds the socket's buffer full drops the datagram instead of
            waiting: a reliable writer sends it again, a best effort one has lost it.
        connections: what it is connected to and by; with URLs `transports` must be empty, and its
            context must have `static_name` as its enclave.
        announces_often: at first, where a profile of the user's does not say how often.

    Raises:
        ConnectionUrlError: a URL that is none.
        MiddlewareError: URLs that one participant cannot have together.
    """

    transports: tuple[Medium, ...] = ()
    max_datagram_bytes: int | None = None
    non_blocking_send: bool = False
    connections: ParticipantConnections = ParticipantConnections()
    announces_often: bool = False

    @classmethod
    def of(cls, planned: PlannedNode | PlannedParticipant) -> ParticipantSettings:
        """Return the settings of a participant that carries a planned node, or is planned itself.

        Raises:
            ConnectionUrlError: a URL that is none.
            MiddlewareError: what one participant cannot have together.
        """
        extra = planned if isinstance(planned, PlannedParticipant) else None
        return cls(
            transports=planned.transports,
            max_datagram_bytes=extra.max_datagram_bytes if extra else None,
            non_blocking_send=extra is not None and extra.non_blocking_send,
            connections=planned.connections,
        )

    def __post_init__(self) -> None:
        families(self.urls)

    @functools.cached_property
    def urls(self) -> tuple[ConnectionUrl, ...]:
        """Those of its connections."""
        return tuple(map(parse_url, self.connections.urls))

    @property
    def chooses_transports(self) -> bool:
        """Whether its profile has transport descriptors of its own."""
        return bool(self.transports or self.urls) or self.non_blocking_send

    @property
    def static_endpoints(self) -> tuple[StaticEndpoint, ...]:
        """Its own lines in the table of static discovery; empty without one."""
        by_name = {each.name: each.endpoints for each in self.connections.static_participants}
        return by_name.get(self.connections.static_name, ())

    @property
    def governs_discovery(self) -> bool:
        """Whether nothing else may say where others are looked for."""
        return bool(self.urls) and not leaves_discovery_open(self.urls)

    def __bool__(self) -> bool:
        """Whether it needs anything."""
        return (
            self.chooses_transports
            or self.max_datagram_bytes is not None
            or self.announces_often
            or self.connections.super_client
        )


def profile(
    name: str,
    settings: ParticipantSettings,
    *,
    base: DefaultProfile | None = None,
    localhost_peers: tuple[str, ...] | None = None,
    domain_id: int = 0,
) -> str:
    """Return a participant profile as XML: `base` with what `settings` need.

    Nothing of a user's profile is changed or lost.

    Args:
        name: unique in the process, of the profile and, as a prefix, of its transports.
        settings: what is needed.
        base: the default profile in force.
        localhost_peers: where the profile must do what rmw_fastrtps does for
            ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST: no multicast, participants looked for on this
            host and on these static peers. None leaves discovery alone.
        domain_id: 0–232, which URLs with TCP need.

    Raises:
        MiddlewareError: `base`, or the environment, already chooses transports.
    """
    participant = ET.Element("participant") if base is None else copy.deepcopy(base.element)
    participant.attrib = {"profile_name": name}
    rtps = child(participant, "rtps")
    root = ET.Element("dds", xmlns=_NAMESPACE)
    profiles = ET.SubElement(root, "profiles")
    if settings.chooses_transports:
        _refuse_second_choice(settings, base)
        kinds = settings.transports or RMW_DEFAULT
        add_transports(
            name,
            profiles,
            rtps,
            families(settings.urls) or [UrlTransport(kind=Medium(each)) for each in kinds],
            domain_id=domain_id,
            non_blocking_send=settings.non_blocking_send,
            localhost_peers=localhost_peers,
        )
    if table := settings.connections.static_participants:
        put(rtps, f"{_CONFIG}/EDP", "STATIC")
        put(rtps, f"{_CONFIG}/static_edp_xml_config", f"data://{endpoint_table(table)}")
    if settings.max_datagram_bytes is not None:
        # Not maxMessageSize of a transport: it is the receive buffer's size as well, and would cut
        # what others send.
        _set_property(rtps, "fastdds.max_message_size", str(settings.max_datagram_bytes))
    for each in rtps.iter("discoveryProtocol") if settings.connections.super_client else ():
        if (each.text or "").strip() == "CLIENT":
            each.text = "SUPER_CLIENT"
    is_users = base is not None and base.is_users
    if settings.announces_often and not is_users:
        put(rtps, f"{_CONFIG}/initialAnnouncements/count", _OFTEN)
        put(rtps, f"{_CONFIG}/initialAnnouncements/period/nanosec", _OFTEN_NS)
    again = f"{_CONFIG}/leaseAnnouncement"
    connects = not all(url.transport.is_udp for url in settings.urls)
    if connects and not (is_users and rtps.find(again) is not None):
        put(rtps, f"{again}/sec", 0)
        put(rtps, f"{again}/nanosec", _CONNECTING_NS)
    profiles.append(participant)
    return ET.tostring(root, encoding="unicode", xml_declaration=True)


def _refuse_second_choice(settings: ParticipantSettings, base: DefaultProfile | None) -> None:
    wish = " and ".join(settings.transports or map(str, settings.urls)) or "a non-blocking send"
    if base is not None and (chosen := base.chosen_transports):
        raise MiddlewareError(
            f"cannot give a participant {wish}: the default participant profile {base.name!r} "
            f"of {base.file!r} already chooses its transports (<{chosen}>)",
            hint=f"take <{chosen}> out of it, or what needs {wish} out of the manifest",
        )
    variable = os.environ.get(TRANSPORTS_VARIABLE, "")
    if variable and not settings.transports and not settings.urls:
        raise MiddlewareError(
            f"cannot give a participant {wish}: {TRANSPORTS_VARIABLE}={variable!r} "
            "already chooses its transports",
            hint=f"unset it, or say {TRANSPORTS_VARIABLE}={variable}?non_blocking=true",
        )


def _set_property(rtps: ET.Element, name: str, value: str) -> None:
    properties = child(child(rtps, "propertiesPolicy"), "properties")
    for each in properties.findall("property"):
        if (each.findtext("name") or "").strip() == name:
            properties.remove(each)
    element = ET.SubElement(properties, "property")
    put(element, "name", name)
    put(element, "value", value)


def endpoint_table(participants: Sequence[StaticParticipant]) -> str:
    """Return the endpoints that participants know without announcing them, <staticdiscovery>.

    Participants still announce themselves, and in that which lines of the table exist.
    """
    root = ET.Element("staticdiscovery")
    for participant in participants:
        element = ET.SubElement(root, "participant")
        put(element, "name", participant.name)
        for endpoint in participant.endpoints:
            line = ET.SubElement(element, "writer" if endpoint.writer else "reader")
            put(line, "userId", endpoint.user_id)
            put(line, "topicName", endpoint.topic)
            put(line, "topicDataType", endpoint.type)
            put(line, "topicKind", "NO_KEY")
            reliability = "RELIABLE" if endpoint.reliable else "BEST_EFFORT"
            put(line, "reliabilityQos", f"{reliability}_RELIABILITY_QOS")
            durability = "TRANSIENT_LOCAL" if endpoint.transient_local else "VOLATILE"
            put(line, "durabilityQos", f"{durability}_DURABILITY_QOS")
    return ET.tostring(root, encoding="unicode")


def endpoint_profiles(endpoints: Sequence[StaticEndpoint]) -> str:
    """Return profiles that give endpoints the ids of their lines in the table."""
    root = ET.Element("dds", xmlns=_NAMESPACE)
    profiles = ET.SubElement(root, "profiles")
    for endpoint in endpoints:
        tag = "data_writer" if endpoint.writer else "data_reader"
        element = ET.SubElement(profiles, tag, profile_name=endpoint.profile)
        put(element, "userDefinedID", endpoint.user_id)
    return ET.tostring(root, encoding="unicode", xml_declaration=True)
