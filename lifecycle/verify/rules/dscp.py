"""Rules about DSCP marking. Pure.

The value judged is the one read back from the sender sockets (getsockopt), never the NFE's `dscp`
field, which Fast DDS always leaves 0. It proves what this host sends, not what routers keep.
"""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.network import describe
from lifecycle.verify.rules.catalogue import Rule
from lifecycle.verify.verdict import Finding, Outcome
from lifecycle.verify.view import View

DSCP_NOT_APPLIED = Rule(
    id="flow.dscp-not-applied",
    meaning="the sockets that an endpoint sends from do not carry the declared DSCP",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    fix="see the node's log for the refused socket option; `enforce: false` makes it a warning",
    concerns_flow=True,
    may_block=False,
)
DSCP_UNVERIFIABLE = Rule(
    id="flow.dscp-unverifiable",
    meaning="nobody read back the DSCP of an endpoint that declares one",
    outcomes=(Outcome.UNVERIFIABLE,),
    fix="only nodes in our host mark and read back; mark a foreign node's flow in the network",
    concerns_flow=True,
)
RULES = (DSCP_NOT_APPLIED, DSCP_UNVERIFIABLE)


def check(view: View) -> Iterator[Finding]:
    """Judge every endpoint that declares a DSCP and is there.

    A subscription's is that of its acknowledgements.
    """
    for actual in view.actual:
        planned, node, report = actual.planned, actual.node, actual.report
        wanted = planned.dscp
        if wanted is None:
            continue
        if actual.observed is None and report is None:
            continue
        where = f"the {planned.kind.noun} of {planned.resolved} in {node.full_name}"
        read = report.dscp if report else None
        if read is None:
            yield DSCP_UNVERIFIABLE.on_endpoint(
                Outcome.UNVERIFIABLE,
                actual,
                expected=describe(wanted),
                observed="not read back",
                message=f"cannot verify the DSCP of {where}: nobody read it back",
            )
        elif read != wanted:
            waived = "" if planned.enforce_dscp else "; the manifest does not enforce it"
            yield DSCP_NOT_APPLIED.on_endpoint(
                Outcome.VIOLATED if planned.enforce_dscp else Outcome.UNVERIFIABLE,
                actual,
                expected=describe(wanted),
                observed=describe(read),
                message=f"cannot accept {where}: its sockets carry {describe(read)}"
                f" and not {describe(wanted)}{waived}",
                hint="" if planned.enforce_dscp else "see the node's log for the refused option",
            )
