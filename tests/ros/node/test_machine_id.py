"""What a node says of the machine that it runs on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from lifecycle.middleware.process import control
from lifecycle.middleware.process.control import machine_id


@pytest.fixture(autouse=True)
def _forgotten() -> Iterator[None]:
    control._own_machine_id.cache_clear()
    yield
    control._own_machine_id.cache_clear()


def test_a_machine_id_that_is_given_stands_for_the_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LIFECYCLE_MACHINE_ID", "container-1")
    assert machine_id() == "container-1"
    # A host is forked from a process that had looked, and may be given another one.
    monkeypatch.delenv("LIFECYCLE_MACHINE_ID")
    files = machine_id()
    monkeypatch.setenv("LIFECYCLE_MACHINE_ID", "container-2")
    assert (machine_id(), files != "container-1") == ("container-2", True)


@pytest.mark.parametrize("given", [None, ""])
def test_without_one_the_files_say_which_machine_it_is(
    monkeypatch: pytest.MonkeyPatch, given: str | None
) -> None:
    monkeypatch.delenv("LIFECYCLE_MACHINE_ID", raising=False)
    if given is not None:
        monkeypatch.setenv("LIFECYCLE_MACHINE_ID", given)
    files = ("/etc/machine-id", "/proc/sys/kernel/random/boot_id")
    texts = (Path(file).read_text().strip() for file in files if Path(file).exists())
    assert machine_id() == next(text for text in texts if text)
