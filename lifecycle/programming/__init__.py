"""Programs networks from verified flows: nftables and tc on this host, NEF and CAMARA over HTTP.

`rules` says purely what each flow is to get; a target is one module, named in `names`. Targets
touch only what a mark of theirs or the ledger says is ours. Must not import rclpy.
"""
