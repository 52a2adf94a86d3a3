"""Signals that end a run, wherever they come."""

from __future__ import annotations

import contextlib
import os
import signal
import weakref
from collections.abc import Callable

import pytest

from lifecycle.errors import ExitCode
from lifecycle.supervisor.run.signals import Ended, Ending


@pytest.mark.parametrize(
    ("number", "exit_code"),
    [
        (signal.SIGINT, ExitCode.INTERRUPTED),
        (signal.SIGTERM, ExitCode.TERMINATED),
        (signal.SIGHUP, ExitCode.HUNG_UP),
    ],
)
def test_a_signal_is_raised_and_says_how_the_run_exits(number: int, exit_code: ExitCode) -> None:
    with pytest.raises(Ended) as raised, Ending():
        os.kill(os.getpid(), number)
    assert raised.value.number == number
    assert raised.value.exit_code == exit_code


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_signal_whose_exception_was_lost_is_found_at_the_next_look() -> None:
    class Thing:
        pass

    thing = Thing()
    lost = weakref.ref(thing, lambda _: os.kill(os.getpid(), signal.SIGINT))
    with Ending() as ending:
        del thing  # what a callback of a weak reference raises is printed and forgotten
        assert lost() is None
        with pytest.raises(Ended, match="SIGINT"):
            ending.check()


def _makes_a_class() -> None:
    class Named:
        def __set_name__(self, owner: type, name: str) -> None:
            os.kill(os.getpid(), signal.SIGTERM)

    type("Made", (), {"named": Named()})


def _imports() -> None:
    with contextlib.suppress(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGTERM)
    raise ImportError("initialization failed")


def _asks_for_a_hash() -> None:
    class Late:
        def __get__(self, instance: object, owner: type | None = None) -> object:
            os.kill(os.getpid(), signal.SIGTERM)
            return lambda: 1

    late = type("Hashed", (), {"__hash__": Late()})()
    {late}  # noqa: B018


@pytest.mark.parametrize("does", [_makes_a_class, _imports, _asks_for_a_hash])
def test_a_signal_of_which_python_makes_an_error_of_its_own_is_that_signal_again(
    does: Callable[[], None],
) -> None:
    with pytest.raises(Ended, match="SIGTERM"), Ending() as ending, ending.unmasked():
        does()


@pytest.mark.parametrize("after_one", [False, True])
def test_an_error_without_a_signal_or_after_one_that_was_only_noted_stays_what_it_is(
    after_one: bool,
) -> None:
    def fails(ending: Ending) -> None:
        with ending.noted():
            if after_one:
                os.kill(os.getpid(), signal.SIGTERM)
        raise ValueError("mine")

    with pytest.raises(ValueError, match="mine"), Ending() as ending, ending.unmasked():
        fails(ending)


def test_where_something_is_made_a_signal_is_noted_and_raised_where_something_waits() -> None:
    with Ending() as ending, ending.noted():
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)
        assert ending.number == signal.SIGTERM
        with pytest.raises(Ended, match="SIGTERM"), ending.raised():
            pytest.fail("it went on waiting")
        os.kill(os.getpid(), signal.SIGTERM)


def test_what_was_there_before_is_there_again() -> None:
    before = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    with Ending() as ending:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # as a loop leaves it
        ending.resume()
        with pytest.raises(Ended):
            os.kill(os.getpid(), signal.SIGTERM)
    after = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    assert after == before


def test_after_the_last_of_a_process_signals_change_nothing() -> None:
    before = {each: signal.getsignal(each) for each in (signal.SIGTERM, signal.SIGHUP)}
    try:
        with Ending(is_last=True) as ending:
            pass
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGHUP)
        assert ending.number is None
    finally:
        for number, found in before.items():
            signal.signal(number, found)
        signal.signal(signal.SIGINT, signal.default_int_handler)


def test_a_run_under_nohup_outlives_its_terminal() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Ending() as ending:
            assert ending.numbers == (signal.SIGINT, signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGHUP)
            assert ending.number is None
    finally:
        signal.signal(signal.SIGHUP, before)
