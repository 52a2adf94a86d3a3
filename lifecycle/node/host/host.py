"""Entry point of a process that hosts nodes for a supervisor, and what it imports before it forks.

Owns: the way in: read the HostSpec (control.py), then let hosting.py construct and run the nodes.
Importing this module has no side effects and is cheap to fork from: `preload()` imports what a node
needs, without a participant or a socket, as neither survives a fork; nothing here calls rclpy.init
before `serve`.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import socket
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import NoReturn

from lifecycle import codec, dataclasses, middleware
from lifecycle.manifest import DiscoveryRange, Health, Run, RunKind
from lifecycle.node.host.control import Command, Event, HostChannel, HostSpec, Operation, give_up
from lifecycle.plan import PlannedNode

_SHARED = (
    "rclpy.executors",
    "rclpy.node",
    "rclpy.logging_service",
    "lifecycle_msgs.msg",
    "lifecycle_msgs.srv",
    "rcl_interfaces.msg",
    "rcl_interfaces.srv",
    "std_msgs.msg",
    "std_srvs.srv",
)
"""What a supervisor has, too: its participant is a node."""

_PRELOADED = (
    *_SHARED,
    "rclpy.lifecycle",
    "lifecycle.node.host.hosting",
)
_SHARED_NAMES = (
    "BusySign",
    "ParticipantSettings",
    "discovery_environment",
    "discovery_peers",
    "endpoints_of",
    "give_up_dead_connections",
    "hidden_nodes",
    "import_interface",
    "is_server_matched",
    "parameter_value",
    "participant_settings",
    "segments_of",
    "widen_discovery_buffers",
)
_SHARED_MESSAGES = ("rcl_interfaces/msg/ParameterEvent", "std_msgs/msg/String")
_MESSAGES = (*_SHARED_MESSAGES, "lifecycle_msgs/msg/TransitionEvent")
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


def preload() -> None:
    """Import everything a host needs, for a process that will fork hosts.

    Makes no participant and opens no socket, so a fork afterwards is safe. The only threads are
    those of libraries that a child can do without: LTTng's two listeners, numpy's OpenBLAS pool.
    Call `gc.freeze()` after it to keep the imported pages shared.
    """
    for name in _PRELOADED:
        importlib.import_module(name)
    from lifecycle.middleware import load_libraries

    for interface in (*_MESSAGES, *_SERVICES):
        _load(interface)
    load_libraries()
    _rehearse()


def preload_for_some(names: Iterable[str]) -> None:
    """Import what only some nodes need, after `preload`, of which the rest holds here, too.

    Args:
        names: see `needed_by`; numpy alone, which most messages with arrays import, takes 60 ms,
            and not all need it. What cannot be imported is left to the host that needs it, which
            reports it.
    """
    for name in names:
        with contextlib.suppress(Exception):
            _load(name)


def preload_shared() -> None:
    """Import what a host and a supervisor both need, for a supervisor that will fork.

    What `preload` says of threads, participants and sockets holds here, too.
    """
    middleware.await_loading()
    for name in _SHARED:
        importlib.import_module(name)
    for name in _SHARED_NAMES:
        getattr(middleware, name)
    for message in _SHARED_MESSAGES:
        _load(message)


_OFTEN = 8
"""Calls of a function after which CPython 3.11 and later write into its code."""


def _rehearse() -> None:
    """Do what every host does before it has a node: what is written meanwhile is shared after."""
    import hashlib

    from lifecycle.middleware import ParticipantSettings, machine_id
    from lifecycle.node.author.handlers import note_unmarked
    from lifecycle.node.author.node import LifecycleNode
    from lifecycle.node.author.spec import default_name, plan_without_manifest
    from lifecycle.node.lifecycle.machine import (
        CallbackOutcome,
        LifecycleMachine,
        TransitionRequest,
    )

    machine_id()
    hashlib.sha256()
    note_unmarked(LifecycleNode)
    node = plan_without_manifest(HostSpec, name=default_name(HostSpec), namespace="/")
    spec = HostSpec(
        system="",
        process="",
        domain_id=0,
        discovery_range=DiscoveryRange.SYSTEM_DEFAULT,
        nodes=(node,),
    )
    codec.from_json(codec.to_json(spec), HostSpec)
    command = Command(id=0, node="", operation=Operation.CONFIGURE)
    codec.from_json(codec.to_json(command), Command)
    codec.to_json(Event(kind="ready"))
    hash(
        ParticipantSettings.of(
            node.connections,
            transports=node.transports,
            max_datagram_bytes=node.max_datagram_bytes,
        )
    )
    for _ in range(_OFTEN):
        machine = LifecycleMachine()
        for request in (TransitionRequest.CONFIGURE, TransitionRequest.CONNECT):
            machine.resolve(0, request.value)
            machine.request(request)
            machine.finish(CallbackOutcome.SUCCESS)
    getattr(Health, "__init__")  # noqa: B009 - looking them up makes them, see dataclasses
    getattr(Run, "__eq__")  # noqa: B009
    dataclasses.make_constructors(
        "lifecycle.node",
        "lifecycle.middleware",
        "lifecycle.verify.observation",
        "lifecycle.verify.outcome",
        "lifecycle.network.ports",
    )


def _load(name: str) -> None:
    """Import a module, or an interface with its type support."""
    if "/" not in name:
        importlib.import_module(name)
        return
    middleware.load_type_support(name)


def needed_by(nodes: Iterable[PlannedNode]) -> tuple[str, ...]:
    """Return what `preload_for_some` is to import: modules and interface types."""
    names: dict[str, None] = {}
    for node in nodes:
        if node.run.kind is RunKind.PYTHON and _calculates(node):
            names["numpy"] = None
        if node.events or node.membership:
            names["lifecycle.graph.transport"] = names["lifecycle.graph.reporter"] = None
        for endpoint in node.endpoints:
            if "/action/" in endpoint.type:
                names["rclpy.action"] = None
            names[endpoint.type] = None
    return tuple(names)


_WITH_NUMPY = re.compile(
    rb"^\s*(?:import|from)\s+(?:numpy|cv2|cv_bridge|scipy|sensor_msgs_py|torch)\b", re.MULTILINE
)


def _calculates(node: PlannedNode) -> bool:
    """Whether the file of a node's class imports numpy, as far as that is seen without Python.

    It takes 60 ms: once if it is preloaded, else in each process whose code imports it.
    """
    parts = node.run.python.partition(":")[0].split(".")
    beside = [str(Path(node.at.file).parent)] if node.at.file else []
    for folder in (node.run.working_directory or ".", *beside, *sys.path):
        place = Path(folder, *parts)
        for file in (place / "__init__.py", place.with_name(f"{place.name}.py")):
            with contextlib.suppress(OSError):
                return _WITH_NUMPY.search(file.read_bytes()) is not None
    return False


__all__ = ["main", "needed_by", "preload", "preload_for_some", "serve"]


def main(control_socket_fd: int) -> NoReturn:
    """Serve the control socket with this descriptor; never returns."""
    serve(socket.socket(fileno=control_socket_fd))


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
        give_up(channel, "", error)
    Host(spec, context, channel).run()


def _main() -> NoReturn:
    import argparse

    parser = argparse.ArgumentParser(prog="python -m lifecycle.node.host.host", description=__doc__)
    parser.add_argument("--control-fd", type=int, required=True, help="inherited AF_UNIX socket")
    main(parser.parse_args().control_fd)


if __name__ == "__main__":
    _main()
