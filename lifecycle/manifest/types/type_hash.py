"""The type hash (REP-2016) of an interface as it is installed here, from its type description.

Owns: reading `share/<package>/<kind>/<Type>.json`, which rosidl installs beside every definition,
and how the hashes of a service's and an action's messages are put together. Imports no message
package. Reads the file system.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from lifecycle.manifest.types.ament_index import find_resource

_SERVICE = ("_Request", "_Response")
_PARTS = {
    "msg": ("",),
    "srv": _SERVICE,
    "action": (
        *(f"_SendGoal{each}" for each in _SERVICE),
        *(f"_GetResult{each}" for each in _SERVICE),
        "_FeedbackMessage",
    ),
}
"""The messages on the wire, by the kind of an interface."""


def join(hashes: Sequence[str]) -> str:
    """Put the hashes of one interface's messages together; empty if one of them is not known.

    Args:
        hashes: of a message; of a service's request and response; of an action's goal request and
            response, result request and response, and feedback message.
    """
    return " ".join(hashes) if all(hashes) else ""


def installed_hash(type_: str, prefixes: Sequence[Path]) -> str:
    """Return the hash of a type as it is installed here, `RIHS01_df66…`, for `join` where several.

    Empty if the type is not installed here, or by a distribution that has no hashes (before Iron).

    Args:
        type_: `package/msg/Type`, `package/srv/Type` or `package/action/Type`.
        prefixes: where to search, from `ament_index.search_prefixes`.
    """
    package, _, rest = type_.partition("/")
    index = find_resource("rosidl_interfaces", package, prefixes) if rest else None
    parts = _PARTS.get(rest.partition("/")[0])
    if index is None or parts is None:
        return ""
    # <prefix>/share/ament_index/resource_index/rosidl_interfaces/<package>
    known = _hashes(index.parents[3] / package / f"{rest}.json")
    return join([known.get(f"{type_}{part}", "") for part in parts])


@functools.lru_cache(maxsize=512)
def _hashes(path: Path) -> Mapping[str, str]:
    """Return the hashes that a type description lists, by type name; none if it cannot be read."""
    try:
        listed = json.loads(path.read_text(encoding="utf-8"))["type_hashes"]
        return {str(each["type_name"]): str(each["hash_string"]) for each in listed}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}
