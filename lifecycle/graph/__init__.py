"""The ROS graph interface: which nodes run, who is connected to whom, and what has just changed.

Owns: node statuses and how they travel, the events made of them, and the state with its queries
(docs/graph_interface.md), of which the supervisor and `lifecycle verify` judge an observation. Must
not use ctypes or private rclpy names; those live in middleware/.
"""
