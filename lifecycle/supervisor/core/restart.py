"""When a failed process is started again: delay with exponential backoff, start limit, giving up.

Owns: `RestartPolicy`: given failures and a clock it says when to start again, or that it gives up.
What the keys mean is systemd.service(5)'s. Pure: it starts nothing and looks at no clock.
"""

from __future__ import annotations

import math

from lifecycle.manifest.model import Restart, Supervision


class RestartPolicy:
    """Decides for one process.

    Args:
        how: what the manifest says.
        started_s: when it was started for the first time, by any clock that only goes forward.

    Attributes:
        restarts: how often it has been started again after a failure.
    """

    def __init__(self, how: Supervision, started_s: float) -> None:
        self.how = how
        self.restarts = 0
        self._starts = [started_s]
        self._in_a_row = 0

    def failed(self, now_s: float, *, was_up: bool = True) -> float | None:
        """Take one failure.

        Args:
            now_s: by the same clock.
            was_up: its system was up before. Until then no start is forgotten: a process that fails
                late each time must not hold a bring-up for ever.

        Returns:
            When it is to be started again, by the same clock; None to give up.
        """
        interval_s = self.how.start_limit_interval_sec
        if interval_s and now_s - self._starts[-1] >= interval_s:
            self._in_a_row = 0
        self._in_a_row += 1
        again_s = now_s + delay_s(self.how, self._in_a_row)
        if interval_s:
            if was_up:
                self._starts = [each for each in self._starts if each > again_s - interval_s]
            if len(self._starts) >= self.how.start_limit_burst:
                return None
        return again_s

    def started(self, now_s: float, *, after_failure: bool = True) -> None:
        """Note that it was started again, also where another's failure took it down or cut it off.

        systemd.unit(5): StartLimitBurst= applies to all kinds of starts.
        """
        self.restarts += after_failure
        # Without a limit they are not counted, and must not pile up.
        kept = self._starts if self.how.start_limit_interval_sec else []
        self._starts = [*kept, now_s]

    def reset(self, now_s: float) -> None:
        """Begin anew: a person restarted it."""
        self._starts = [now_s]
        self._in_a_row = 0


def is_restarted(how: Supervision, exit_status: int | None) -> bool:
    """Return whether a process is started again after such an end; None: not an exit by itself."""
    if how.restart is Restart.ON_FAILURE:
        return exit_status != 0
    return how.restart is Restart.ALWAYS


def delay_s(how: Supervision, in_a_row: int) -> float:
    """Return the seconds between a failure and the next start.

    Args:
        how: what the manifest says.
        in_a_row: failures so far without a long run between them, this one included, >= 1.
    """
    longest = how.restart_max_delay_sec
    if longest is None or not how.restart_steps or not how.restart_sec:
        return how.restart_sec
    if in_a_row > how.restart_steps:
        return longest
    exponent = (in_a_row - 1) / how.restart_steps
    return how.restart_sec * math.pow(longest / how.restart_sec, exponent)
