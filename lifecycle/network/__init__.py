"""Facts of networks: DDS ports, DSCP, transport priority, 5QI, NFEs and flow uniqueness.

Pure: imports nothing of the package but `lifecycle.codec`, no ROS, opens no socket.
"""

from lifecycle.doors import open_door

__getattr__, __dir__, __all__ = open_door(__name__, __file__)
