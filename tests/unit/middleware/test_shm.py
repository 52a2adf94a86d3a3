"""Which files in /dev/shm are swept: a directory of our own, and processes that use its files."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import mmap
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from lifecycle.middleware.process import shared_memory
from lifecycle.middleware.process.shared_memory import disown_ports, leftovers, sweep
from tests.builders import port_node

SEGMENT = "fastrtps_0123456789abcdef"
PORT = "fastrtps_port7411"
GROUP = (PORT, f"{PORT}_el", f"sem.{PORT}_mutex")
ALL = (*GROUP, SEGMENT)


@pytest.fixture
def directory(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A stand-in for /dev/shm on the same kind of file system, where /proc shows it likewise."""
    path = Path(f"/dev/shm/lifecycle-test-{os.getpid()}")
    path.mkdir()
    monkeypatch.setattr(shared_memory, "_DIRECTORY", path)
    yield path
    for each in path.iterdir():
        each.unlink()
    path.rmdir()


def make(directory: Path, *names: str, taken: bool = False) -> None:
    for name in names:
        free_semaphore = bytes([0 if taken else 1]) + bytes(31)
        (directory / name).write_bytes(free_semaphore if name.startswith("sem.") else b"data")


@contextlib.contextmanager
def mapped(path: Path) -> Iterator[int]:
    """Map a file and close it, as Fast DDS does; Python's own mmap keeps it open."""
    libc = ctypes.CDLL(None, use_errno=True)
    libc.mmap.restype = ctypes.c_void_p
    libc.mmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long)
    libc.munmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t)
    with path.open("rb") as file:
        address = libc.mmap(None, 4096, mmap.PROT_READ, mmap.MAP_SHARED, file.fileno(), 0)
    try:
        yield address
    finally:
        libc.munmap(address, 4096)


def names(directory: Path) -> tuple[str, ...]:
    return tuple(sorted(each.name for each in directory.iterdir()))


def test_only_fast_dds_files_are_left_over(directory: Path) -> None:
    others = ("fastrtps_", "fastrtps_port", "fastrtps_xyz", "fastrtps_portal_el", "lttng", "sem.x")
    newer = tuple(each.replace("fastrtps", "fastdds") for each in (*GROUP, SEGMENT))
    make(directory, *others, *GROUP, SEGMENT, *newer)
    assert set(leftovers()) == {*GROUP, SEGMENT, *newer}
    assert sweep(newer) == tuple(sorted(newer))
    assert sweep(others) == ()
    assert names(directory) == tuple(sorted((*others, *GROUP, SEGMENT)))


def test_leftovers_removes_nothing(directory: Path) -> None:
    make(directory, *GROUP)
    assert leftovers(only=GROUP) == tuple(sorted(GROUP))
    assert names(directory) == tuple(sorted(GROUP))


def test_only_the_groups_that_were_seen_to_be_owned_are_removed(directory: Path) -> None:
    make(directory, *GROUP, SEGMENT)
    assert sweep(()) == ()
    assert sweep(["fastrtps_port7413", "nonsense"]) == ()
    assert sweep([f"{PORT}_el"]) == tuple(sorted(GROUP))
    assert names(directory) == (SEGMENT,)


def test_a_mapped_file_of_a_port_keeps_its_whole_group(directory: Path) -> None:
    make(directory, *GROUP, SEGMENT)
    with mapped(directory / PORT):
        assert sweep(ALL) == (SEGMENT,)
    assert sweep(ALL) == tuple(sorted(GROUP))


def test_a_semaphore_in_use_keeps_its_whole_group(directory: Path) -> None:
    """Its user is about to open the port, and has not come to the port's files yet."""
    make(directory, *GROUP)
    with mapped(directory / f"sem.{PORT}_mutex"):
        assert sweep(ALL) == ()
    assert sweep(ALL) == tuple(sorted(GROUP))


@pytest.mark.parametrize("kind", ["el", "sl"])
@pytest.mark.parametrize("how", [fcntl.LOCK_EX, fcntl.LOCK_SH])
def test_a_held_lock_keeps_its_group(directory: Path, kind: str, how: int) -> None:
    lock = f"{SEGMENT}_{kind}"
    make(directory, SEGMENT, lock)
    with (directory / lock).open("rb") as file:
        fcntl.flock(file, how)
        assert sweep(ALL) == ()
    assert sweep(ALL) == (SEGMENT, lock)


def test_a_dead_owners_segment_goes_although_a_reader_still_maps_it(directory: Path) -> None:
    make(directory, SEGMENT, f"{SEGMENT}_el")
    with mapped(directory / SEGMENT) as address:
        assert sweep(ALL) == (SEGMENT, f"{SEGMENT}_el")
        assert ctypes.string_at(address, 4) == b"data"


def test_a_mapped_segment_without_a_lock_file_stays(directory: Path) -> None:
    make(directory, SEGMENT)
    with mapped(directory / SEGMENT):
        assert sweep(ALL) == ()
    assert sweep(ALL) == (SEGMENT,)


def test_files_of_another_user_stay(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make(directory, *GROUP)
    uid = os.getuid()
    monkeypatch.setattr(shared_memory.os, "getuid", lambda: uid + 1)
    assert sweep(ALL) == ()


def test_a_file_that_appeared_meanwhile_keeps_its_group(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(directory, PORT)
    claim = shared_memory._claim

    def opened(file: shared_memory._File) -> contextlib.AbstractContextManager[None]:
        make(directory, f"sem.{PORT}_mutex", taken=True)
        return claim(file)

    monkeypatch.setattr(shared_memory, "_claim", opened)
    assert sweep(ALL) == ()
    assert names(directory) == tuple(sorted((PORT, f"sem.{PORT}_mutex")))


def test_a_link_in_the_place_of_a_file_is_not_followed(directory: Path, tmp_path: Path) -> None:
    (tmp_path / "precious").write_bytes(b"data")
    (directory / SEGMENT).symlink_to(tmp_path / "precious")
    assert sweep(ALL) == ()


def test_a_mutex_that_a_killed_process_left_taken_goes(directory: Path) -> None:
    make(directory, *GROUP, taken=True)
    assert sweep(ALL) == tuple(sorted(GROUP))


def test_a_port_cannot_be_opened_while_it_is_being_removed(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever opens it meanwhile waits; the signal that announces it does no harm."""
    make(directory, *GROUP)
    seen: list[str] = []
    unlink = Path.unlink

    def opener(path: Path, *, missing_ok: bool) -> None:
        with pytest.raises(BlockingIOError):
            os.open(directory / f"sem.{PORT}_mutex", os.O_RDWR | os.O_NONBLOCK)
        seen.append(path.name)
        if len(seen) == len(GROUP):
            for each in GROUP:
                unlink(directory / each, missing_ok=missing_ok)

    monkeypatch.setattr(Path, "unlink", opener)
    removed = sweep(ALL)
    monkeypatch.undo()
    assert removed == tuple(sorted(seen)) == tuple(sorted(GROUP))


def test_what_others_let_go_of_a_moment_later_is_removed_then(directory: Path) -> None:
    make(directory, *GROUP)
    with contextlib.ExitStack() as peer:
        peer.enter_context((directory / PORT).open("rb"))
        letting_go = threading.Timer(0.1, peer.close)
        letting_go.start()
        assert sweep(ALL) == ()
        assert sweep(ALL, within_s=5.0) == tuple(sorted(GROUP))
        letting_go.join()
    assert names(directory) == ()


def test_all_that_is_unused_goes_but_for_what_was_made_just_now(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its owner may not have locked it yet."""
    make(directory, *GROUP, SEGMENT, "other")
    monkeypatch.setattr(shared_memory, "_NEW_S", 60.0)
    assert sweep() == ()
    monkeypatch.setattr(shared_memory, "_NEW_S", 0.2)
    assert sweep(within_s=5.0) == tuple(sorted((*GROUP, SEGMENT)))
    assert names(directory) == ("other",)


def test_what_a_process_owns_is_not_waited_for(directory: Path) -> None:
    make(directory, *GROUP)
    began_s = time.monotonic()
    with (directory / f"{PORT}_el").open("rb") as lock, (directory / PORT).open("rb"):
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert sweep(ALL, within_s=60.0) == ()
    assert time.monotonic() - began_s < 30


@pytest.mark.parametrize(
    ("memory", "disowned"),
    [
        (port_node(), True),
        (port_node(flags=6), False),  # it is known already
        (port_node(flags=1), False),  # nobody reads there yet
        (port_node(wait_ms=100), False),  # another version's, perhaps
        (port_node(number=7413), False),
        (port_node() + port_node(), False),
        (b"", False),
    ],
)
def test_senders_let_go_of_the_port_of_a_dead_process_where_its_memory_is_as_known(
    directory: Path, memory: bytes, disowned: bool
) -> None:
    make(directory, *GROUP, SEGMENT)
    (directory / PORT).write_bytes(memory)
    assert disown_ports() == ((PORT,) if disowned else ())
    after = (directory / PORT).read_bytes()
    assert after == (port_node(flags=6) if disowned else memory)
    assert disown_ports() == ()


@pytest.mark.parametrize("are_listed", [True, False])
def test_the_port_of_a_living_process_stays_as_it_is(
    directory: Path, monkeypatch: pytest.MonkeyPatch, are_listed: bool
) -> None:
    if not are_listed:  # those of another PID namespace, or where proc(5) has none
        monkeypatch.setattr(shared_memory, "_locked", lambda: iter(()))
    make(directory, *GROUP)
    (directory / PORT).write_bytes(port_node())
    with (directory / f"{PORT}_el").open("rb") as owner:
        fcntl.flock(owner, fcntl.LOCK_EX)
        assert disown_ports() == ()
    assert disown_ports() == (PORT,)


def test_ports_are_let_go_of_where_the_kernel_lists_no_locks(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused() -> Iterator[tuple[int, tuple[int, int]]]:
        raise PermissionError
        yield

    monkeypatch.setattr(shared_memory, "_locked", refused)
    make(directory, *GROUP)
    (directory / PORT).write_bytes(port_node())
    assert disown_ports() == (PORT,)


def test_a_machine_without_shared_memory_has_nothing_to_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_memory, "_DIRECTORY", tmp_path / "missing")
    assert (sweep(ALL), leftovers()) == ((), ())
