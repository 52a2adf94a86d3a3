"""A node that comes late: `latecomer.py DOMAIN TOPIC`.

Says that it is there, and, from the next line of standard input, after how many seconds it knows a
publisher of the topic.
"""

from __future__ import annotations

import sys
import time
import warnings

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    import rclpy
    from rclpy.node import Node

BOUND_S = 10.0


def main() -> None:
    domain, topic = sys.argv[1:]
    rclpy.init(domain_id=int(domain))
    node = Node("latecomer")
    print("there", flush=True)
    sys.stdin.readline()
    began_s = time.monotonic()
    while not node.count_publishers(topic) and time.monotonic() - began_s < BOUND_S:
        time.sleep(0.001)
    print(time.monotonic() - began_s, flush=True)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
