"""Names that ROS would refuse, announced by a DDS participant beside an active system."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest
import yaml

from tests.installation import LIFECYCLE, modules
from tests.ros.faults.system import BARE_DDS, ExitCode, healthy

pytestmark = [pytest.mark.ros, pytest.mark.thorough]

LIMIT_S = 60.0
STRING = b":std_msgs::msg::dds_::String_"
TOPICS = {
    b"foo-bar": "/foo-bar",
    b"foo.bar": "/foo.bar",
    b"foo bar": "/foo bar",
    b"1foo": "/1foo",
    b"f\xffo": "/f\\xffo",
    b"": "/",
    b"/": "//",
    b"a/": "/a/",
    b"a__b": "/a__b",
    b"a\x1b[2Jb": "/a\\x1b[2Jb",
    b"a\nb": "/a\\nb",
    b"a\rb": "/a\\rb",
    b"a\tb": "/a\\tb",
    b"a\xc2\x9b2Jb": "/a\\x9b2Jb",
    b"a\xe2\x80\xaeb": "/a\\u202eb",
    b"[red]b": "/[red]b",
    "é".encode(): "/é",
    b"{x}": "/{x}",
    b"$(x)": "/$(x)",
}
"""Bytes after `rt/` → how they are shown."""

NODES = {
    (b"/", b"foo-bar"): "/foo-bar",
    (b"/", b""): "/",
    (b"/", b"a\x1b[31mb"): "/a\\x1b[31mb",
    (b"/", b"1foo"): "/1foo",
    (b"/", "é".encode()): "/é",
    (b"/", b"\xff\xfe"): "/\\xff\\xfe",
    (b"/", b"x\nverdict: ok"): "/x\\nverdict: ok",
    (b"bad", b"x"): "bad/x",
    (b"/a-b", b"x"): "/a-b/x",
    (b"", b"y"): "/y",
    (b"//", b"z"): "/z",
}
"""Namespace and name → how they are shown."""

UNPRINTABLE = "".join(map(chr, (*range(10), *range(11, 32), *range(127, 160), 0x202E)))


def announcements() -> tuple[list[bytes], list[bytes]]:
    """Return who announces topics without a node, and who announces nodes."""
    program = [os.fsencode(each) for each in (sys.executable, BARE_DDS)]
    topics = [
        *(word for topic in TOPICS for word in (b"--write", b"rt/" + topic + STRING)),
        *(b"--write", b"rt/odd_type:\xff\x1b::msg::dds_::\x1bX_"),
        *(b"--read", b"rq/foo-barRequest:std_srvs::srv::dds_::Trigger_Request_"),
    ]
    nodes = [word for names in NODES for word in (b"--node", *names)]
    return [*program, *topics], [*program, b"--write", b"rt/foo-baz" + STRING, *nodes]


@contextlib.contextmanager
def active_system(directory: Path, *words: str) -> Iterator[tuple[Path, subprocess.Popen[str]]]:
    """Bring the healthy system up; once it is active, have every name announced in its domain."""
    manifest = directory / "faults.lifecycle.yaml"
    manifest.write_text(yaml.safe_dump(healthy()))
    up = subprocess.Popen(
        [str(LIFECYCLE), "up", str(manifest), *words],
        cwd=modules(),
        env={**os.environ, "FAULT_MARKERS": str(directory / "markers")},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        assert up.stdout is not None
        reached(up.stdout, "system active after", '"reached":"active"')
        intruders = [subprocess.Popen(each) for each in announcements()]
        try:
            yield manifest, up
        finally:
            for each in intruders:
                each.terminate()
                each.wait(LIMIT_S)
    finally:
        up.kill()
        up.wait(LIMIT_S)
        up.stdout.close()


def reached(output: IO[str], *marks: str) -> str:
    """Return the first line with one of `marks`; the test's own limit bounds the wait."""
    seen = []
    for line in output:
        seen.append(line)
        if any(mark in line for mark in marks):
            return line
    pytest.fail("".join(seen))


def lifecycle(*words: str) -> subprocess.CompletedProcess[bytes]:
    command = [str(LIFECYCLE), *words]
    return subprocess.run(command, cwd=modules(), capture_output=True, timeout=LIMIT_S, check=False)


def assert_plain(output: bytes) -> str:
    text = output.decode()
    assert not set(text) & set(UNPRINTABLE)
    assert "Traceback" not in text
    assert "\nverdict: ok" not in text
    return text


def raw(name: bytes) -> str:
    return name.decode(errors="backslashreplace")


def test_an_active_system_survives_names_outside_the_alphabet_of_ros_and_names_them(
    fresh_domain: int, tmp_path: Path
) -> None:
    missing = {"/" + raw(each) for each in TOPICS}
    missing |= {f"{raw(space).rstrip('/')}/{raw(name)}" for space, name in NODES}
    with active_system(tmp_path, "--format", "json") as (_, up):
        assert up.stdout is not None
        while missing:
            verdict = json.loads(reached(up.stdout, '"event":"verdict"'))["verdict"]
            missing -= {each["subject"] for each in verdict["findings"]}
        up.send_signal(signal.SIGINT)
        output, _ = up.communicate(timeout=LIMIT_S)
    text = assert_plain(output.encode())
    assert up.returncode == ExitCode.INTERRUPTED, text
    assert json.loads(text.splitlines()[-1])["verdict"] == "violated"


@pytest.mark.timeout(240)
def test_every_verb_that_looks_shows_such_names_escaped(fresh_domain: int, tmp_path: Path) -> None:
    with active_system(tmp_path) as (path, up):
        manifest = str(path)
        assert up.stdout is not None
        reached(up.stdout, "violated")
        for words, exit_code, shown in (
            (("verify", manifest, "--timeout", "1"), ExitCode.VIOLATED, "/foo-bar"),
            (("flows", manifest, "--timeout", "1"), ExitCode.VIOLATED, "/chatter"),
            (("graph", manifest), ExitCode.OK, "/foo-bar"),
            (("status", manifest), ExitCode.VIOLATED, "/talker"),
            (
                ("capture", "--domain", str(fresh_domain), "--wait", "1"),
                ExitCode.OK,
                "node /foo-bar is left out",
            ),
        ):
            done = lifecycle(*words)
            said = assert_plain(done.stdout) + assert_plain(done.stderr)
            assert done.returncode == exit_code, (words, said)
            assert shown in said
        up.send_signal(signal.SIGINT)
        output, _ = up.communicate(timeout=LIMIT_S)
    text = assert_plain(output.encode())
    assert "verdict: violated" in text
    assert "/a\\x1b[31mb" in text
