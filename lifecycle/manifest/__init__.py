"""Load and check a declarative manifest: YAML document → frozen, checked `Manifest`. Needs no ROS.

`load` reads a manifest with its includes and raises `ManifestError` with every finding at once.
Other packages use the types of `model`, `qos` and `diagnostics`; nothing outside knows YAML.
YAML and JSON Schema are imported when `load` is asked for.
"""

from lifecycle.doors import open_door

__getattr__, __dir__, __all__ = open_door(__name__, __file__)
