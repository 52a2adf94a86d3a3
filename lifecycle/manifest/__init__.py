"""Load and check a declarative manifest: YAML document → frozen, checked `Manifest`. Needs no ROS.

`load` reads a manifest with its includes and raises `ManifestError` with every finding at once.
Other packages use the types of `model`, `qos` and `diagnostics`; nothing outside knows YAML.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lifecycle.manifest.loading import load as load


def __getattr__(name: str) -> object:
    """Load `load` on first use (PEP 562): who needs a type of this room alone reads no YAML."""
    if name != "load":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from lifecycle.manifest.loading import load

    return load
