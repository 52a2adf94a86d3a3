"""How long the machine kept everybody waiting, so that a promise in seconds can be tested on it.

Owns: `Stalls`, which notes the time that a scheduler took from us, and `assert_in_time`. What is
promised is how long a mechanism takes; a machine that runs something else meanwhile says nothing
about that.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

TRIES = 3
AT_WORST_S = 6.0
"""In no try may anything be later than this, whatever else the machine does."""

_PAUSE_S = 0.02
_WORK = 100_000
_SAMPLES = 5


class Stalls:
    """Sleeps and works in turns, and notes by how much either took longer than it should."""

    def __init__(self) -> None:
        self._end = threading.Event()
        self._late: list[tuple[float, float]] = []
        self._least_s = min(_worked_s() for _ in range(_SAMPLES))
        self._thread = threading.Thread(target=self._note, name="stalls", daemon=True)
        self._thread.start()

    def between(self, began: float, ended: float) -> float:
        """Return the seconds lost between two times of `time.monotonic`."""
        return sum(
            max(0.0, min(until, ended) - max(since, began)) for since, until in tuple(self._late)
        )

    def longest(self, began: float, ended: float) -> float:
        """Return the longest single stall between two times, in seconds; 0 without any."""
        late = (min(until, ended) - max(since, began) for since, until in tuple(self._late))
        return max(0.0, *late, 0.0)

    def taken(self, began: float, ended: float) -> float:
        """Return the seconds between two times that were not lost."""
        return ended - began - self.between(began, ended)

    def close(self) -> None:
        """Stop noting."""
        self._end.set()
        self._thread.join()

    def _note(self) -> None:
        began = time.monotonic()
        while not self._end.wait(_PAUSE_S):
            _worked_s()
            ended = time.monotonic()
            late_s = ended - began - _PAUSE_S - self._least_s
            if late_s > 0:
                self._late.append((ended - late_s, ended))
            began = ended


@contextlib.contextmanager
def noted_stalls() -> Iterator[Stalls]:
    """Note the stalls of the machine."""
    stalls = Stalls()
    try:
        yield stalls
    finally:
        stalls.close()


def assert_in_time(late_s: Callable[[], float]) -> None:
    """Assert that something happens in time in one of a few tries, and never far too late.

    Args:
        late_s: does it once, and returns by how much it was late in seconds; negative: in time.
    """
    tries: list[float] = []
    for _ in range(TRIES):
        tries.append(late_s())
        assert tries[-1] <= AT_WORST_S, tries
        if tries[-1] <= 0:
            return
    raise AssertionError(f"late in every try, by seconds: {tries}")


def _worked_s() -> float:
    """Return how long a fixed amount of work took."""
    began = time.monotonic()
    sum(range(_WORK))
    return time.monotonic() - began
