"""Every reader of data that others write: whatever comes, a value or its own error."""

from __future__ import annotations

import random
import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.hostile.attack import mutated
from tests.hostile.parsers import READERS


@pytest.mark.parametrize("name", READERS)
def test_what_it_is_made_for_is_read(name: str, tmp_path: Path) -> None:
    READERS[name].read(READERS[name].good, tmp_path)


@pytest.mark.parametrize("name", READERS)
def test_no_bytes_make_a_reader_raise_anything_but_its_own_error(name: str) -> None:
    reader = READERS[name]
    changed = st.integers(0, 2**32).map(lambda seed: mutated(reader.good, random.Random(seed)))

    @given(changed | st.binary() | st.text().map(lambda text: text.encode("utf-8", "replace")))
    @settings(max_examples=30, deadline=None)
    def read(data: bytes) -> None:
        with tempfile.TemporaryDirectory() as folder:
            try:
                reader.read(data, Path(folder))
            except reader.errors as error:
                read.said = str(error)  # type: ignore[attr-defined]

    read()
    assert getattr(read, "said", "?") != ""
