"""The Fast DDS XML profile of one participant.

Owns: the XML of a participant that must differ from the process's default, made from what the
participant needs, from the default participant profile that is in force anyway (the user's own, or
our quick discovery) and from the discovery that rmw_fastrtps would have set up. Must not import
rclpy; nothing is applied here.

Nothing of a user's profile is changed or lost; where it already chooses transports, choosing others
is refused.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Iterator, Mapping
from xml.etree import ElementTree as ET

from lifecycle import dataclasses
from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds import static_edp, url_profile
from lifecycle.middleware.fastdds.profiles import (
    PROFILE_NAME,
    announced_again,
    announcements,
)
from lifecycle.middleware.fastdds.profiles import child as _child
from lifecycle.middleware.fastdds.profiles import locator as _locator
from lifecycle.middleware.fastdds.profiles import text as _text
from lifecycle.middleware.versions import installed
from lifecycle.network.connection_url import ConnectionUrl
from lifecycle.network.connection_url import parse as parse_url
from lifecycle.network.medium import RMW_DEFAULT, TRANSPORTS_VARIABLE, UDP_UNICAST, Medium
from lifecycle.plan.model import (
    ParticipantConnections,
    PlannedNode,
    StaticEndpoint,
    StaticParticipant,
)

_SKIP_DEFAULT_FILE_VARIABLE = "SKIP_DEFAULT_XML"
_TRANSPORT_CHOICES = ("userTransports", "useBuiltinTransports", "builtinTransports")
DISCOVERY_SERVER_VARIABLE = "ROS_DISCOVERY_SERVER"
"""Makes every participant a client of that server."""


_OFTEN = 60, 50
"""One that is made while we announce ourselves so knows us at once, and not within 3 s."""

_MIN_DATAGRAM_BYTES = 500
_MAX_DATAGRAM_BYTES = 65500
"""s_maximumMessageSize of Fast DDS: what UDP over IPv4 can carry, less some headers."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ParticipantSettings:
    """What a participant needs that the process's default does not give it.

    Attributes:
        transports: all that it may use, UDPV4 and UDPV6; empty leaves it to the RMW, which
            has shared memory and UDP over IPv4. Both means that messages for a peer that has both
            go twice. Inside a process Fast DDS calls functions whatever the transports.
        max_datagram_bytes: largest UDP payload that it sends, 500–65500; longer messages are split
            by RTPS (DATA_FRAG), so that IP has nothing to fragment. 1400 fits an Ethernet frame.
            None leaves it to Fast DDS.
        non_blocking_send: a send that finds the socket's buffer full drops the datagram instead of
            waiting: a reliable writer sends it again, a best effort one has lost it.
        urls: what it is connected to and by; then `transports` must be empty.
        super_client: as a client of a discovery server, receive everything.
        static_participants: whose endpoints are known without being announced, its own too.
        static_name: its own name among them; its context must have it as its enclave.
        announces_often: at first, where a profile of the user's does not say how often.

    Raises:
        MiddlewareError: out of range, or URLs that one participant cannot have together.
    """

    transports: tuple[Medium, ...] = ()
    max_datagram_bytes: int | None = None
    non_blocking_send: bool = False
    urls: tuple[ConnectionUrl, ...] = ()
    super_client: bool = False
    static_participants: tuple[StaticParticipant, ...] = ()
    static_name: str = ""
    announces_often: bool = False

    @classmethod
    def of(
        cls,
        connections: ParticipantConnections,
        *,
        transports: tuple[Medium, ...] = (),
        max_datagram_bytes: int | None = None,
        non_blocking_send: bool = False,
    ) -> ParticipantSettings:
        """Return the settings of a participant that is connected so.

        Raises:
            ConnectionUrlError: a URL that is none.
            MiddlewareError: out of range, or what one participant cannot have together.
        """
        urls = tuple(parse_url(url) for url in connections.urls)
        sizes = [url.max_datagram_bytes for url in urls if url.max_datagram_bytes is not None]
        if max_datagram_bytes is not None:
            sizes.append(max_datagram_bytes)
        return cls(
            transports=transports,
            max_datagram_bytes=min(sizes, default=None),
            non_blocking_send=non_blocking_send,
            urls=urls,
            super_client=connections.super_client,
            static_participants=connections.static_participants,
            static_name=connections.static_name,
        )

    @classmethod
    def of_node(cls, node: PlannedNode) -> ParticipantSettings:
        """Return the settings of a participant that carries a planned node; raises as `of`."""
        return cls.of(
            node.connections,
            transports=node.transports,
            max_datagram_bytes=node.max_datagram_bytes,
        )

    def __post_init__(self) -> None:
        if self.urls and self.transports:
            raise MiddlewareError(
                f"cannot use transports {', '.join(map(repr, self.transports))} beside connection "
                f"URL {str(self.urls[0])!r}: the URLs say which transports there are",
                hint="leave one of them out",
            )
        url_profile.families(self.urls)
        if self.static_participants and not self.urls:
            raise MiddlewareError(
                "cannot discover endpoints statically without connection URLs",
                hint="say where the participants are, udpv4://ADDRESS:PORT?metatraffic_port=…",
            )
        unknown = [each for each in self.transports if each not in UDP_UNICAST]
        if unknown or len(set(self.transports)) != len(self.transports):
            raise MiddlewareError(
                f"cannot use transports {', '.join(map(repr, self.transports))}: allowed are "
                f"{' and '.join(map(repr, UDP_UNICAST))}, each once"
            )
        size = self.max_datagram_bytes
        if size is not None and not _MIN_DATAGRAM_BYTES <= size <= _MAX_DATAGRAM_BYTES:
            raise MiddlewareError(
                f"cannot send datagrams of at most {size} bytes: allowed are "
                f"{_MIN_DATAGRAM_BYTES}–{_MAX_DATAGRAM_BYTES}",
                hint="1400 fits an Ethernet frame",
            )

    @property
    def chooses_transports(self) -> bool:
        """Whether its profile has transport descriptors of its own."""
        return bool(self.transports or self.urls) or self.non_blocking_send

    @property
    def static_endpoints(self) -> tuple[StaticEndpoint, ...]:
        """Its own lines in the table of static discovery; empty without one."""
        own = (each for each in self.static_participants if each.name == self.static_name)
        return next((each.endpoints for each in own), ())

    @property
    def governs_discovery(self) -> bool:
        """Whether nothing else may say where others are looked for."""
        return bool(self.urls) and not url_profile.leaves_discovery_open(self.urls)

    def __bool__(self) -> bool:
        """Whether it needs anything."""
        return (
            self.chooses_transports
            or self.max_datagram_bytes is not None
            or self.announces_often
            or self.super_client
        )


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class DefaultProfile:
    """A participant profile that every participant of the process gets.

    Attributes:
        file: that holds it.
        name: its `profile_name`.
        element: <participant>, without namespaces.
    """

    file: str
    name: str
    element: ET.Element


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
    files = []
    named = (current.get(each) for each in version.profiles_variables)
    files += [each for each in named if each][:1]
    # Not by pathlib: what each host calls is copied into its own memory (docs/performance.md).
    if current.get(_SKIP_DEFAULT_FILE_VARIABLE, "")[:1] != "1" and os.path.exists(
        version.default_profiles
    ):
        files.append(version.default_profiles)
    found = None
    for file in files:
        for element in _default_participants(file):
            name = element.get("profile_name", "")
            found = DefaultProfile(file=file, name=name, element=element)
    return found


def profile(
    name: str,
    settings: ParticipantSettings,
    *,
    base: DefaultProfile | None = None,
    localhost_peers: tuple[str, ...] | None = None,
    domain_id: int = 0,
    environment: Mapping[str, str] | None = None,
) -> str:
    """Return a participant profile as XML: `base` with what `settings` need.

    Args:
        name: unique in the process, of the profile and, as a prefix, of its transports.
        settings: what is needed.
        base: the default profile in force; it is kept but for what is added.
        localhost_peers: where the profile must do what rmw_fastrtps does for
            ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST: no multicast, participants looked for on this
            host and on these static peers. None leaves discovery alone.
        domain_id: 0–232, which URLs with TCP need.
        environment: None for this process's.

    Raises:
        MiddlewareError: `base`, or the environment, already chooses transports.
    """
    if settings.chooses_transports:
        _refuse_second_choice(settings, base, os.environ if environment is None else environment)
    participant = ET.Element("participant") if base is None else copy.deepcopy(base.element)
    participant.attrib = {"profile_name": name}
    rtps = _child(participant, "rtps")
    root = ET.Element("dds", xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles")
    profiles = ET.SubElement(root, "profiles")
    is_users = base is not None and base.name != PROFILE_NAME
    if settings.urls:
        for config in () if is_users else rtps.iter("discovery_config"):
            for period in config.findall("leaseAnnouncement"):
                config.remove(period)  # ours, which some URLs have shorter
        url_profile.add_urls(
            name,
            profiles,
            rtps,
            settings.urls,
            domain_id=domain_id,
            super_client=settings.super_client,
            non_blocking_send=settings.non_blocking_send,
            localhost_peers=localhost_peers,
        )
        if settings.static_participants:
            config = _child(_child(rtps, "builtin"), "discovery_config")
            _text(config, "EDP", "STATIC")
            table = static_edp.endpoint_table(settings.static_participants)
            _text(config, "static_edp_xml_config", f"data://{table}")
    elif settings.chooses_transports:
        # Fast DDS's own default where none is asked for: shared memory and UDP over IPv4.
        kinds = tuple(map(Medium, settings.transports)) or RMW_DEFAULT
        descriptors = ET.SubElement(profiles, "transport_descriptors")
        chosen = ET.SubElement(rtps, "userTransports")
        for kind in kinds:
            # Not maxMessageSize: it is the receive buffer's size as well, and would cut what others
            # send.
            descriptors.append(
                url_profile.descriptor(
                    name,
                    url_profile.UrlTransport(kind=kind, urls=()),
                    non_blocking=settings.non_blocking_send,
                    open_peers=localhost_peers is not None,
                )
            )
            _text(chosen, "transport_id", f"{name}_{kind}")
        _text(rtps, "useBuiltinTransports", "false")
        if localhost_peers is not None:
            _discover_as_localhost(_child(rtps, "builtin"), kinds, localhost_peers)
    if settings.max_datagram_bytes is not None:
        _set_property(rtps, "fastdds.max_message_size", str(settings.max_datagram_bytes))
    _set_discovery(rtps, settings, is_users=is_users)
    profiles.append(participant)
    return ET.tostring(root, encoding="unicode", xml_declaration=True)


def _set_discovery(rtps: ET.Element, settings: ParticipantSettings, *, is_users: bool) -> None:
    for each in rtps.iter("discoveryProtocol") if settings.super_client else ():
        if (each.text or "").strip() == "CLIENT":
            each.text = "SUPER_CLIENT"
    config = rtps.find("builtin/discovery_config/leaseDuration/..")
    if not is_users and config is not None and config.find("leaseAnnouncement") is None:
        config.append(announced_again())
    if is_users or not settings.announces_often:
        return
    config = _child(_child(rtps, "builtin"), "discovery_config")
    for each in config.findall("initialAnnouncements"):
        config.remove(each)
    config.append(announcements(*_OFTEN))


def without_shared_memory(environment: Mapping[str, str]) -> tuple[Medium, ...]:
    """Return Fast DDS's default transports but for shared memory; none where others are chosen.

    An observer of the graph needs no shared memory, and a process that is killed while it holds the
    mutex of a port there blocks each process that sends to it for 10 s at a time.

    Args:
        environment: of this process.

    Raises:
        MiddlewareError: a file of profiles cannot be read, or is no XML.
    """
    if environment.get(TRANSPORTS_VARIABLE) or _chosen(default_profile(environment)):
        return ()
    return tuple(each for each in RMW_DEFAULT if each.is_udp)


def _chosen(base: DefaultProfile | None) -> list[str]:
    """Return the elements by which a profile chooses transports."""
    rtps = None if base is None else base.element.find("rtps")
    return [] if rtps is None else [each.tag for each in rtps if each.tag in _TRANSPORT_CHOICES]


def _refuse_second_choice(
    settings: ParticipantSettings, base: DefaultProfile | None, environment: Mapping[str, str]
) -> None:
    wish = " and ".join(settings.transports or map(str, settings.urls)) or "a non-blocking send"
    chosen = _chosen(base)
    if base is not None and chosen:
        raise MiddlewareError(
            f"cannot give a participant {wish}: the default participant profile {base.name!r} "
            f"of {base.file!r} already chooses its transports (<{chosen[0]}>)",
            hint=f"take <{chosen[0]}> out of it, or what needs {wish} out of the manifest",
        )
    variable = environment.get(TRANSPORTS_VARIABLE, "")
    if variable and not settings.transports and not settings.urls:
        raise MiddlewareError(
            f"cannot give a participant {wish}: {TRANSPORTS_VARIABLE}={variable!r} "
            "already chooses its transports",
            hint=f"unset it, or say {TRANSPORTS_VARIABLE}={variable}?non_blocking=true",
        )


def _discover_as_localhost(
    builtin: ET.Element, kinds: tuple[Medium, ...], peers: tuple[str, ...]
) -> None:
    """Do what rmw_fastrtps's create_participant does for LOCALHOST, per transport."""
    families = [kind for kind in kinds if kind.is_udp]
    for multicast in builtin.findall("metatrafficMulticastLocatorList"):
        builtin.remove(multicast)
    # A unicast locator without address and port means "any" and keeps multicast from being added.
    listened = _child(builtin, "metatrafficUnicastLocatorList")
    for family in families:
        _locator(listened, family, "", None)
    searched = _child(builtin, "initialPeersList")
    for peer in peers:
        for family in families:
            if url_profile.may_be(peer, family):
                _locator(searched, family, peer, None)
    for family in families:
        _locator(searched, family, family.loopback, None)


def _set_property(rtps: ET.Element, name: str, value: str) -> None:
    properties = _child(_child(rtps, "propertiesPolicy"), "properties")
    for each in properties.findall("property"):
        if (each.findtext("name") or "").strip() == name:
            properties.remove(each)
    element = ET.SubElement(properties, "property")
    _text(element, "name", name)
    _text(element, "value", value)


def _default_participants(file: str) -> Iterator[ET.Element]:
    try:
        with open(file, "rb") as opened:  # noqa: PTH123
            root = ET.fromstring(opened.read())  # noqa: S314 - Fast DDS itself trusts this file
    except OSError as error:
        raise MiddlewareError(f"cannot read profiles {file!r}: {error.strerror}") from error
    except ET.ParseError as error:
        raise MiddlewareError(f"cannot read profiles {file!r}: {error}") from error
    for element in root.iter():
        # Fast DDS does not look at namespaces; with them, no name would be found here.
        if isinstance(element.tag, str):
            element.tag = element.tag.rpartition("}")[2]
    for element in root.iter("participant"):
        if element.get("is_default_profile") == "true":
            yield element
