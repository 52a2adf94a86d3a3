"""Facts of networks: DDS ports, DSCP, transport priority, 5QI, NFEs and flow uniqueness.

Pure: imports nothing of the package but `lifecycle.codec`, no ROS, opens no socket.
"""
