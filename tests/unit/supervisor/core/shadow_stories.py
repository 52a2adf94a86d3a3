"""A plugin of pytest: stories of sessions have the reducer in their shadow, and fail if it differs.

`LISTED` are the stories that differ, and why: a difference that is not listed fails its story, and
so does a listed one that is no more.
"""

from __future__ import annotations

import os
from typing import Any

from tests.unit.supervisor import session_world
from tests.unit.supervisor.core.shadow import Shadow

LISTED = {
    "test_a_foreign_node_is_not_blamed_for_the_time_in_which_its_request_is_kept_back": (
        "the fakes keep a request to a foreign node back themselves, unseen by the reducer: "
        "the shell is to say `Replied(changed)` where the bytes leave"
    ),
    "test_what_becomes_wrong_while_another_node_is_restarted_is_found_within_a_second": (
        "while a node is away the session says only what is worse, not that it has healed: "
        "the reducer is to have looks of its own"
    ),
}
"""Stories that differ, without their parameters: what the reducer is not given in them."""

_Session = session_world.Session
_made = session_world.SessionWorld.__init__
_worlds: list[Any] = []


class _Shadowed(_Session):
    async def run(self) -> Any:
        shadow = Shadow(self, _worlds[-1], self._options)
        result = await super().run()
        found = shadow.differences(int(result.exit_code))
        story = os.environ["PYTEST_CURRENT_TEST"].partition("::")[2].partition(" ")[0]
        is_listed = story.partition("[")[0] in LISTED
        assert bool(found) == is_listed, f"the reducer differs, listed: {is_listed}: {found}"
        return result


def _make(self: Any, *arguments: Any, **options: Any) -> None:
    _made(self, *arguments, **options)
    _worlds[:] = [self]


session_world.Session = _Shadowed
session_world.SessionWorld.__init__ = _make
