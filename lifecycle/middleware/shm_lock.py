"""The mutex under which Fast DDS opens a shared memory port.

Owns: taking it from Python. Whoever opens a port (`fastrtps_port<number>`) first takes the named
semaphore beside it, `sem.fastrtps_port<number>_mutex` (sem_overview(7)); whoever removes a port
must hold it too, or a process that just opens a stale one is left listening to a file without a
name. Must not import rclpy.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import mmap
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

_SIZE = 32
"""Of a sem_t."""
_FAILED = ctypes.c_void_p(-1).value


class PortMutex:
    """One port's semaphore, mapped by its path rather than by sem_open, which knows one place."""

    def __init__(self, path: Path) -> None:
        """Map it.

        Raises:
            OSError: it is gone, or belongs to somebody else.
        """
        libc = _libc()
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        try:
            protection = mmap.PROT_READ | mmap.PROT_WRITE
            self._address = libc.mmap(None, _SIZE, protection, mmap.MAP_SHARED, descriptor, 0)
        finally:
            os.close(descriptor)
        if self._address == _FAILED:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), str(path))
        self.path = path
        self.held = False

    def acquire(self) -> bool:
        """Take it if it is free; never waits."""
        self.held = self.held or _libc().sem_trywait(self._address) == 0
        return self.held

    def close(self) -> None:
        """Give it back and unmap it."""
        if self.held:
            _libc().sem_post(self._address)
        _libc().munmap(self._address, _SIZE)


@contextlib.contextmanager
def port_mutexes(paths: Iterable[Path]) -> Iterator[dict[Path, PortMutex]]:
    """Take those mutexes that are free, for the length of the block.

    Yields:
        By path, held or not; those that are gone meanwhile are left out.
    """
    mutexes: dict[Path, PortMutex] = {}
    try:
        for path in paths:
            with contextlib.suppress(OSError):
                mutexes[path] = PortMutex(path)
                mutexes[path].acquire()
        yield mutexes
    finally:
        for mutex in mutexes.values():
            mutex.close()


@functools.lru_cache(maxsize=1)
def _libc() -> ctypes.CDLL:
    libc = ctypes.CDLL(None, use_errno=True)
    size, integer = ctypes.c_size_t, ctypes.c_int
    libc.mmap.restype = ctypes.c_void_p
    libc.mmap.argtypes = (ctypes.c_void_p, size, integer, integer, integer, ctypes.c_long)
    libc.munmap.argtypes = (ctypes.c_void_p, size)
    libc.sem_trywait.argtypes = (ctypes.c_void_p,)
    libc.sem_post.argtypes = (ctypes.c_void_p,)
    return libc
