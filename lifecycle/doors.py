"""The door of a room: names that its `__init__.pyi` lists, loaded on first use.

Owns: `open_door`, by which a package's `__init__` has the names of the stub beside it. Each line of
such a stub is `from .module import name as name`. Imports nothing of the package.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import lazy_loader


def open_door(
    package: str, file: str
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package, as `lazy_loader.attach_stub`.

    That has Python parse the stub, which takes ten times as long as to read its lines.

    Args:
        package: `__name__`.
        file: `__file__`; the stub has its name, and an `i` behind it.
    """
    modules: dict[str, list[str]] = {}
    for line in Path(f"{file.removesuffix('c')}i").read_text(encoding="utf-8").splitlines():
        _, module, _, name, _, _ = line.split()
        modules.setdefault(module[1:], []).append(name)
    attached: tuple[Callable[[str], object], Callable[[], list[str]], list[str]] = (
        lazy_loader.attach(package, None, modules)
    )
    return attached
