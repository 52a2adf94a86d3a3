"""Fast DDS discovery server: command line, environment, and whether it listens.

Owns: the command line and environment of `fast-discovery-server`, and the readiness test. Starting,
watching and ending it is supervisor/'s. Must not import rclpy.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sysconfig
from collections.abc import Mapping
from pathlib import Path

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.sockets import sockets_in
from lifecycle.middleware.versions import DISTRIBUTIONS, INSTALL, installed
from lifecycle.network.medium import DEFAULT_TCP, RMW_DISCOVERY, TRANSPORTS_VARIABLE
from lifecycle.plan.model import PlannedServer

PROGRAM = "fast-discovery-server"
_LISTEN = "0A"  # TCP_LISTEN of linux/tcp_states.h


def discovery_server_command(
    server: PlannedServer, environment: Mapping[str, str] | None = None
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return the command line of a discovery server, and the whole environment it needs.

    Args:
        server: address, port and transport; the address must be this host's.
        environment: what it otherwise gets; None for this process's.

    Raises:
        MiddlewareError: the program is not installed.
    """
    options = ("-t", server.address, "-q") if server.tcp else ("-l", server.address, "-p")
    command = (_program(), *installed().server_arguments)
    argv = (*command, "-i", "0", *options, str(server.port))  # the id that clients expect
    current = dict(os.environ if environment is None else environment)
    # A profile or a server of the environment's would be applied to the server itself.
    for variable in (
        *(each.profiles_variable for each in DISTRIBUTIONS),
        TRANSPORTS_VARIABLE,
        "ROS_DISCOVERY_SERVER",
    ):
        current.pop(variable, None)
    current["SKIP_DEFAULT_XML"] = "1"
    paths = [*_library_paths(), *filter(None, current.get("LD_LIBRARY_PATH", "").split(":"))]
    current["LD_LIBRARY_PATH"] = ":".join(dict.fromkeys(paths))
    return argv, current


def discovery_server_listens(server: PlannedServer, pid: int | None = None) -> bool:
    """Return whether the server's port is open on this host, as the kernel says.

    Args:
        server: address, port and transport.
        pid: of the server, whose network is looked at; None for this process's.
    """
    owner, name = "self" if pid is None else str(pid), "tcp" if server.tcp else "udp"
    table, kind = Path("/proc", owner, "net", name), DEFAULT_TCP if server.tcp else RMW_DISCOVERY
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        return any(
            each.port == server.port
            and each.address in (server.address, kind.any_address)
            and (not server.tcp or state == _LISTEN)
            for each, state in sockets_in(table, kind)
        )
    return False


def _program() -> str:
    for directory in (sysconfig.get_path("scripts"), None):
        found = shutil.which(PROGRAM, path=directory)
        if found is not None:
            return found
    raise MiddlewareError(
        f"cannot find {PROGRAM!r}", hint=f"it comes with Fast DDS; set PATH, or {INSTALL}"
    )


def _library_paths() -> list[str]:
    """Return where the wheels keep Fast DDS and what it needs; what is not there is left out."""
    data, pure = (Path(sysconfig.get_path(each)) for each in ("data", "purelib"))
    places = (data / "lib", pure / "ros_fastrtps.libs", pure / "ros_fastdds.libs")
    return [str(place) for place in places if place.is_dir()]
