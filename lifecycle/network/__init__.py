"""Facts of networks: DDS ports, DSCP, transport priority, 5QI, NFEs and flow uniqueness.

Pure: imports nothing of the package but `lifecycle.codec`, no ROS, opens no socket.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
