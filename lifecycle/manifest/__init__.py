"""Load and check a declarative manifest: YAML document → frozen, checked `Manifest`. Needs no ROS.

`load` reads a manifest with its includes and raises `ManifestError` with every finding at once.
Other packages use the types of `model`, `qos` and `diagnostics`; nothing outside knows YAML.
YAML and JSON Schema are imported when `load` is asked for.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
