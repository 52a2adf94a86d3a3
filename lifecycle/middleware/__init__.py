"""rcl, rmw and Fast DDS, used by this package alone: endpoints, participants, graph, shared memory.

Owns: every use of ctypes and of private rclpy names.
"""
