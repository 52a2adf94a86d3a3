"""The clock of the machine is set while a system runs: nothing stops, and nothing is misjudged."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest
import yaml

from lifecycle.errors import ExitCode
from tests.ros.supervisor.running import pair, up, verb
from tests.wall_clock import LACKS, WallClock

pytestmark = pytest.mark.skipif(bool(LACKS), reason=LACKS)


def test_a_node_that_nothing_else_wakes_goes_on_when_the_clock_is_set_back(
    tmp_path: Path, fresh_domain: int
) -> None:
    clock = WallClock(tmp_path)
    manifest = pair(tmp_path, fresh_domain)
    document = yaml.safe_load(manifest.read_text())
    ticking = {"run": {"python": "tests.ros.supervisor.systems:Ticking"}, "interface": {}}
    document |= {"nodes": {"ticking": ticking}, "links": []}
    manifest.write_text(yaml.safe_dump(document))
    with up(manifest, runtime=tmp_path, variables=clock.variables) as run:
        run.until("system", reached="active")
        for number, ahead_s in enumerate((-3600.0, -7200.0, -10_800.0), start=1):
            run.until("log", line=f"tick {2 * number}")
            clock.set(ahead_s)
        run.until("log", line="tick 9")


@pytest.mark.thorough
def test_timers_restarts_and_the_journal_go_on_when_the_clock_is_set(
    tmp_path: Path, fresh_domain: int
) -> None:
    edit = {
        "restart": "on-failure",
        "nodes/talker/run/python": "tests.ros.supervisor.systems:Counting",
    }
    clock = WallClock(tmp_path)
    manifest = pair(tmp_path, fresh_domain, edit=edit)
    with up(manifest, runtime=tmp_path, variables=clock.variables) as run:
        run.until("system", reached="active")
        heard = 0
        for ahead_s in (3600.0, -3600.0):
            clock.set(ahead_s)
            # By twenty messages later it is a timer of afterwards that sends.
            heard += 20
            run.until("log", process="listener", line=f"heard {heard}")
        os.kill(run.pid_of("talker"), signal.SIGKILL)
        assert run.until("restarted")["restarts"] == 1
        run.until("log", process="listener", line="heard 20")
        status = verb("status", "pair", "--format", "json", runtime=tmp_path)
        assert status.returncode == ExitCode.OK, status.stdout
        for node in json.loads(status.stdout)["nodes"]:
            assert node["state"] == "active"
            assert 0.0 <= node["uptime_s"] < 40.0
        assert run.of_kind("silent") == []
        assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
        assert run.finish() == ExitCode.OK
        told = verb("history", runtime=tmp_path).stdout
        # In the hour ahead nothing may have happened that the journal has.
        assert "  the clock of this host was set back by " in told, told
        run.assert_nothing_left()
