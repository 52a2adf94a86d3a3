"""A token in the environment, and no proxy between a test and its own server."""

from __future__ import annotations

import pytest

from tests.unit.programming.servers import TOKEN


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TEST_TOKEN", TOKEN)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
