"""Load and check a declarative manifest: YAML document → frozen, checked `Manifest`. Needs no ROS.

`load` reads a manifest with its includes and raises `ManifestError` with every finding at once.
Other packages use the types of `model`, `qos` and `diagnostics`; nothing outside knows YAML.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lifecycle.manifest.loading import load as load

_PUBLIC: dict[str, tuple[str, ...]] = {
    "lifecycle.manifest.loading": ("load",),
}
"""What programs import from here (docs/api.md), by the module that has it."""


def __getattr__(name: str) -> object:
    """Load the module of a public name on first use (PEP 562)."""
    for module, names in _PUBLIC.items():
        if name in names:
            return getattr(importlib.import_module(module), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
