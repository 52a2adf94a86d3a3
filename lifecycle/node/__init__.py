"""LifecycleNode: the class to derive from, its state machine, and how it is run.

Owns: the node's side of everything. Names load on first use, so that the control channel's types
can be imported where there is no ROS.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
