"""Entry point of a process that hosts nodes for a supervisor, over the control channel.

Owns: the way in: read the HostSpec (control.py), then let hosting.py construct and run the nodes.
Importing this module has no side effects and is cheap to fork from: `preload()` imports what a node
needs, and nothing here calls rclpy.init before `serve`.
"""

from __future__ import annotations

import argparse
import os
import socket
from typing import NoReturn

from lifecycle import codec
from lifecycle.manifest import DiscoveryRange
from lifecycle.node.host.control import HostChannel, HostSpec, give_up
from lifecycle.node.host.preloading import needed_by, preload, preload_also

__all__ = ["main", "needed_by", "preload", "preload_also", "serve"]


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
        from lifecycle.node.host.constructing import process_context
        from lifecycle.node.host.hosting import Host

        context = process_context(spec)
    except Exception as error:  # noqa: BLE001 - reported to the supervisor
        give_up(channel, "", error)
    Host(spec, context, channel).run()


def _main() -> NoReturn:
    parser = argparse.ArgumentParser(prog="python -m lifecycle.node.host.host", description=__doc__)
    parser.add_argument("--control-fd", type=int, required=True, help="inherited AF_UNIX socket")
    main(parser.parse_args().control_fd)


if __name__ == "__main__":
    _main()
