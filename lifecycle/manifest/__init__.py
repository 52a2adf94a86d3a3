"""Load and check a declarative manifest: YAML document → frozen, checked `Manifest`. Needs no ROS.

`load` reads a manifest with its includes and raises `ManifestError` with every finding at once.
Other packages use the types of `model`, `qos` and `diagnostics`; nothing outside knows YAML.
"""

from __future__ import annotations

from lifecycle.public import names

__getattr__ = names(__name__, loading="load")
