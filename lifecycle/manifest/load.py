"""The door of this room: `load`.

Owns: what a caller hands in and gets back. The work is `loading`'s, which is imported at the first
call: a process that hosts a node needs a manifest's types, but never YAML nor JSON Schema, and
those are half of what it would import.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.model import Manifest

_NONE: Mapping[str, str] = MappingProxyType({})


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Loaded:
    """A manifest without errors.

    Attributes:
        warnings: what may be wrong with it, by position.
    """

    manifest: Manifest
    warnings: tuple[Diagnostic, ...]


def load(
    path: str | os.PathLike[str],
    arguments: Mapping[str, str] = _NONE,
    *,
    environment: Mapping[str, str] | None = None,
) -> Loaded:
    """Read and check a manifest, with everything it includes.

    Args:
        path: the file.
        arguments: values by argument name.
        environment: what `$(env NAME)` and the search for packages see; this process's environment
            if None.

    Raises:
        ManifestError: with every error and warning, sorted by position.
    """
    from lifecycle.manifest.loading import load_manifest

    variables = os.environ if environment is None else environment
    manifest, warnings = load_manifest(Path(path), arguments, variables)
    return Loaded(manifest=manifest, warnings=warnings)
