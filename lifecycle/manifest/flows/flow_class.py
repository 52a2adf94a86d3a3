"""Which 5QI a publisher's need comes to, and whether that class keeps what is declared.

Owns: `five_qi: auto`, and the check of a 5QI that is written. The table is `lifecycle.network`'s.
Pure.
"""

from __future__ import annotations

import dataclasses

from lifecycle.manifest.model import FlowNeed
from lifecycle.network.five_qi import ClassIssue, check_class, five_qi_of, propose

_OPERATOR_SPECIFIC = range(128, 255)  # TS 24.501 §9.11.4.12
_ANY_LOSS = 1.0


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class FlowClass:
    """A 5QI and what there is to say of it.

    Attributes:
        five_qi: 1–254; None if not asked for, or if none fits.
        reason: why it is this one, or none, for `auto`; else empty.
        problem: message and hint of why it cannot be; two empty texts if it can.
        issues: what is declared and the class does not keep.
    """

    five_qi: int | None = None
    reason: str = ""
    problem: tuple[str, str] = ("", "")
    issues: tuple[ClassIssue, ...] = ()


def class_of(need: FlowNeed, *, max_delay_ms: float | None, message_bytes: int | None) -> FlowClass:
    """Return the class of one publisher's flow.

    Args:
        need: what it asks for; a declared `rate_hz` asks for a guaranteed rate.
        max_delay_ms: declared, else that of its links; None without.
        message_bytes: of its largest message; None if not known.
    """
    rate_bps = (
        need.rate_hz * message_bytes * 8
        if need.rate_hz is not None and message_bytes is not None
        else None
    )
    if need.five_qi_auto:
        return _proposed(need, max_delay_ms, message_bytes, rate_bps)
    if need.five_qi is None:
        return FlowClass()
    try:
        class_ = five_qi_of(need.five_qi)
    except ValueError as error:
        if need.five_qi in _OPERATOR_SPECIFIC:
            # An operator's own class: what it promises, only that operator knows.
            return FlowClass(five_qi=need.five_qi)
        message, _, hint = str(error).partition("; ")
        return FlowClass(five_qi=need.five_qi, problem=(message, hint))
    issues = check_class(
        class_,
        max_delay_ms=max_delay_ms,
        loss=need.loss,
        rate_bps=rate_bps,
        message_bytes=message_bytes,
    )
    return FlowClass(five_qi=need.five_qi, issues=issues)


def _proposed(
    need: FlowNeed, max_delay_ms: float | None, message_bytes: int | None, rate_bps: float | None
) -> FlowClass:
    if max_delay_ms is None:
        message = f"cannot propose a 5QI for {need.name!r}: no max_delay_ms is declared"
        hint = "add 'max_delay_ms', or a link of its topic that has one"
        return FlowClass(reason=message, problem=(message, hint))
    loss = _ANY_LOSS if need.loss is None else need.loss
    # A guaranteed rate must be bought as a number; where none is declared, only if nothing else is
    # fast enough.
    for gbr in (False, None) if need.rate_hz is None else (True,):
        proposal = propose(max_delay_ms, loss, gbr, message_bytes=message_bytes, rate_bps=rate_bps)
        if proposal.five_qi is not None:
            break
    if proposal.five_qi is None:
        hint = "relax 'max_delay_ms', 'loss', 'rate_hz' or 'max_message_size'"
        return FlowClass(reason=proposal.why, problem=(proposal.why, hint))
    return FlowClass(five_qi=proposal.five_qi.value, reason=proposal.why)
