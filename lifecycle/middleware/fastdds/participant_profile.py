"""The Fast DDS profile of one participant that must differ from the process's default.

Owns: what such a participant needs, and its XML: the default participant profile in force (the
user's own, or our quick discovery) with that added. Must not import rclpy; nothing is applied here.

Nothing of a user's profile is changed or lost; where it already chooses transports, choosing others
is refused.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping
from xml.etree import ElementTree as ET

import msgspec

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.profiles import DefaultProfile, child, drop, text
from lifecycle.middleware.fastdds.static_edp import endpoint_table
from lifecycle.middleware.fastdds.url_profile import (
    UrlTransport,
    add_transports,
    families,
    leaves_discovery_open,
)
from lifecycle.network.connection_url import ConnectionUrl
from lifecycle.network.connection_url import parse as parse_url
from lifecycle.network.medium import RMW_DEFAULT, TRANSPORTS_VARIABLE, Medium
from lifecycle.plan.model import (
    ParticipantConnections,
    PlannedNode,
    StaticEndpoint,
    StaticParticipant,
)

_OFTEN, _OFTEN_NS = 60, 50_000_000
"""One that is made while an observer announces itself so knows it at once, and not within 3 s."""

_CONNECTING_NS = 500_000_000
"""Over TCP Fast DDS 2.14 sends nothing while a connection or a port in it is being agreed on, and
dials again only when there is something to send: what gets lost so comes with the next
announcement, or with the one after it."""


class ParticipantSettings(msgspec.Struct, frozen=True, kw_only=True):
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
        MiddlewareError: URLs that one participant cannot have together, or transports beside them.
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
            MiddlewareError: what one participant cannot have together.
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
        families(self.urls)

    @property
    def chooses_transports(self) -> bool:
        """Whether its profile has transport descriptors of its own."""
        return bool(self.transports or self.urls) or self.non_blocking_send

    @property
    def transports_to_have(self) -> tuple[UrlTransport, ...]:
        """What its profile describes: those of its URLs, or Fast DDS's default where none is asked.

        The default is shared memory and UDP over IPv4.
        """
        kinds = self.transports or RMW_DEFAULT
        return families(self.urls) or tuple(UrlTransport(kind=Medium(each)) for each in kinds)

    @property
    def static_endpoints(self) -> tuple[StaticEndpoint, ...]:
        """Its own lines in the table of static discovery; empty without one."""
        own = (each for each in self.static_participants if each.name == self.static_name)
        return next((each.endpoints for each in own), ())

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
            or self.super_client
        )


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
    participant = ET.Element("participant") if base is None else copy.deepcopy(base.element)
    participant.attrib = {"profile_name": name}
    rtps = child(participant, "rtps")
    root = ET.Element("dds", xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles")
    profiles = ET.SubElement(root, "profiles")
    if settings.chooses_transports:
        _refuse_second_choice(settings, base, os.environ if environment is None else environment)
        add_transports(
            name,
            profiles,
            rtps,
            settings.transports_to_have,
            domain_id=domain_id,
            super_client=settings.super_client,
            non_blocking_send=settings.non_blocking_send,
            localhost_peers=localhost_peers,
        )
    if settings.static_participants:
        config = child(child(rtps, "builtin"), "discovery_config")
        text(config, "EDP", "STATIC")
        table = endpoint_table(settings.static_participants)
        text(config, "static_edp_xml_config", f"data://{table}")
    if settings.max_datagram_bytes is not None:
        # Not maxMessageSize of a transport: it is the receive buffer's size as well, and would cut
        # what others send.
        _set_property(rtps, "fastdds.max_message_size", str(settings.max_datagram_bytes))
    for each in rtps.iter("discoveryProtocol") if settings.super_client else ():
        if (each.text or "").strip() == "CLIENT":
            each.text = "SUPER_CLIENT"
    _set_announcements(rtps, settings, is_users=base is not None and base.is_users)
    profiles.append(participant)
    return ET.tostring(root, encoding="unicode", xml_declaration=True)


def _set_announcements(rtps: ET.Element, settings: ParticipantSettings, *, is_users: bool) -> None:
    if settings.announces_often and not is_users:
        config = child(child(rtps, "builtin"), "discovery_config")
        drop(config, "initialAnnouncements")
        often = ET.SubElement(config, "initialAnnouncements")
        text(often, "count", str(_OFTEN))
        text(ET.SubElement(often, "period"), "nanosec", str(_OFTEN_NS))
    if not all(url.transport.is_udp for url in settings.urls):
        config = child(child(rtps, "builtin"), "discovery_config")
        if not (is_users and config.find("leaseAnnouncement") is not None):
            drop(config, "leaseAnnouncement")
            again = ET.SubElement(config, "leaseAnnouncement")
            text(again, "nanosec", str(_CONNECTING_NS))


def _refuse_second_choice(
    settings: ParticipantSettings, base: DefaultProfile | None, environment: Mapping[str, str]
) -> None:
    wish = " and ".join(settings.transports or map(str, settings.urls)) or "a non-blocking send"
    if base is not None and (chosen := base.chosen_transports):
        raise MiddlewareError(
            f"cannot give a participant {wish}: the default participant profile {base.name!r} "
            f"of {base.file!r} already chooses its transports (<{chosen}>)",
            hint=f"take <{chosen}> out of it, or what needs {wish} out of the manifest",
        )
    variable = environment.get(TRANSPORTS_VARIABLE, "")
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
    text(element, "name", name)
    text(element, "value", value)
