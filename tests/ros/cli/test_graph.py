"""`lifecycle graph` of systems that run, with and without a supervisor, on real DDS."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from lifecycle.errors import ExitCode
from tests.ros.supervisor.running import (
    BOUND_S,
    ENOUGH,
    ROOT,
    Up,
    command,
    environment,
    pair,
    up,
    verb,
)

pytestmark = pytest.mark.thorough


def picture(*words: str, runtime: Path) -> dict[str, Any]:
    """The picture that `lifecycle graph` draws, as JSON."""
    drawn = verb("graph", *words, "--format", "json", runtime=runtime)
    assert drawn.returncode == ExitCode.OK, drawn.stderr
    return dict(json.loads(drawn.stdout))


def states(drawn: dict[str, Any]) -> dict[str, tuple[str, str]]:
    """Presence and state of each node."""
    return {node["name"]: (node["presence"], node["state"]) for node in drawn["nodes"]}


ACTIVE = ("present", "active")


@pytest.fixture(scope="module")
def active(tmp_path_factory: pytest.TempPathFactory, shared_domain: int) -> Iterator[Up]:
    """An active pair to look at."""
    directory = tmp_path_factory.mktemp("active")
    with up(pair(directory, shared_domain), runtime=directory) as run:
        run.until("system", reached="active")
        yield run
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK, run.of_kind("verdict")


def test_a_supervised_system_is_drawn_with_its_processes_and_flows(active: Up) -> None:
    runtime, manifest = active.runtime, active.manifest
    for target in ("pair", str(manifest)):
        drawn = picture(target, runtime=runtime)
        assert (drawn["phase"], drawn["verdict"]) == ("active", "ok")
        assert states(drawn) == {"/listener": ACTIVE, "/talker": ACTIVE}
    pids = {node["name"]: node["pid"] for node in drawn["nodes"]}
    assert pids == {f"/{key}": active.pid_of(key) for key in ("listener", "talker")}
    (line,) = (each for each in drawn["lines"] if each["name"] == "/chatter")
    (flow,) = line["flows"]
    assert (flow["source"], flow["target"], flow["presence"], flow["outcome"]) == (
        "/talker",
        "/listener",
        "present",
        "ok",
    )
    assert flow["notes"][0].startswith("udp ")


def test_without_a_supervisor_what_runs_is_looked_at_from_outside(
    tmp_path: Path, active: Up, shared_domain: int
) -> None:
    seen = picture(str(active.manifest), *ENOUGH, runtime=tmp_path)
    assert (seen["phase"], seen["verdict"]) == ("", "ok")
    assert states(seen) == {"/listener": ACTIVE, "/talker": ACTIVE}

    other = pair(tmp_path, shared_domain, edit={"nodes/third": _THIRD})
    seen = picture(str(other), "--timeout", "0", runtime=tmp_path)
    assert states(seen)["/third"] == ("missing", "not there")


def test_where_nothing_runs_what_is_declared_is_missing(tmp_path: Path, fresh_domain: int) -> None:
    empty = verb("graph", str(pair(tmp_path, fresh_domain)), "--timeout", "0", runtime=tmp_path)
    assert empty.returncode == ExitCode.OK
    assert "declared, but missing, ⚠2" in empty.stdout
    assert empty.stderr == (
        f"no node in the graph; looked in ROS domain {fresh_domain} with rmw_fastrtps_cpp, "
        "discovery range localhost\n"
    )


_THIRD = {"run": {"attach": True}, "managed": False}


@pytest.fixture
def watching(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts `lifecycle graph --watch`, and ends it."""
    started: list[subprocess.Popen[str]] = []

    def watch(*words: str) -> subprocess.Popen[str]:
        started.append(
            subprocess.Popen(
                [*command("graph"), *words, "--watch"],
                cwd=ROOT,
                env=environment(tmp_path, ""),
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
        return started[-1]

    yield watch
    for process in started:
        process.send_signal(signal.SIGINT)  # one that is killed leaves its shared memory
        process.wait(BOUND_S)
        for stream in (process.stdout, process.stderr):
            assert stream is not None
            stream.close()


def until(process: subprocess.Popen[str], holds: Callable[[dict[str, Any]], bool]) -> None:
    """Read pictures until one is as wanted."""
    assert process.stdout is not None
    late = threading.Timer(BOUND_S, process.send_signal, [signal.SIGINT])
    late.start()
    last = ""
    try:
        for last in process.stdout:
            if holds(json.loads(last)):
                return
    finally:
        late.cancel()
    raise AssertionError(f"it never came; the last picture was {last}")


def test_a_watched_supervisor_shows_each_change_until_it_ends(
    tmp_path: Path, fresh_domain: int, watching: Callable[..., subprocess.Popen[str]]
) -> None:
    with up(pair(tmp_path, fresh_domain), "--keep-going", runtime=tmp_path) as run:
        run.until("system", reached="active")
        watch = watching("pair", "--format", "json")
        until(watch, lambda drawn: states(drawn) == {"/listener": ACTIVE, "/talker": ACTIVE})
        assert verb("pause", "pair", runtime=tmp_path).returncode == ExitCode.OK
        until(watch, lambda drawn: drawn["phase"] == "paused")
        psutil.Process(run.pid_of("talker")).send_signal(signal.SIGKILL)
        until(watch, lambda drawn: states(drawn)["/talker"] == ("missing", "dead"))
        assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
        _, said = watch.communicate(timeout=BOUND_S)
        assert watch.returncode == ExitCode.OK
        assert said == f"pair@{fresh_domain}: its supervisor has ended\n"


def test_a_watched_page_is_replaced_when_nodes_come(
    tmp_path: Path,
    fresh_domain: int,
    watching: Callable[..., subprocess.Popen[str]],
    wait_until: Callable[..., None],
) -> None:
    manifest, page = pair(tmp_path, fresh_domain), tmp_path / "graph.html"
    remote_nodes = tmp_path / "elsewhere"
    remote_nodes.mkdir()
    watching(str(manifest), "--format", "html", "--output", str(page))
    wait_until(page.is_file, timeout_s=BOUND_S)
    assert "∅ not there" in page.read_text()
    with up(manifest, runtime=remote_nodes) as run:
        run.until("system", reached="active")
        pids = {str(run.pid_of(key)) for key in ("listener", "talker")}
        shown = re.compile(r"● active · pid (\d+)")
        wait_until(lambda: set(shown.findall(page.read_text())) == pids, timeout_s=BOUND_S)
        whole = page.read_text()
        assert whole.endswith("</html>\n")
        # Another change may be written at this moment, and takes the place of the page whole.
        wait_until(lambda: list(tmp_path.glob(".graph.html.*")) == [], timeout_s=BOUND_S)


def test_pictures_that_are_no_text_need_a_file_to_be_watched(tmp_path: Path) -> None:
    refused = verb("graph", "pair", "--format", "svg", "--watch", runtime=tmp_path)
    assert refused.returncode == ExitCode.USAGE
    assert refused.stderr == "cannot print one svg picture after another; give --output FILE\n"


def test_a_foreign_system_shows_who_was_not_declared(tmp_path: Path, foreign: int) -> None:
    # Never as declared, so it is looked at until this is over, and discovery has told all.
    seen = picture(str(pair(tmp_path, foreign)), "--timeout", "5", runtime=tmp_path)
    found = states(seen)
    assert found["/talker"] == ("missing", "not there")
    assert found["/left/scanner"] == ("undeclared", "not managed")
    assert found["/left/managed"] == ("undeclared", "state unknown")
    scans = [f for line in seen["lines"] if line["name"] == "/left/scan" for f in line["flows"]]
    assert [(each["source"], each["target"], each["presence"]) for each in scans] == [
        ("/left/scanner", "/off", "undeclared")
    ]
