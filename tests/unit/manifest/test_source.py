"""Reading files: whatever a path names, one clear error in bounded time and memory."""

from __future__ import annotations

import os
import socket
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest

from lifecycle.manifest.diagnostics import ManifestError
from lifecycle.manifest.loading import load
from lifecycle.manifest.yaml.source import MAX_BYTES, parse, read_document

GOOD = "manifest_version: 1\nsystem: test\nnodes: {talker: {attach: true}}\n"


def _message(path: str | Path) -> str:
    with pytest.raises(ManifestError) as caught:
        load(path)
    (only,) = caught.value.diagnostics
    assert only.at.file == str(path)
    assert (only.at.line, only.at.column) == (1, 1)
    return str(only).removeprefix(f"{path}:1:1: ")


@pytest.mark.timeout(5)
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda _: None, "cannot open '{path}': No such file or directory"),
        (Path.mkdir, "cannot read a directory as a manifest; name a regular file"),
        (os.mkfifo, "cannot read a special file as a manifest; name a regular file"),
        (
            lambda path: path.symlink_to("/dev/zero"),
            "cannot read a special file as a manifest; name a regular file",
        ),
        (
            lambda path: path.symlink_to(path),
            "cannot open '{path}': Too many levels of symbolic links",
        ),
    ],
    ids=["nothing", "a directory", "a FIFO", "a device", "a circle of links"],
)
def test_what_is_no_regular_file_is_refused_at_once(
    make: Callable[[Path], object], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "s.lifecycle.yaml"
    make(path)
    assert _message(path) == message.format(path=path)


def test_a_socket_cannot_be_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # the path of a socket is short
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("s.lifecycle.yaml")
        expected = "cannot open 's.lifecycle.yaml': No such device or address"
        assert _message("s.lifecycle.yaml") == expected


def test_a_path_with_a_nul_byte_is_refused() -> None:
    assert _message("a\0b.lifecycle.yaml").startswith("cannot open 'a\\x00b.lifecycle.yaml': ")


@pytest.mark.timeout(10)
def test_a_file_of_100_megabytes_is_refused_without_reading_it_whole(tmp_path: Path) -> None:
    path = tmp_path / "huge.lifecycle.yaml"
    with path.open("wb") as stream:
        stream.truncate(100 * 1024 * 1024)
    tracemalloc.start()
    message = _message(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert message == (
        "cannot read a file of 104857600 bytes; at most 1048576 are allowed; "
        "split it with 'include:'"
    )
    assert peak < 4 * MAX_BYTES


def test_a_file_of_exactly_the_limit_is_read(tmp_path: Path) -> None:
    path = tmp_path / "full.lifecycle.yaml"
    path.write_text(GOOD + "#" * (MAX_BYTES - len(GOOD)), encoding="utf-8")
    assert load(path).manifest.system == "test"


def test_a_byte_order_mark_and_windows_line_ends_are_read(tmp_path: Path) -> None:
    path = tmp_path / "bom.lifecycle.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    document = read_document(path)
    assert document.at(("nodes", "talker")).line == 3
    assert document.at(("manifest_version",)).column == 19


def test_a_name_that_is_no_utf8_does_not_reach_messages(tmp_path: Path) -> None:
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.lifecycle.yaml"))
    path.write_text("system: [", encoding="utf-8")
    with pytest.raises(ManifestError) as caught:
        load(path)
    assert str(caught.value).encode("utf-8").startswith(os.fsencode(tmp_path) + b"/caf")


# Each of these is one million characters; libyaml's and our own cost must stay linear.
_N = 1_000_000
BOMBS = {
    "brackets": "[" * _N,
    "braces": "{" * _N,
    "dashes": "- " * (_N // 2),
    "question marks": "? " * (_N // 2),
    "colons": ": " * (_N // 2),
    "an open quote": '"' + "\\" * (_N - 1),
    "a long key": "x" * _N + ": 1",
    "percent signs": "%" * _N,
    "doubled keys": "a: 1\n" * (_N // 5),
    "keys": "".join(f"k{i}: \n" for i in range(_N // 10)),
    "tags": "x: [" + "!a b," * (_N // 5) + "]",
    "aliases": "x: &a [1]\ny: [" + "*a," * (_N // 3) + "]",
    "broken substitutions": "x: [" + "$(arg y)," * (_N // 40) + "]",
    "a long number": "x: " + "9" * _N,
    "a long exponent": "x: 1e" + "9" * _N,
    "dollars": "x: '" + "$(" * (_N // 2) + "'",
}


@pytest.mark.timeout(20)
@pytest.mark.parametrize("text", BOMBS.values(), ids=BOMBS.keys())
def test_a_bomb_ends_with_few_findings(text: str, tmp_path: Path) -> None:
    path = tmp_path / "bomb.lifecycle.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ManifestError) as caught:
        load(path)
    assert 1 <= len(caught.value.diagnostics) <= 500
    assert all(each.message.startswith("cannot ") for each in caught.value.diagnostics)


@pytest.mark.timeout(10)
def test_ten_levels_of_ten_aliases_cost_nothing() -> None:
    levels = "".join(f"l{i}: &l{i} [{','.join([f'*l{i - 1}'] * 10)}]\n" for i in range(1, 11))
    tracemalloc.start()
    with pytest.raises(ManifestError, match="cannot read more than 100000 values"):
        parse("l0: &l0 [x]\n" + levels, file="bomb")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * MAX_BYTES


def test_aliases_count_with_the_depth_of_what_they_stand_for() -> None:
    deep = "a: &a " + "[" * 40 + "]" * 40 + "\nb: " + "[" * 30 + "*a" + "]" * 30 + "\n"
    with pytest.raises(ManifestError, match="nested deeper than 64 levels"):
        parse(deep, file="deep")


def test_an_alias_stands_where_it_is_used() -> None:
    document = parse("a: &a {b: 1}\nc: *a\n", file="f")
    at = document.at(("c",))
    assert (at.line, at.column, at.path) == (2, 4, "c")
    inner = document.at(("c", "b"))
    assert (inner.line, inner.column, inner.path) == (1, 11, "c.b")


@pytest.mark.timeout(60)
def test_thousands_of_endpoints_that_all_miss_their_counterparts_are_loaded(
    tmp_path: Path,
) -> None:
    path = tmp_path / "large.lifecycle.yaml"
    lists = "".join(
        f"      {kind}:\n"
        + "".join(f"      - {{name: {kind}{i}, type: std_msgs/msg/String}}\n" for i in range(3000))
        for kind in ("publishers", "subscriptions")
    )
    path.write_text(
        "manifest_version: 1\nsystem: large\npolicy: {unpublished: warning}\nnodes:\n"
        f"  node:\n    run: {{python: 'a:B'}}\n    interface:\n{lists}",
        encoding="utf-8",
    )
    warnings = [each.rule for each in load(path).warnings]
    assert {rule: warnings.count(rule) for rule in set(warnings)} == {
        "check.unheard": 3000,
        "check.unpublished": 3000,
    }


@pytest.mark.parametrize("path", ["/proc/kmsg", "/proc/version", "/sys/kernel/uevent_seqnum"])
def test_a_file_that_the_kernel_makes_up_is_refused_unread(path: str) -> None:
    if not os.access(path, os.R_OK):
        pytest.skip(f"{path} cannot be opened here")
    with pytest.raises(ManifestError) as caught:
        read_document(path)
    assert str(caught.value) == (
        f"{path}:1:1: cannot read a file that the kernel makes up (/proc, /sys) as a manifest; "
        "name a regular file"
    )


def test_a_scalar_with_the_tag_of_no_type_is_a_string() -> None:
    value = parse("a: ! 12", file="f").find(("a",))
    assert value is not None
    assert value.data == "12"
