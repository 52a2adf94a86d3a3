"""What a supervisor announces of its plan, so that others can compare it with their own.

Owns: `PlanNotice`, its text on the wire with bounds in both directions, and `concerns`: whose plan
has to be the same as ours. How two plans differ is `comparison`'s. Pure.
"""

from __future__ import annotations

import base64
import binascii
import dataclasses
import zlib

from lifecycle.codec import from_json, to_json
from lifecycle.plan.comparison import plan_checksum
from lifecycle.plan.model import Plan

MAX_TEXT = 1 << 20
"""Characters of a notice. A plan of 100 nodes takes about 40,000."""

_MAX_PLAN_BYTES = 1 << 25
"""Of a plan unpacked: what comes from the network must not fill our memory."""


class PlanNoticeError(ValueError):
    """A text that is no notice."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PlanNotice:
    """What one supervisor says of its plan.

    Attributes:
        run: one run of it, unique.
        host: its machine id, see node.machine_id.
        system: name of the system.
        machines: those whose nodes it brings up.
        nodes: fully qualified names of all nodes of the plan.
        checksum: of what is planned, see comparison.plan_checksum.
        plan: the plan as JSON, packed by zlib and written in base 64; empty if that is too long.
        left: it is being shut down, or has been.
        reason: why; empty unless it left.
    """

    run: str
    host: str
    system: str
    machines: tuple[str, ...]
    nodes: tuple[str, ...]
    checksum: str
    plan: str = ""
    left: bool = False
    reason: str = ""

    def replaces(self, other: PlanNotice) -> bool:
        """Whether it is news of what `other` told of: one supervisor, or one in its place."""
        if self.run == other.run:
            return True
        same = not {*self.machines}.isdisjoint(other.machines)
        if self.system == other.system and same:
            return True
        gone = other.left or self.host == other.host
        return gone and (same or not {*self.nodes}.isdisjoint(other.nodes))


def notice_of(plan: Plan, *, run: str, host: str, machines: tuple[str, ...]) -> PlanNotice:
    """Return what the supervisor of `machines` announces."""
    notice = PlanNotice(
        run=run,
        host=host,
        system=plan.system,
        machines=machines,
        nodes=tuple(each.full_name for each in plan.nodes),
        checksum=plan_checksum(plan),
    )
    packed = base64.b64encode(zlib.compress(to_json(plan))).decode()
    whole = dataclasses.replace(notice, plan=packed)
    return whole if len(encode(whole)) <= MAX_TEXT else notice


def encode(notice: PlanNotice) -> str:
    """Return the text of a notice."""
    return to_json(notice).decode()


def decode(text: str) -> PlanNotice:
    """Return the notice of a text.

    Raises:
        PlanNoticeError: it is none, longer than 1 MiB, or not fit to be shown.
    """
    if len(text) > MAX_TEXT:
        raise PlanNoticeError(f"cannot read a notice of {len(text)} characters: allowed {MAX_TEXT}")
    try:
        notice = from_json(text, PlanNotice)
    except ValueError as error:
        raise PlanNoticeError(f"cannot read a plan notice: {error}") from error
    # They are shown to people as they are.
    if not (notice.checksum.isalnum() and (notice.reason or " ").isprintable()):
        raise PlanNoticeError("cannot read a plan notice: it has characters that cannot be shown")
    return notice


def announced_plan(notice: PlanNotice) -> Plan | None:
    """Return the plan of a notice; None without one that can be read here."""
    try:
        unpacking = zlib.decompressobj()
        text = unpacking.decompress(base64.b64decode(notice.plan, validate=True), _MAX_PLAN_BYTES)
        return from_json(text, Plan) if unpacking.eof else None
    except (binascii.Error, zlib.error, ValueError):
        return None


def concerns(plan: Plan, own: frozenset[str], notice: PlanNotice) -> bool:
    """Whether the supervisor of a notice must have planned the same as we.

    Two systems may share a domain and their hosts, and even a name where each has machines of its
    own. But our system has one supervisor per machine, and a domain one node of a name: who runs
    another machine of our system is concerned, and who plans a node that we plan.

    Args:
        plan: ours.
        own: machines whose nodes we bring up.
        notice: what the other supervisor says.
    """
    theirs = {each.machine for each in plan.nodes} - own - {""}
    if notice.system == plan.system and not theirs.isdisjoint(notice.machines):
        return True
    return not {each.full_name for each in plan.nodes}.isdisjoint(notice.nodes)
