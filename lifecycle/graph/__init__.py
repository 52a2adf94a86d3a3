"""The ROS graph interface: which nodes run, who is connected to whom, and what has just changed.

Owns: graph messages and their transport, the events made of them, and the state with its queries
(docs/graph_interface.md), of which the supervisor and `lifecycle verify` judge an observation. Must
not use ctypes or private rclpy names; those live in middleware/. Names that need rclpy load on
first use.
"""

from lifecycle.doors import open_door

__getattr__, __dir__, __all__ = open_door(__name__, __file__)
