"""The Fast DDS profile of one participant that must differ from the process's default.

Owns: what such a participant needs, and its XML: the default participant profile in force (the
user's own, or our quick discovery) with that added. Must not import rclpy; nothing is applied here.

Nothing of a user's profile is changed or lost; where it already chooses transports, choosing others
is refused.
"""

from __future__ import annotations

import copy
import functools
import os
from xml.etree import ElementTree as ET

import msgspec

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.profiles import DefaultProfile, child, put
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
    PlannedParticipant,
    StaticEndpoint,
)

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
        MiddlewareError: URLs that one participant cannot have together, or transports beside them.
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
        return cls(
            transports=planned.transports,
            max_datagram_bytes=planned.max_datagram_bytes,
            non_blocking_send=isinstance(planned, PlannedParticipant) and planned.non_blocking_send,
            connections=planned.connections,
        )

    def __post_init__(self) -> None:
        if self.urls and self.transports:
            raise MiddlewareError(
                f"cannot use transports {', '.join(map(repr, self.transports))} beside connection "
                f"URL {str(self.urls[0])!r}: the URLs say which transports there are",
                hint="leave one of them out",
            )
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

    Args:
        name: unique in the process, of the profile and, as a prefix, of its transports.
        settings: what is needed.
        base: the default profile in force; it is kept but for what is added.
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
    root = ET.Element("dds", xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles")
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
    sizes = (settings.max_datagram_bytes, *(url.max_datagram_bytes for url in settings.urls))
    if given := [each for each in sizes if each is not None]:
        # Not maxMessageSize of a transport: it is the receive buffer's size as well, and would cut
        # what others send.
        _set_property(rtps, "fastdds.max_message_size", str(min(given)))
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
