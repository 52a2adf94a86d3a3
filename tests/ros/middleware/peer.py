"""A subscription in a process of its own: `peer.py DOMAIN COUNT [TRANSPORT…]`.

Prints its network flow endpoints as JSON, and after COUNT messages their lengths.
"""

from __future__ import annotations

import json
import sys
import threading
import warnings

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    from rclpy.executors import SingleThreadedExecutor
    from std_msgs.msg import String

from lifecycle import codec
from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.fastdds.nfe import get_network_flow_endpoints
from lifecycle.middleware.fastdds.participant import FlowParticipant
from lifecycle.middleware.process.control import leave_and_exit


def main() -> None:
    domain, count, *transports = sys.argv[1:]
    lengths: list[int] = []
    participant = FlowParticipant("_peer", "/", int(domain), transports=transports)
    subscription = participant.create_subscription(
        String, "/flow", lambda message: lengths.append(len(message.data)), QosProfile()
    )
    print(codec.to_json(get_network_flow_endpoints(subscription)).decode(), flush=True)
    executor = SingleThreadedExecutor(context=participant.node.context)
    executor.add_node(participant.node)
    # We stay, so that nothing but data is on the wire, until standard input ends.
    released = threading.Thread(target=sys.stdin.read, daemon=True)
    released.start()
    while released.is_alive() and len(lengths) < int(count):
        executor.spin_once(timeout_sec=0.1)
    print(json.dumps(lengths), flush=True)
    released.join()
    participant.destroy()
    leave_and_exit(0)


if __name__ == "__main__":
    main()
