"""Systems that are as declared: none of them may be refused."""

from __future__ import annotations

from tests.outside.case import NOBODY, OK, REFUSED, Case

PAIR = """\
manifest_version: 1
system: pair
discovery: {range: localhost}
nodes:
  talker:
    run: {python: "nodes:Talker"}
    interface: {publishers: [{name: chatter, type: std_msgs/msg/String}]}
  listener:
    run: {python: "nodes:Listener"}
    interface: {subscriptions: [{name: chatter, type: std_msgs/msg/String}]}
"""

CASES = (
    Case(
        attack="nothing is wrong",
        manifest=PAIR,
        verdict=OK,
        activated=frozenset({"talker", "listener"}),
        received=frozenset({"hello"}),
        quick=True,
    ),
    Case(
        attack="a stranger publishes on a declared topic",
        manifest=PAIR,
        verb=("up", "--strict", "--stop-after", "2", "--timeout", "6"),
        strangers=(("stranger", "pub:/chatter"),),
        findings=("graph.undeclared-node",),
        received=NOBODY,
        quick=True,
        **REFUSED,
    ),
)
