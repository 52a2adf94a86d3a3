"""What holds for every test that needs no ROS."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def _no_domain_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever runs the tests may have a domain of their own, which a check looks at."""
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
