"""Which files in /dev/shm are swept: a directory of our own, and processes that use its files."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import mmap
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from lifecycle.middleware import leftovers, segments_of, shm, sweep
from lifecycle.middleware.shm_lock import port_mutexes
from lifecycle.supervisor.orphans import sweep_of

SEGMENT = "fastrtps_0123456789abcdef"
PORT = "fastrtps_port7411"
GROUP = (PORT, f"{PORT}_el", f"sem.{PORT}_mutex")


@pytest.fixture
def directory(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A stand-in for /dev/shm on the same kind of file system, where /proc shows it likewise."""
    path = Path(f"/dev/shm/lifecycle-test-{os.getpid()}")
    path.mkdir()
    monkeypatch.setattr(shm, "_DIRECTORY", path)
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


def test_only_fast_dds_files_are_swept(directory: Path) -> None:
    others = ("fastrtps_", "fastrtps_port", "fastrtps_xyz", "fastrtps_portal_el", "lttng", "sem.x")
    make(directory, *others, *GROUP, SEGMENT)
    assert set(sweep()) == {*GROUP, SEGMENT}
    assert names(directory) == tuple(sorted(others))


def test_leftovers_removes_nothing(directory: Path) -> None:
    make(directory, *GROUP)
    assert leftovers() == tuple(sorted(GROUP))
    assert names(directory) == tuple(sorted(GROUP))


def test_a_mapped_file_of_a_port_keeps_its_whole_group(directory: Path) -> None:
    make(directory, *GROUP, SEGMENT)
    with mapped(directory / PORT):
        assert sweep() == (SEGMENT,)
    assert sweep() == tuple(sorted(GROUP))


def test_an_open_lock_file_keeps_its_whole_group(directory: Path) -> None:
    make(directory, *GROUP, SEGMENT, f"{SEGMENT}_el")
    with (directory / f"{SEGMENT}_el").open("rb"):
        assert sweep() == tuple(sorted(GROUP))
    assert sweep() == (SEGMENT, f"{SEGMENT}_el")


def test_a_held_lock_keeps_its_group_though_the_holder_cannot_be_looked_into(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(directory, *GROUP)
    monkeypatch.setattr(shm, "_all_pids", list)  # as if every process were another user's
    with (directory / f"{PORT}_el").open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert sweep() == ()
    assert sweep() == tuple(sorted(GROUP))


def test_a_dead_owners_segment_goes_although_a_reader_still_maps_it(directory: Path) -> None:
    make(directory, SEGMENT, f"{SEGMENT}_el")
    with mapped(directory / SEGMENT) as address:
        assert sweep() == (SEGMENT, f"{SEGMENT}_el")
        assert ctypes.string_at(address, 4) == b"data"


def test_a_mapped_segment_without_a_lock_file_stays(directory: Path) -> None:
    make(directory, SEGMENT)
    with mapped(directory / SEGMENT):
        assert sweep() == ()


def test_only_names_the_groups_that_may_go(directory: Path) -> None:
    make(directory, *GROUP, SEGMENT)
    assert sweep(only=["fastrtps_port7413", "nonsense"]) == ()
    assert sweep(only=[f"{PORT}_el"]) == tuple(sorted(GROUP))
    assert names(directory) == (SEGMENT,)


def test_groups_with_a_file_from_before_the_time_stay(directory: Path) -> None:
    make(directory, *GROUP, SEGMENT)
    os.utime(directory / f"{PORT}_el", (1000, 1000))
    assert sweep(created_after_s=2000) == (SEGMENT,)
    assert sweep(created_after_s=1000) == tuple(sorted(GROUP))


def test_files_of_another_user_stay(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make(directory, *GROUP)
    uid = os.getuid()
    monkeypatch.setattr(shm.os, "getuid", lambda: uid + 1)
    assert sweep() == ()


def test_a_port_that_is_being_opened_meanwhile_stays(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its opener holds the mutex, and has not come to the port's files yet."""
    make(directory, *GROUP, SEGMENT, taken=True)
    semaphore = directory / f"sem.{PORT}_mutex"
    look = shm._unused

    def gone_on(*args: object, **options: object) -> list[object]:
        found = look(*args, **options)
        if options:  # the second look: the opener lets go right after it
            semaphore.write_bytes(bytes([1]) + bytes(31))
        return found

    monkeypatch.setattr(shm, "_unused", gone_on)
    assert sweep() == (SEGMENT,)
    assert semaphore.read_bytes()[0] == 1  # given back


def test_a_port_that_was_opened_between_the_two_looks_stays(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(directory, *GROUP)
    with contextlib.ExitStack() as stack:
        looks = shm._inodes_in_use

        def opened(ours: set[tuple[int, int]]) -> tuple[set[object], set[object]]:
            found = looks(ours)
            stack.enter_context(mapped(directory / PORT))
            return found

        monkeypatch.setattr(shm, "_inodes_in_use", opened)
        assert sweep() == ()
    assert names(directory) == tuple(sorted(GROUP))


def test_a_mutex_that_a_killed_process_left_taken_goes(directory: Path) -> None:
    make(directory, *GROUP, taken=True)
    assert sweep() == tuple(sorted(GROUP))


def test_a_port_whose_mutex_appeared_meanwhile_stays(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(directory, PORT)
    looks = shm._inodes_in_use

    def opened(ours: set[tuple[int, int]]) -> tuple[set[object], set[object]]:
        found = looks(ours)
        make(directory, f"sem.{PORT}_mutex", taken=True)
        return found

    monkeypatch.setattr(shm, "_inodes_in_use", opened)
    assert sweep() == ()


def test_nobody_opens_a_port_while_it_is_being_removed(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(directory, *GROUP)
    semaphore = directory / f"sem.{PORT}_mutex"
    seen: list[bool] = []
    look = shm._unused

    def opener(*args: object, **options: object) -> list[object]:
        if options:
            with port_mutexes([semaphore]) as mutexes:
                seen.append(mutexes[semaphore].held)
        return look(*args, **options)

    monkeypatch.setattr(shm, "_unused", opener)
    assert sweep() == tuple(sorted(GROUP))
    assert seen == [False]


def test_a_runs_sweep_takes_the_ports_of_its_domain_however_old_and_what_it_used(
    directory: Path,
) -> None:
    foreign, unique = "fastrtps_port7650", "fastrtps_port7000"  # of domain 1, and of every domain
    make(directory, *GROUP, SEGMENT, foreign, unique)
    for path in directory.iterdir():
        os.utime(path, (1000.0, 1000.0))
    assert sweep_of(2000.0, (), None) == ()
    with (directory / f"{PORT}_el").open("rb"):
        assert sweep_of(2000.0, (), 0) == ()
    assert sweep_of(2000.0, (), 0) == tuple(sorted(GROUP))
    assert sweep_of(2000.0, (SEGMENT,), 0) == (SEGMENT,)
    assert names(directory) == tuple(sorted((foreign, unique)))
    assert sweep_of(500.0, (), 0) == tuple(sorted((foreign, unique)))


def test_a_process_owns_the_groups_whose_lock_file_it_has_open(directory: Path) -> None:
    make(directory, *GROUP, SEGMENT, f"{SEGMENT}_el")
    with (directory / f"{PORT}_el").open("rb"), (directory / SEGMENT).open("rb"):
        assert segments_of([os.getpid()]) == frozenset(GROUP)
    assert segments_of([os.getpid()]) == frozenset()


def test_a_process_that_has_ended_owns_nothing() -> None:
    assert segments_of([2**22 + 1]) == frozenset()


def test_a_machine_without_shared_memory_has_nothing_to_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shm, "_DIRECTORY", tmp_path / "missing")
    assert (sweep(), leftovers(), segments_of([os.getpid()])) == ((), (), frozenset())
