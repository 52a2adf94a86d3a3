"""A plugin of pytest: stories of sessions have the reducer in their shadow, and differ or not."""

from __future__ import annotations

import os
import sys
from typing import Any

from tests.unit.supervisor import session_world
from tests.unit.supervisor.core.shadow import Shadow

_Session = session_world.Session
_made = session_world.SessionWorld.__init__
_worlds: list[Any] = []


class _Shadowed(_Session):
    async def run(self) -> Any:
        shadow = Shadow(self, _worlds[-1], self._options)
        result = await super().run()
        found = shadow.differences(int(result.exit_code))
        print(os.environ["PYTEST_CURRENT_TEST"], found, file=sys.__stderr__)
        return result


def _make(self: Any, *arguments: Any, **options: Any) -> None:
    _made(self, *arguments, **options)
    _worlds[:] = [self]


session_world.Session = _Shadowed
session_world.SessionWorld.__init__ = _make
