"""One more try for tests of what Fast DDS may get wrong by itself.

It loses a first contact now and then (docs/nine_systems.md). Owns: `SECOND_TRY`, for what runs real
DDS or hosts in namespaces; `tests/conftest.py` shows how the first try failed.
"""

from __future__ import annotations

import pytest

SECOND_TRY = pytest.mark.flaky(reruns=1)
