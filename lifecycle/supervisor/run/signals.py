"""Signals that end a run, from before there is a session until after the last of it is swept.

Owns: `Ending`, which no SIGINT, SIGTERM or SIGHUP escapes. By default SIGTERM would kill a
supervisor whose participant already has files in /dev/shm, and a KeyboardInterrupt that is raised
in a destructor or while a module is imported is printed and forgotten. Imports next to nothing: it
is imported before everything else.
"""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from types import FrameType

from lifecycle.errors import ExitCode

ENDED_BY: dict[int, tuple[str, ExitCode]] = {
    signal.SIGINT: ("interrupted", ExitCode.INTERRUPTED),
    signal.SIGTERM: ("terminated", ExitCode.TERMINATED),
    signal.SIGHUP: ("the terminal was closed", ExitCode.HUNG_UP),
}
"""What each signal is called as the reason of an end, and the exit code of a run that it cut short.

A run that had come as far as it was asked to, and that nothing bound to stay, was not cut short by
SIGTERM or SIGHUP: core/failure.py."""


class Ended(KeyboardInterrupt):
    """A signal asked the run to end before it had a session; raised where it then was.

    Attributes:
        number: the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number

    @property
    def reason(self) -> str:
        """Of the end, as text."""
        return ENDED_BY[self.number][0]

    @property
    def exit_code(self) -> ExitCode:
        """Of a run that had not begun, or not come far, when it ended so."""
        return ENDED_BY[self.number][1]


class Ending:
    """Use it in a `with`, in the main thread; what it found is there again afterwards.

    Args:
        is_last: nothing comes after it in this process: signals are ignored then.

    Attributes:
        number: the first signal that came, and None before.
    """

    def __init__(self, *, is_last: bool = False) -> None:
        self._is_last = is_last
        self.number: int | None = None
        self._raises = True
        self._raised = False
        self._found: dict[int, Callable[[int, FrameType | None], object] | int | None] = {}

    def __enter__(self) -> Ending:  # noqa: PYI034 - typing.Self is not in Python 3.10
        for number in ENDED_BY:
            found = signal.getsignal(number)
            if number == signal.SIGHUP and found is signal.SIG_IGN:
                continue  # nohup(1): the run is to outlive its terminal
            self._found[number] = found
            signal.signal(number, self._take)
        return self

    def __exit__(self, *_: object) -> None:
        for number, found in self._found.items():
            signal.signal(number, signal.SIG_IGN if self._is_last else found)

    @property
    def numbers(self) -> tuple[int, ...]:
        """The signals that end a run: those that were not ignored before."""
        return tuple(self._found)

    def check(self) -> None:
        """Raise for a signal whose exception was lost on its way.

        Raises:
            Ended: one has come.
        """
        if self.number is not None:
            raise Ended(self.number)

    @contextlib.contextmanager
    def unmasked(self) -> Iterator[None]:
        """Within, what came of a signal's exception on its way out is that exception again.

        Python raises one of its own instead where a class or an extension module is being made, and
        where a hash is asked for, even without naming what it was.

        Raises:
            Ended: a signal was raised.
        """
        try:
            yield
        except Exception as error:
            if not self._raised or self.number is None:
                raise
            raise Ended(self.number) from error

    @contextlib.contextmanager
    def noted(self) -> Iterator[None]:
        """Within, a signal is only noted: what is being made or taken down must be finished."""
        raises, self._raises = self._raises, False
        try:
            yield
        finally:
            self._raises = raises

    @contextlib.contextmanager
    def raised(self) -> Iterator[None]:
        """Within, a signal is raised again, also one that was noted: what waits must not go on.

        Raises:
            Ended: a signal has come, or comes.
        """
        raises, self._raises = self._raises, True
        try:
            self.check()
            yield
        finally:
            self._raises = raises

    def resume(self) -> None:
        """Take the signals back from a loop, which leaves them with their default actions."""
        for number in self._found:
            signal.signal(number, self._take)

    def _take(self, number: int, frame: FrameType | None) -> None:
        del frame
        if self.number is None:
            self.number = number
        if self._raises:
            self._raised = True
            raise Ended(number)
