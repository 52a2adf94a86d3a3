"""What libraries that are not known here cost, and what a plan requires of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.factory import fast_dds_refusal
from lifecycle.middleware.fastdds.participant_profile import ParticipantSettings
from lifecycle.middleware.rcl import abi
from lifecycle.middleware.versions import INSTALL
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.model import PlannedNode


def unknown_versions() -> str:
    """Return which of the libraries here are not known, and what that costs; empty if all are.

    It needs rclpy, and loads nothing that rclpy has not loaded.
    """
    unknown = []
    if refusal := abi.refusal():
        unknown.append(
            f"{refusal}: nodes, endpoints and states are "
            "verified; network flow endpoints cannot be read or made unique, so that what requires "
            "them is unverifiable or refused"
        )
    if refusal := fast_dds_refusal():
        unknown.append(
            f"{refusal}: participants get no connections, transports or DSCP of their own"
        )
    return "; ".join(unknown)


def refuse_unsupported(nodes: Iterable[PlannedNode]) -> None:
    """Refuse nodes that could not connect with the libraries that are loaded here.

    Args:
        nodes: that processes of ours host.

    Raises:
        MiddlewareError: with the place in the manifest.
    """
    rcl, fast_dds = abi.refusal(), fast_dds_refusal()
    for node in nodes:
        for each in node.endpoints if rcl else ():
            if each.unique is UniqueRequirement.STRICTLY_REQUIRED:
                at = each.at or node.at
                raise MiddlewareError(
                    f"{at.spelled}: cannot give {each.kind.noun} {each.name!r} of "
                    f"{node.key!r} a flow of its own ('unique: strictly_required'): {rcl}",
                    hint=f"use 'unique: optionally_required', or {INSTALL}",
                )
        for key in _chosen(node) if fast_dds else ():
            raise MiddlewareError(
                f"{node.at.spelled}: cannot make a participant of {node.key!r} with {key}: "
                f"{fast_dds}",
                hint=INSTALL,
            )


def _chosen(node: PlannedNode) -> Iterator[str]:
    """Yield the keys for which rmw_fastrtps alone cannot make the participants of a node."""
    if ParticipantSettings.of(node):
        yield "'connections', 'transport' or 'discovery' as declared"
    for each in node.participants:
        if ParticipantSettings.of(each):
            yield f"'transport' or 'connections' as declared ({each.reason})"
