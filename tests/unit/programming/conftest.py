"""A token in the environment."""

from __future__ import annotations

import pytest

from tests.unit.programming.servers import TOKEN


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TEST_TOKEN", TOKEN)
