"""Which files in /dev/shm are swept: a directory of our own, and processes that use its files."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import mmap
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from lifecycle.middleware.process import shared_memory
from lifecycle.middleware.process.shared_memory import leftovers, sweep

SEGMENT = "fastrtps_0123456789abcdef"
PORT = "fastrtps_port7411"
GROUP = (PORT, f"{PORT}_el", f"sem.{PORT}_mutex")
OF_FAST_DDS_3 = ("fastdds_0123456789abcdef", "fastdds_0123456789abcdef_el", "fastdds_port7411")


@pytest.fixture
def directory(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A stand-in for /dev/shm on the same kind of file system, where /proc shows it likewise."""
    path = Path(f"/dev/shm/lifecycle-test-{os.getpid()}")
    path.mkdir()
    monkeypatch.setattr(shared_memory, "_DIRECTORY", path)
    monkeypatch.setattr(shared_memory, "_NEW_S", 0.0)  # or what a test makes would be left
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
    fast_dds = (*GROUP, SEGMENT, *OF_FAST_DDS_3)
    make(directory, *others, *fast_dds)
    assert set(leftovers()) == set(fast_dds)
    assert set(sweep()) == set(fast_dds)
    assert names(directory) == tuple(sorted(others))


def test_a_mapped_file_of_a_port_keeps_its_whole_group(directory: Path) -> None:
    make(directory, *GROUP, SEGMENT)
    with mapped(directory / PORT):
        assert sweep() == (SEGMENT,)
    assert sweep() == tuple(sorted(GROUP))


@pytest.mark.parametrize("kind", ["el", "sl"])
@pytest.mark.parametrize("how", [fcntl.LOCK_EX, fcntl.LOCK_SH])
def test_a_held_lock_keeps_its_group(directory: Path, kind: str, how: int) -> None:
    lock = f"{SEGMENT}_{kind}"
    make(directory, SEGMENT, lock)
    with (directory / lock).open("rb") as file:
        fcntl.flock(file, how)
        assert sweep() == ()
    assert sweep() == (SEGMENT, lock)


@pytest.mark.skipif(os.getuid() != 0, reason="to mount a file system needs root")
def test_what_a_container_maps_in_a_directory_of_its_own_keeps_nothing(directory: Path) -> None:
    make(directory, *GROUP)
    mount = 'mount -t tmpfs none "$1" && echo data > "$1/$2" && exec "$0" -c "$3" "$1/$2"'
    code = (
        "import mmap, sys; file = open(sys.argv[1], 'r+b')\n"
        "kept = mmap.mmap(file.fileno(), 0); print(); sys.stdin.read()"
    )
    command = ("unshare", "--mount", "sh", "-c", mount, sys.executable, directory, PORT, code)
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as container:
        assert container.stdout is not None
        container.stdout.readline()
        try:
            assert sweep() == tuple(sorted(GROUP))
        finally:
            container.communicate()


def test_a_dead_owners_segment_goes_although_a_reader_still_maps_it(directory: Path) -> None:
    make(directory, SEGMENT, f"{SEGMENT}_el")
    with mapped(directory / SEGMENT) as address:
        assert sweep() == (SEGMENT, f"{SEGMENT}_el")
        assert ctypes.string_at(address, 4) == b"data"


def test_a_mapped_segment_without_a_lock_file_stays(directory: Path) -> None:
    make(directory, SEGMENT)
    with mapped(directory / SEGMENT):
        assert sweep() == ()
    assert sweep() == (SEGMENT,)


def test_files_of_another_user_stay(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make(directory, *GROUP)
    uid = os.getuid()
    monkeypatch.setattr(shared_memory.os, "getuid", lambda: uid + 1)
    assert sweep() == ()


def test_a_link_in_the_place_of_a_file_is_not_followed(directory: Path, tmp_path: Path) -> None:
    (tmp_path / "precious").write_bytes(b"data")
    (directory / SEGMENT).symlink_to(tmp_path / "precious")
    assert sweep() == ()


def test_a_mutex_that_a_killed_process_left_taken_goes(directory: Path) -> None:
    make(directory, *GROUP, taken=True)
    assert sweep() == tuple(sorted(GROUP))


def test_what_others_let_go_of_a_moment_later_is_removed_then(directory: Path) -> None:
    make(directory, *GROUP)
    with contextlib.ExitStack() as peer:
        peer.enter_context(mapped(directory / PORT))
        letting_go = threading.Timer(1.0, peer.close)
        letting_go.start()
        assert sweep() == ()
        assert sweep(within_s=5.0) == tuple(sorted(GROUP))
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


def test_a_port_can_be_locked_while_a_sweep_looks_who_uses_it(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A participant that is refused the lock of a port does without shared memory there."""
    make(directory, *GROUP)
    had: list[str] = []

    def look(process: str) -> frozenset[str]:
        with (directory / f"{PORT}_el").open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            had.append(process)
        return frozenset()

    monkeypatch.setattr(shared_memory, "_mapped", look)
    assert sweep() == tuple(sorted(GROUP))
    assert had


def test_what_a_process_owns_is_not_waited_for(directory: Path) -> None:
    make(directory, *GROUP)
    began_s = time.monotonic()
    with (directory / f"{PORT}_el").open("rb") as lock, (directory / PORT).open("rb"):
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert sweep(within_s=60.0) == ()
    assert time.monotonic() - began_s < 30


def test_a_machine_without_shared_memory_has_nothing_to_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_memory, "_DIRECTORY", tmp_path / "missing")
    assert (sweep(), leftovers()) == ((), ())
