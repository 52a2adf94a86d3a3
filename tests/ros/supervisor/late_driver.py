"""A driver as others write them, whose topic and service come later than its node, and who waits.

    late_driver.py NAME [--ros-args …]

Notes when it began, and when each came, in the file NOTES: `driver publishes 81.2`, by the clock
of the machine. COMES says how many seconds after another they come: `publishes:1 serves:0.5`.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time


def note(name: str, what: str) -> None:
    with open(os.environ["NOTES"], "a", encoding="utf-8") as file:  # noqa: PTH123
        file.write(f"{name} {what} {time.time()}\n")


if __name__ == "__main__":
    note(sys.argv[1], "started")  # before what takes its time to be imported

import rclpy  # noqa: E402
from rclpy.node import Node  # noqa: E402
from std_msgs.msg import String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from lifecycle import LifecycleNode  # noqa: E402


class Driver(Node):
    def __init__(self, name: str = "driver") -> None:
        super().__init__(name)
        self.declare_parameter("ready", "READY" in os.environ)
        note(name, "constructed")
        threading.Thread(target=self.come, daemon=True).start()

    def come(self) -> None:
        for each in os.environ.get("COMES", "").split():
            what, _, after_s = each.partition(":")
            time.sleep(float(after_s))
            # Before it is there: who waits for it begins later.
            note(self.get_name(), what)
            if what == "publishes":
                self.scan = self.create_publisher(String, "scan", 10)
            else:
                self.reset = self.create_service(Trigger, "~/reset", lambda _, answer: answer)


class ManagedViewer(LifecycleNode):
    def __init__(self) -> None:
        super().__init__()
        note("viewer", "constructed")

    def on_configure(self, state) -> None:
        note("viewer", "configures")


def main() -> None:
    end = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: end.set())
    rclpy.init(args=sys.argv, signal_handler_options=rclpy.SignalHandlerOptions.NO)
    executor = rclpy.executors.SingleThreadedExecutor()
    executor.add_node(Driver(sys.argv[1]))
    threading.Thread(target=executor.spin, daemon=True).start()
    parent = os.getppid()
    while not end.wait(0.5) and os.getppid() == parent:
        pass
    os._exit(0)


if __name__ == "__main__":
    main()
