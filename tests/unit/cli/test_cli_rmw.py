"""An RMW that cannot be loaded is refused before rcl ends the process without a word of ours."""

from __future__ import annotations

import pytest

from lifecycle.cli import main
from lifecycle.errors import ExitCode


@pytest.mark.parametrize("verb", ["up", "verify", "flows", "graph"])
def test_an_rmw_that_is_not_installed_is_one_clear_error(
    verb: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_nonsense_cpp")

    assert main([verb, "robot.lifecycle.yaml"]) is ExitCode.USAGE

    assert capfd.readouterr().err == (
        "cannot use RMW_IMPLEMENTATION='rmw_nonsense_cpp': this installation of ROS 2 cannot load "
        "that RMW; install it, or unset RMW_IMPLEMENTATION: the default is rmw_fastrtps_cpp\n"
    )
