"""Whether an interface type exists, told by the ament index alone.

Owns: the three answers to "is there a `sensor_msgs/msg/Image`?". Imports no message package, so
that a manifest is checked without ROS installed or sourced.
"""

from __future__ import annotations

import dataclasses
import difflib
import enum
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from lifecycle.manifest.schema.message_text import nearest
from lifecycle.manifest.types.ament_index import find_resource, list_resources

_RESOURCE = "rosidl_interfaces"


class TypeStatus(enum.Enum):
    """What the index says of a type."""

    EXISTS = "exists"
    NO_SUCH_TYPE = "no such type"  # the package is installed, the type is not in it
    NOT_INSTALLED = "package not installed"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TypeLookup:
    """The answer for one type.

    Attributes:
        nearest: an installed type (NO_SUCH_TYPE) or package (NOT_INSTALLED) with a similar name;
            empty if there is none.
    """

    status: TypeStatus
    nearest: str = ""


def look_up(type_: str, prefixes: Sequence[Path]) -> TypeLookup:
    """Look a type up.

    Args:
        type_: `package/msg/Type`, `package/srv/Type` or `package/action/Type`.
        prefixes: where to search, from `ament_index.search_prefixes`.
    """
    package, _, name = type_.partition("/")
    found = find_resource(_RESOURCE, package, prefixes)
    if found is None:
        # Packages share endings (`_msgs`, `_interfaces`), so only a near miss is a hint.
        known = list_resources(_RESOURCE, prefixes)
        similar = next(iter(difflib.get_close_matches(package, known, n=1, cutoff=0.85)), "")
        return TypeLookup(status=TypeStatus.NOT_INSTALLED, nearest=similar)
    types = _types(found)
    if name in types:
        return TypeLookup(status=TypeStatus.EXISTS)
    # A type of the same kind comes first: `msg/Imu` for `msg/IMU`, not `srv/SetCameraInfo`.
    kind = name.partition("/")[0]
    same_kind = [each for each in types if each.startswith(f"{kind}/")]
    similar = nearest(name, same_kind) or nearest(name, types)
    return TypeLookup(
        status=TypeStatus.NO_SUCH_TYPE, nearest=f"{package}/{similar}" if similar else ""
    )


def _types(resource: Path) -> tuple[str, ...]:
    """Return what a package declares: `msg/Image`, each once, in the index's order."""
    lines = resource.read_text(encoding="utf-8").split()
    return tuple(dict.fromkeys(str(PurePosixPath(line).with_suffix("")) for line in lines))
