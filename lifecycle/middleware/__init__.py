"""rcl, rmw and Fast DDS, used by this package alone: endpoints, participants, graph, shared memory.

Owns: every use of ctypes and of private rclpy names. Names load on first use, so that a verb that
only needs the /dev/shm sweep or process control does not pay for importing rclpy.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
