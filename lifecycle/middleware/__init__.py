"""rcl, rmw and Fast DDS, used by this package alone: endpoints, participants, graph, shared memory.

Owns: every use of ctypes and of private rclpy names. Names load on first use, so that a verb that
only needs the /dev/shm sweep or process control does not pay for importing rclpy.
"""

from lifecycle.doors import open_door

__getattr__, __dir__, __all__ = open_door(__name__, __file__)
