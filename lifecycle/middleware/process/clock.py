"""Notices that the machine's clock is set, and wakes up for nothing else (timerfd_create(2)).

Owns: `ClockTimer`, and `ClockWatch` for those without a thread that could poll it. Who waits until
a time of the wall clock waits an hour too long where that is set back by one. So does a condition
variable with a timeout, whatever clock that is on, in libraries built for a glibc before 2.30,
which has no pthread_cond_clockwait(3): the wheels of rclpy and Fast DDS are. Executors then call no
timer, and participants send nothing that is due, until something else wakes them. Must not import
rclpy.
"""

from __future__ import annotations

import ctypes
import errno
import os
import threading
from collections.abc import Callable

from lifecycle.middleware.process.control import TimerSpec, libc

_CLOCK_REALTIME = 0
_TFD_CLOEXEC = 0o2000000
_TFD_TIMER_ABSTIME = 1
_TFD_TIMER_CANCEL_ON_SET = 2
_NEVER = TimerSpec(value_s=2**33)
_AT_ONCE = TimerSpec(value_ns=1)
_COUNT_BYTES = 8


class ClockTimer:
    """Readable (poll(2)) once the machine's clock is set.

    Attributes:
        works: False where the kernel refuses; then it is never to be waited for.
    """

    def __init__(self) -> None:
        self._timer = int(libc().timerfd_create(_CLOCK_REALTIME, _TFD_CLOEXEC))
        self.works = self._timer >= 0
        if self.works:
            self._arm(_TFD_TIMER_ABSTIME | _TFD_TIMER_CANCEL_ON_SET, _NEVER)

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._timer

    def is_set(self) -> bool:
        """Wait until the clock is set; False if it is not to be waited any more."""
        try:
            os.read(self._timer, _COUNT_BYTES)
        except OSError as error:
            return error.errno == errno.ECANCELED
        return False

    def end(self) -> None:
        """Have who waits, now or later, wait no more."""
        self._arm(0, _AT_ONCE)

    def close(self) -> None:
        """Give the descriptor back."""
        os.close(self._timer)

    def _arm(self, flags: int, when: TimerSpec) -> None:
        libc().timerfd_settime(self._timer, flags, ctypes.byref(when), None)


class ClockWatch:
    """Calls back in a thread of its own each time that the machine's clock is set, until `close`.

    Where the kernel or a limit of threads refuses, it calls nobody back.

    Args:
        on_set: called in the thread; it must not raise.
    """

    def __init__(self, on_set: Callable[[], None]) -> None:
        self._on_set = on_set
        self._timer = ClockTimer()
        self._thread: threading.Thread | None = None
        if not self._timer.works:
            return
        thread = threading.Thread(target=self._run, name="clock", daemon=True)
        try:
            thread.start()
        except RuntimeError:
            self._timer.close()
        else:
            self._thread = thread

    def close(self) -> None:
        """End the thread; again is harmless."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._timer.end()
            thread.join()
            self._timer.close()

    def _run(self) -> None:
        while self._timer.is_set():
            self._on_set()
