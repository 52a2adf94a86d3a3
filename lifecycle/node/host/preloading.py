"""Imports that a process does once, before it forks hosts.

Owns: the list of them. Must not make a participant, nor open a socket: neither survives a fork.
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterable

from lifecycle import codec
from lifecycle.manifest import DiscoveryRange
from lifecycle.node.host.control import Command, HostSpec, Operation

_PRELOADED = (
    "rclpy.executors",
    "rclpy.node",
    "rclpy.lifecycle",
    "rclpy.logging_service",
    "lifecycle_msgs.msg",
    "lifecycle_msgs.srv",
    "rcl_interfaces.msg",
    "rcl_interfaces.srv",
    "std_msgs.msg",
    "std_srvs.srv",
    "lifecycle.node.host.hosting",
)
_MESSAGES = (
    "rcl_interfaces/msg/ParameterEvent",
    "lifecycle_msgs/msg/TransitionEvent",
    "std_msgs/msg/String",
)
_SERVICES = (
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


def preload(interfaces: Iterable[str] = ()) -> None:
    """Import everything a host needs, for a process that will fork hosts.

    Makes no participant and opens no socket, so a fork afterwards is safe. The only threads are
    those of libraries that a child can do without: LTTng's two listeners, numpy's OpenBLAS pool.
    Call `gc.freeze()` after it to keep the imported pages shared.

    Args:
        interfaces: types that its nodes declare, `package/msg/Type`; one that cannot be loaded is
            left to its node, which says so where it is found.
    """
    for name in _PRELOADED:
        importlib.import_module(name)
    from rclpy.type_support import check_is_valid_msg_type, check_is_valid_srv_type

    from lifecycle.middleware import import_interface

    for message in _MESSAGES:
        check_is_valid_msg_type(import_interface(message))
    for service in _SERVICES:
        check_is_valid_srv_type(import_interface(service))
    for interface in interfaces:
        with contextlib.suppress(Exception):
            kind = interface.split("/")[1]
            if kind == "action":
                importlib.import_module("rclpy.action")
            check = {"msg": check_is_valid_msg_type, "srv": check_is_valid_srv_type}.get(kind)
            loaded = import_interface(interface)
            if check is not None:
                check(loaded)
    # The codec learns a type's shape at first use.
    spec = HostSpec(
        system="",
        process="",
        domain_id=0,
        discovery_range=DiscoveryRange.SYSTEM_DEFAULT,
        nodes=(),
    )
    codec.from_json(codec.to_json(spec), HostSpec)
    command = Command(id=0, node="", operation=Operation.CONFIGURE)
    codec.from_json(codec.to_json(command), Command)
