"""Programs networks from verified flows: `rules` renders what they are told, `apply` tells them.

`rules` is pure: nftables, tc, a NEF, CAMARA, Zenoh, Fast DDS Pro. `apply` has the targets, the
ledger of what is ours in each, and HTTP. Must not import rclpy.
"""
