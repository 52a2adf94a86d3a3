"""Signals that end a run, wherever they come."""

from __future__ import annotations

import contextlib
import os
import signal
import weakref

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


def test_a_signal_that_comes_while_a_class_is_made_is_no_error_of_the_class() -> None:
    class Named:
        def __set_name__(self, owner: type, name: str) -> None:
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(Ended, match="SIGTERM"), Ending() as ending, ending.unmasked():
        type("Made", (), {"named": Named()})


def test_a_signal_that_an_import_makes_its_own_error_of_is_no_error_of_the_import() -> None:
    def imports() -> None:
        with contextlib.suppress(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        raise ImportError("initialization failed")

    with pytest.raises(Ended, match="SIGINT"), Ending() as ending, ending.unmasked():
        imports()


def test_a_signal_that_is_lost_where_a_hash_is_asked_for_is_no_error_of_the_value() -> None:
    class Late:
        def __get__(self, instance: object, owner: type | None = None) -> object:
            os.kill(os.getpid(), signal.SIGHUP)
            return lambda: 1

    late = type("Hashed", (), {"__hash__": Late()})()
    with pytest.raises(Ended, match="SIGHUP"), Ending() as ending, ending.unmasked():
        {late}  # noqa: B018


def test_an_error_without_a_signal_or_after_one_that_was_only_noted_stays_what_it_is() -> None:
    def fails(ending: Ending, *, after_one: bool) -> None:
        with ending.noted():
            if after_one:
                os.kill(os.getpid(), signal.SIGTERM)
        raise ValueError("mine")

    for after_one in (False, True):
        with pytest.raises(ValueError, match="mine"), Ending() as ending, ending.unmasked():
            fails(ending, after_one=after_one)


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


def test_a_run_under_nohup_outlives_its_terminal() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Ending() as ending:
            assert ending.numbers == (signal.SIGINT, signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGHUP)
            assert ending.number is None
    finally:
        signal.signal(signal.SIGHUP, before)
