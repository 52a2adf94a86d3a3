"""Loads shared libraries before they are needed: while Python imports, and before a process forks.

Owns: loading those of rclpy on a thread of its own, a hundred, which takes half of the time of
`import rclpy` and no Python; and what of rcl and Fast DDS each host would look up for itself. Must
not import rclpy where it is imported.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import threading
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.util import find_spec

from lifecycle.middleware.process.control import libc

_threads: list[threading.Thread] = []


def begin_loading() -> None:
    """Begin to load them; `import rclpy` links to what is loaded, or waits until it is.

    An import of another extension module meanwhile waits, too, with the GIL: dlopen(3) has one
    lock. What cannot be loaded is left to `import rclpy`, which says why.
    """
    package = find_spec("rclpy")
    folders = None if package is None else package.submodule_search_locations
    if _threads or not folders:
        return
    file = os.path.join(folders[0], f"_rclpy_pybind11{EXTENSION_SUFFIXES[0]}")  # noqa: PTH118
    thread = threading.Thread(target=_load, args=(os.fsencode(file),), daemon=True)
    with contextlib.suppress(RuntimeError):  # there may be no more threads
        thread.start()
        _threads.append(thread)


def await_loading() -> None:
    """Wait until they are loaded, or cannot be: before a fork, which would have half of it."""
    for thread in _threads:
        thread.join()


def _load(file: bytes) -> None:
    # ctypes.CDLL holds the GIL while it loads; a function that it calls does not.
    libc().dlopen(ctypes.c_char_p(file), os.RTLD_NOW | os.RTLD_LOCAL)


def load_libraries() -> None:
    """Load what every node asks rcl and Fast DDS through, for a process that forks hosts."""
    from lifecycle.middleware.fastdds import log, settings
    from lifecycle.middleware.rcl import graph_queries, matched_peers

    del log  # which a host imports where it makes its participant
    for module in (matched_peers, graph_queries, settings):
        module.load_library()
