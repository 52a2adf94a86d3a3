"""How soon a participant answers who asks for its endpoints."""

from __future__ import annotations

import pytest

from lifecycle.middleware.fastdds import endpoint_discovery
from lifecycle.middleware.fastdds.endpoint_discovery import resend_endpoints_soon, together_s
from lifecycle.middleware.fastdds.participant import FlowParticipant


@pytest.mark.parametrize("unknown", ["participant_of", "_functions"])
def test_only_a_known_version_is_changed(
    fresh_domain: int, monkeypatch: pytest.MonkeyPatch, unknown: str
) -> None:
    with FlowParticipant("_other", "/", fresh_domain) as other, other.node.handle:
        pointer = other.node.handle.pointer
        assert resend_endpoints_soon(pointer, together_s(20))
        monkeypatch.setattr(endpoint_discovery, unknown, lambda *_: None)
        assert not resend_endpoints_soon(pointer)
