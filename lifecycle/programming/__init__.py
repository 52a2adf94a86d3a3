"""Programs networks from verified flows: `rules` renders their rules, `apply` installs them.

`rules` is pure: nftables, tc, a NEF, CAMARA, CSV. `apply` has the targets, the
ledger of what is ours in each, and HTTP. Must not import rclpy.
"""

from lifecycle.doors import open_door

__getattr__, __dir__, __all__ = open_door(__name__, __file__)
