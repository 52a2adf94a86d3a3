"""Run mutmut with the tests collected once, not anew for each of thousands of mutants.

mutmut starts pytest in every fork; to collect a few hundred tests takes longer than to run them
until one fails. Here the parent collects them, and each fork runs those that reach its mutant:
first the ones that have killed most mutants of the same function, or of its module.

Usage: python -m tests.mutation.run [PATTERN...], as `mutmut run`.
"""

from __future__ import annotations

import collections
import contextlib
import json
import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import mutmut.__main__ as program
import pytest
from _pytest.assertion import util as assertion
from _pytest.config import _prepareconfig
from mutmut.configuration import config
from mutmut.runners.harness import PytestRunner
from mutmut.state import state
from mutmut.utils.file_utils import change_cwd
from mutmut.utils.format_utils import mangled_name_from_mutant_name
from mutmut.workers.isolation import ForkRunner, MutantResult, run_in_fork

from tests.mutation.report import justified, mutants

_CHILDREN = 2
_BROKEN = 35
"""mutmut's exit code for what is neither killed nor survived."""


class _Collected(PytestRunner):
    """Runs tests that were collected before the fork."""

    def __init__(self) -> None:
        super().__init__()
        self._kills: dict[str, collections.Counter[str]] = {}
        self._session: pytest.Session | None = None
        self._items: dict[str, pytest.Item] = {}
        self._read, self._write = os.pipe()
        os.set_blocking(self._read, False)

    def collect(self) -> None:
        """Collect all tests; what a fork prints is not wanted."""
        options = ["--rootdir=.", "--capture=no", *config().pytest_add_cli_args]
        selection = config().pytest_add_cli_args_test_selection
        nowhere = Path(os.devnull).open("w")  # noqa: SIM115 - the forks write to it
        with change_cwd("mutants"), contextlib.redirect_stdout(nowhere):
            settings = _prepareconfig([*options, *selection])
            assertion.assertrepr_compare = lambda **_: None
            settings._do_configure()
            self._session = pytest.Session.from_config(settings)
            settings.hook.pytest_sessionstart(session=self._session)
            settings.hook.pytest_collection(session=self._session)
        self._items = {each.nodeid: each for each in self._session.items}

    def run_tests(self, *, mutant_name: str | None, tests: Iterable[str]) -> int:
        """Run tests in a fork; what goes wrong here must not look as if a test had failed."""
        if mutant_name is None:
            return super().run_tests(mutant_name=mutant_name, tests=tests)
        try:
            return self._run_collected(mutant_name, tests)
        except BaseException:  # noqa: BLE001
            return _BROKEN

    def _run_collected(self, mutant_name: str, tests: Iterable[str]) -> int:
        assert self._session is not None
        function = mangled_name_from_mutant_name(mutant_name) if mutant_name else ""
        session = self._session
        session.items = [self._items[each] for each in self._ordered(function, tests)]
        session.config.pluginmanager.register(_Killer(function, self._write))
        with change_cwd("mutants"):
            session.config.hook.pytest_runtestloop(session=session)
        return 0

    def _ordered(self, function: str, tests: Iterable[str]) -> list[str]:
        """Put those first that are most likely to fail, else those that take the least time."""
        module = function.rpartition(".")[0]
        by_test = self._kills.get(function, collections.Counter())
        by_file = self._kills.get(module, collections.Counter())

        def place(test: str) -> tuple[int, bool, int]:
            file = test.partition("::")[0]
            named = module.rpartition(".")[2] in file
            return -by_test[test], not named, -by_file[file]

        return sorted((each for each in tests if each in self._items), key=place)

    def note_kills(self) -> None:
        """Take in which tests have failed since the last time."""
        with contextlib.suppress(BlockingIOError):
            for line in os.read(self._read, 1 << 20).decode().splitlines():
                function, _, test = line.partition("\t")
                module, file = function.rpartition(".")[0], test.partition("::")[0]
                self._kills.setdefault(function, collections.Counter())[test] += 1
                self._kills.setdefault(module, collections.Counter())[file] += 1


class _Killer:
    """Ends the fork at the first failure; to describe it would take longer than the test."""

    def __init__(self, function: str, pipe: int) -> None:
        self._function = function
        self._pipe = pipe

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_makereport(self, item: pytest.Item, call: pytest.CallInfo[None]) -> None:
        if call.excinfo and not call.excinfo.errisinstance(pytest.skip.Exception):
            os.write(self._pipe, f"{self._function}\t{item.nodeid}\n".encode())
            os._exit(1)


class _Runner(ForkRunner):
    """Forks once everything is collected."""

    test_runner: _Collected

    def startup(self) -> None:
        self.test_runner.collect()
        tests = list(state().duration_by_test)
        clean = run_in_fork(lambda: self.test_runner.run_tests(mutant_name="", tests=tests))
        if clean != 0:
            sys.exit(f"cannot try mutants: the tests fail without any ({clean})")
        super().startup()

    def run_clean_tests(self, tests: Iterable[str]) -> int:
        return 0  # at startup, as every mutant's are

    def wait_for_result(self, timeout: float | None = None) -> MutantResult:
        result = super().wait_for_result(timeout)
        self.test_runner.note_kills()
        return result


def _forget_survivors() -> None:
    """Have what survived tried again, for which there may be a test now, and nothing else.

    Which tests reach a function is recorded anew as well.
    """
    allowed = justified()
    again: dict[Path, set[str]] = collections.defaultdict(set)
    for each in mutants():
        if each.exit_code is not None and not (
            each.killed or (each.survived and each.reasons(allowed))
        ):
            again[each.module].add(each.key)
    for module, keys in again.items():
        meta = module.with_name(f"{module.name}.meta")
        noted = json.loads(meta.read_text("utf-8"))
        noted["exit_code_by_key"] |= dict.fromkeys(keys)
        meta.write_text(json.dumps(noted, indent=4), "utf-8")
    Path("mutants/mutmut-stats.json").unlink(missing_ok=True)


def main(patterns: Sequence[str]) -> None:
    """Try the mutants whose names match, or all that no test has killed."""
    _forget_survivors()
    program.get_mutant_runner = lambda children: _Runner(children, _Collected())
    program._run(tuple(patterns), _CHILDREN)


if __name__ == "__main__":
    main(sys.argv[1:])
