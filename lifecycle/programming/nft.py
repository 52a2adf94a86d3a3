"""nftables on this host: the table `inet flowqos_<system>` marks the packets of verified flows.

They are marked where they leave the host that sends them (postrouting, mangle). Only the six bits
of the DSCP are written: ECN is the transport's (RFC 3168).
"""

from __future__ import annotations

from collections.abc import Sequence

from lifecycle.network.dscp import describe
from lifecycle.programming import host
from lifecycle.programming.ledger import TargetRecord
from lifecycle.programming.rules import FlowRule
from lifecycle.programming.target import Means


class NftTarget(host.TableTarget):
    """The table of one system."""

    kind = "nft"

    def __init__(self, settings: None, means: Means, tool: host.HostTool | None = None) -> None:
        table = host.table_name(means.ledger.system)
        super().__init__(settings, means, tool, table=table, scope=table)
        self.name = f"nft table inet {table}"

    @classmethod
    def restore(cls, record: TargetRecord) -> None:
        """The ledger's system names the table."""

    def lines(self, rule: FlowRule) -> Sequence[str]:
        """Return what sets its DSCP and its flow label."""
        found = []
        network = host.network_of(rule)
        if rule.dscp is not None:
            found.append((f"{network} dscp set {rule.dscp}", describe(rule.dscp)))
        if rule.flow_label:
            label = f"{rule.flow_label:#07x}"
            found.append((f"{network} flowlabel set {label}", f"flow label {label}"))
        if not found:
            raise ValueError("it has no DSCP and no flow label to set")
        match, flows = host.flow_match(rule), rule.named
        return [host.chain_line(match, statement, f"{mark}: {flows}") for statement, mark in found]

    def wanted(self, placed: host.Placed) -> host.Wanted:
        """Return the table."""
        return host.Wanted(
            host.render_table(self._table, (each for _, of in placed for each in of))
        )

    def script(self, wanted: host.Wanted, remarks: Sequence[str]) -> str:
        """Return a ruleset for `nft -f` that replaces the system's table in one transaction."""
        lines = [
            f"# Marks the verified flows of system {self._ledger.system}. Check without privilege:",
            "#   unshare -Urn nft -c -f FILE",
            "# Marking alone gives no priority: each hop must also queue by DSCP.",
            *remarks,
            wanted.table,
        ]
        return "\n".join(lines)


TARGET = NftTarget
