"""The ROS 2 distributions that are supported: what each calls its parts, and which is installed.

What is the same in all of them is not in the table: the structs of rcl 9 and 10 and the functions
of Fast DDS 2.14 and 3.2 that are used here are. Must not import rclpy.
"""

from __future__ import annotations

import functools
import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from lifecycle.errors import MiddlewareError, UsageError
from lifecycle.network.medium import DEFAULT_RMW


class Distribution(msgspec.Struct, frozen=True, kw_only=True):
    """A ROS 2 distribution.

    Attributes:
        name: as people write it.
        rcl_major: version of rcl.
        fast_dds: version of Fast DDS.
        library: file name of Fast DDS's library.
        profiles_variables: name the file of Fast DDS's profiles; the first that is set counts.
        default_profiles: what Fast DDS loads from the working directory, unless SKIP_DEFAULT_XML=1.
        server_arguments: of `fast-discovery-server`, before its options.
        names_servers: a client's profile has the GUID prefix of each discovery server.
        node_takes_rosout: rclpy's own constructor of nodes has a seventh argument, rosout's QoS.
    """

    name: str
    rcl_major: str
    fast_dds: str
    library: str
    profiles_variables: tuple[str, ...]
    default_profiles: str
    server_arguments: tuple[str, ...]
    names_servers: bool
    node_takes_rosout: bool

    @property
    def profiles_variable(self) -> str:
        """The variable that is set for what is started."""
        return self.profiles_variables[0]


JAZZY = Distribution(
    name="Jazzy",
    rcl_major="9",
    fast_dds="2.14",
    library="libfastrtps.so.2.14",
    profiles_variables=("FASTRTPS_DEFAULT_PROFILES_FILE",),
    default_profiles="DEFAULT_FASTRTPS_PROFILES.xml",
    server_arguments=(),
    names_servers=True,
    node_takes_rosout=False,
)
KILTED = Distribution(
    name="Kilted",
    rcl_major="10",
    fast_dds="3.2",
    library="libfastdds.so.3.2",
    profiles_variables=("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE"),
    default_profiles="DEFAULT_FASTDDS_PROFILES.xml",
    server_arguments=("42",),  # the command "server" of tools/fastdds/discovery/parser.py
    names_servers=False,
    node_takes_rosout=True,
)
DISTRIBUTIONS = (JAZZY, KILTED)

KNOWN_RCL = " or ".join(f"rcl {each.rcl_major} (ROS 2 {each.name})" for each in DISTRIBUTIONS)
KNOWN_FAST_DDS = " or ".join(
    f"Fast DDS {each.fast_dds} (ROS 2 {each.name})" for each in DISTRIBUTIONS
)
INSTALL = (
    "pip install 'ros-lifecycle-manifests[ros]' (ROS 2 Jazzy) or "
    "'ros-lifecycle-manifests[kilted]', or source /opt/ros/jazzy/setup.bash"
)


@functools.lru_cache(maxsize=1)
def installed() -> Distribution:
    """Return the distribution whose rcl this Python imports; Jazzy where it is not known."""
    return of_rcl(rcl_version()) or JAZZY


def of_rcl(version: str) -> Distribution | None:
    """Return the distribution with a version of rcl, empty for any; None if it is not known."""
    major = version.partition(".")[0] or JAZZY.rcl_major
    return next((each for each in DISTRIBUTIONS if each.rcl_major == major), None)


def private(owner: object, name: str, what: str) -> Any:
    """Return what an object of rclpy has under a private name, or refuse an rclpy without it."""
    found = getattr(owner, name, None)
    if found is None:
        raise MiddlewareError(
            f"cannot {what}: rclpy of rcl {rcl_version()} has no {name}; known: {KNOWN_RCL}",
            hint=INSTALL,
        )
    return found


def rcl_version() -> str:
    """Return the version of rcl: of its wheel, else of its ament package; empty if unknown."""
    # By the name that an installed wheel's directory has; importing importlib.metadata and reading
    # what it reads takes 12 ms and more, in the supervisor and in each node that is started alone.
    for entry in sys.path:
        found = [*Path(entry or ".").glob("ros_rcl-*.dist-info")]
        if len(found) == 1:
            return found[0].name.removeprefix("ros_rcl-").removesuffix(".dist-info")
        if found:
            break
    import importlib.metadata

    try:
        return importlib.metadata.version("ros-rcl")
    except importlib.metadata.PackageNotFoundError:
        return _ament_version()


def _ament_version() -> str:
    try:
        from ament_index_python.packages import get_package_share_path

        text = (get_package_share_path("rcl") / "package.xml").read_text(encoding="utf-8")
    except (ImportError, LookupError, OSError):
        return ""
    found = re.search(r"<version>\s*([^<\s]+)\s*</version>", text)
    return found.group(1) if found else ""


_RMW_VARIABLES = ("RMW_IMPLEMENTATION", "RCL_ASSERT_RMW_ID_MATCHES")
"""Both are checked by rcl (rcl/rmw_implementation_identifier_check.c)."""


def check_rmw(environment: Mapping[str, str]) -> None:
    """Refuse an RMW whose library is nowhere that the loader looks: rcl would end this process.

    Raises:
        UsageError: no participant could be made with it.
    """
    folders = [*environment.get("LD_LIBRARY_PATH", "").split(os.pathsep), f"{sys.prefix}/lib"]
    for variable in _RMW_VARIABLES:
        rmw = environment.get(variable) or DEFAULT_RMW
        if rmw != DEFAULT_RMW and not any(
            Path(folder, f"lib{rmw}.so").is_file() for folder in folders
        ):
            raise UsageError(
                f"cannot use {variable}={rmw!r}: this installation of ROS 2 cannot load that RMW",
                hint=f"install it, or unset {variable}: the default is {DEFAULT_RMW}",
            )
