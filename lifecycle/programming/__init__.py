"""Programs networks from verified flows: `rules` renders their rules, `apply` installs them.

`rules` is pure: nftables, tc, a NEF, CAMARA, CSV. `apply` has the targets, the
ledger of what is ours in each, and HTTP. Must not import rclpy.
"""
