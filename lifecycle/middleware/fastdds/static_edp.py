"""Static endpoint discovery (STATIC EDP) of Fast DDS: its table and the profiles of endpoints.

Owns: for endpoints that participants know without announcing them, the table of all participants'
endpoints, and the endpoint profiles that tie an endpoint to its line of the table. Participants
still announce themselves, and in that which lines of the table exist: who they are and where is
announced, what they publish is not. The planner numbers the lines (lifecycle.plan). Must not import
rclpy.
"""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree import ElementTree as ET

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.profiles import put
from lifecycle.plan.model import StaticEndpoint, StaticParticipant


def endpoint_table(participants: Sequence[StaticParticipant]) -> str:
    """Return the table as XML, <staticdiscovery>."""
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
    root = ET.Element("dds", xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles")
    profiles = ET.SubElement(root, "profiles")
    for endpoint in endpoints:
        tag = "data_writer" if endpoint.writer else "data_reader"
        element = ET.SubElement(profiles, tag, profile_name=endpoint.profile)
        put(element, "userDefinedID", endpoint.user_id)
    return ET.tostring(root, encoding="unicode", xml_declaration=True)


def check_endpoint(
    endpoints: Sequence[StaticEndpoint], *, writer: bool, profile: str, type_name: str
) -> None:
    """Refuse an endpoint that is about to be made and that no participant would ever find.

    Args:
        endpoints: the participant's lines in the table.
        writer: a writer, else a reader.
        profile: the fully qualified topic name.
        type_name: DDS name of its type.

    Raises:
        MiddlewareError: the table does not have it.
    """
    same_end = [each for each in endpoints if each.writer is writer]
    if any((each.profile, each.type) == (profile, type_name) for each in same_end):
        return
    what = "writers" if writer else "readers"
    listed = ", ".join(f"{each.profile} ({each.type})" for each in same_end)
    raise MiddlewareError(
        f"cannot make a {what[:-1]} of {profile!r} ({type_name}): the table of static discovery "
        f"has only these {what} for this participant: {listed or 'none'}",
        hint="declare the endpoint, and check or plan again",
    )
