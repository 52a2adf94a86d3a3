"""Entry point of a process that hosts nodes for a supervisor, and what it imports before it forks.

As a program, `python -m lifecycle.node.host.host DESCRIPTOR`, it serves an inherited socket.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import socket
import sys
from collections.abc import Iterable
from typing import NoReturn

from lifecycle import codec
from lifecycle.manifest.model import DiscoveryRange
from lifecycle.node.host.control import Command, HostChannel, HostSpec, report_failure

_PRELOADED = (
    "rclpy.executors",
    "rclpy.node",
    "rclpy.logging_service",
    "rclpy.lifecycle",
    "lifecycle.node.host.hosting",
)
_INTERFACES = (
    "rcl_interfaces/msg/ParameterEvent",
    "std_msgs/msg/String",
    "lifecycle_msgs/msg/TransitionEvent",
    "rcl_interfaces/srv/DescribeParameters",
    "rcl_interfaces/srv/GetParameterTypes",
    "rcl_interfaces/srv/GetParameters",
    "rcl_interfaces/srv/ListParameters",
    "rcl_interfaces/srv/SetParameters",
    "rcl_interfaces/srv/SetParametersAtomically",
    "type_description_interfaces/srv/GetTypeDescription",
    "lifecycle_msgs/srv/ChangeState",
    "lifecycle_msgs/srv/GetAvailableStates",
    "lifecycle_msgs/srv/GetAvailableTransitions",
    "lifecycle_msgs/srv/GetState",
    "std_srvs/srv/Trigger",
)
"""What every node of ours has; their type supports are libraries that load on first use."""


def preload(types: Iterable[str] = ()) -> None:
    """Import everything a host needs, for a process that will fork hosts.

    Makes no participant and opens no socket, so a fork afterwards is safe. The only threads are
    those of libraries that a child can do without: LTTng's two listeners, numpy's OpenBLAS pool.

    Args:
        types: interface types that nodes use besides; one that cannot be imported is left to the
            host that needs it, which reports it.
    """
    from lifecycle.middleware.fastdds.factory import unknown_versions
    from lifecycle.middleware.rcl.conversions import load_type_support

    for name in _PRELOADED:
        importlib.import_module(name)
    for interface in _INTERFACES:
        load_type_support(interface)
    for message in (HostSpec, Command):
        codec.decoder(message)
    unknown_versions()  # it loads the libraries of the RMW, which hosts then share
    for interface in types:
        with contextlib.suppress(Exception):
            load_type_support(interface)


def serve(control: socket.socket) -> NoReturn:
    """Host what the first line of `control` says until it ends; never returns.

    Exit codes: 0 after end of file, SIGTERM or SIGINT and a shutdown in time; 1 if the nodes
    could not be constructed (the supervisor was notified why) or a callback raised an exception.
    """
    channel = HostChannel(control)
    line = channel.read()
    if line is None:  # the supervisor has gone before it said anything
        os._exit(0)
    try:
        spec = codec.from_json(line, HostSpec)
        if spec.discovery_range is not DiscoveryRange.SYSTEM_DEFAULT:
            os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = spec.discovery_range.value.upper()
        # Late: these need rclpy, which a process that is about to fork has, and we may not.
        from lifecycle.node.host.hosting import Host, process_context

        context = process_context(spec)
    except Exception as error:  # noqa: BLE001 - reported to the supervisor
        from lifecycle.middleware.process.control import leave_and_exit

        report_failure(channel, "", error)
        channel.drain()
        leave_and_exit(1)
    Host(spec, context, channel).run()


if __name__ == "__main__":
    serve(socket.socket(fileno=int(sys.argv[1])))
