"""Programs networks from verified flows: nftables and tc on this host, NEF and CAMARA over HTTP.

`rules` says purely what each flow is to get; a target is one module of the name below, which has
its class as `TARGET`. Targets touch only what a mark of theirs or the ledger says is ours. Must not
import rclpy.
"""

TARGETS = ("nft", "tc", "nef", "camara")
"""Names of the network targets."""
