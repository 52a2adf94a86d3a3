"""Names of the network targets: each is a module here, which has its class as `TARGET`."""

TARGETS = ("nft", "tc", "nef", "camara")
