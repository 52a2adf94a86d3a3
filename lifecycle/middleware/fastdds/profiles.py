"""Default participant profiles of Fast DDS: the one that `up` gives its processes, and the user's.

Owns: the quick discovery profile, which is applied by an environment variable so that children in
any language inherit it; reading the default profile that is in force; and the XML elements that
profiles are made of. Must not import rclpy.

By default Fast DDS announces a new participant five times at 100 ms and then each 3 s, and sends
endpoints to each participant by itself (docs/performance.md has the measurements).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from xml.etree import ElementTree as ET

import msgspec

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.versions import DISTRIBUTIONS, installed
from lifecycle.network.medium import udp_to

PROFILE_NAME = "lifecycle_quick_discovery"
DISCOVERY_SERVER_VARIABLE = "ROS_DISCOVERY_SERVER"
"""Makes every participant a client of that server."""
RANGE_VARIABLE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
PEERS_VARIABLE = "ROS_STATIC_PEERS"
_FILE_NAME = "quick_discovery.xml"
_SKIP_DEFAULT_FILE_VARIABLE = "SKIP_DEFAULT_XML"

DEFAULT_LEASE_S = 20
"""Fast DDS drops a participant that ended without a word after so long, if no profile says."""

FORGOTTEN_S = DEFAULT_LEASE_S + 1.0
"""A participant that left without notice is in the graph no more, whoever made its profile."""

PARTICIPANT_LEASE_S = 10
"""The same in what `up` starts: as long as a machine may be too busy for it to announce itself."""

_ONE_SAMPLE = (
    "<topic><resourceLimitsQos><allocated_samples>1</allocated_samples></resourceLimitsQos></topic>"
)
"""A service takes 47 KiB and not 104 KiB: histories grow to their depth when they are used."""


def discovery_profile(
    *, peers: Iterable[tuple[str, int]] = (), multicast_endpoints: bool = False
) -> str:
    """Return the profile as XML: it sets discovery, and how many samples are allocated ahead.

    Args:
        peers: IP addresses and UDP ports that it is announced to; all of them, because they replace
            the groups by which Fast DDS otherwise does.
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
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
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
    """Write the profile into `directory` and return the variables that apply it.

    They count for participants created after they are set. A profile of the user's own is never
    replaced: then nothing is written and the result is empty.

    The directory must outlive every process that is given the variables; the rest is as for
    `discovery_profile`.

    Raises:
        MiddlewareError: the file cannot be written.
    """
    version = installed()
    variables = (each.profiles_variable for each in DISTRIBUTIONS)
    if any(map(os.environ.get, variables)) or Path(version.default_profiles).exists():
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


def child(parent: ET.Element, tag: str) -> ET.Element:
    """Return the first child of this name; made if there is none."""
    found = parent.find(tag)
    return ET.SubElement(parent, tag) if found is None else found


def drop(parent: ET.Element, *tags: str) -> None:
    """Remove the children of these names."""
    for each in [each for each in parent if each.tag in tags]:
        parent.remove(each)


def put(parent: ET.Element, path: str, content: object) -> None:
    """Set the text of an element by its path; the ones on the way are made if there are none."""
    for tag in path.split("/"):
        parent = child(parent, tag)
    parent.text = str(content)
