"""Programs networks from verified flows: nftables and tc on this host, NEF and CAMARA over HTTP.

Owns: everything between flow reports and a network that treats those flows as declared. Targets
touch only what a ledger or a mark says is ours.
"""
