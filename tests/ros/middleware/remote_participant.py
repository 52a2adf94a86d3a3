"""A publisher on a connection, in a process of its own: `remote_participant.py DOMAIN URL`.

It is there until standard input ends, and leaves then.
"""

from __future__ import annotations

import sys
import warnings

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    from std_msgs.msg import String

from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.fastdds.participant import FlowParticipant
from lifecycle.middleware.process.teardown import leave_and_exit
from lifecycle.plan.model import ParticipantConnections


def main() -> None:
    domain, url = sys.argv[1:]
    participant = FlowParticipant(
        "_remote", "/", int(domain), connections=ParticipantConnections(urls=(url,))
    )
    participant.create_publisher(String, "/flow", QosProfile())
    print("there", flush=True)
    sys.stdin.read()
    participant.destroy()
    leave_and_exit(0)


if __name__ == "__main__":
    main()
