"""Load and check a declarative manifest: YAML document → frozen, checked `Manifest`. Needs no ROS.

`load` reads a manifest with its includes and raises `ManifestError` with every finding at once.
Other packages use the types of `model`, `qos` and `diagnostics`; nothing outside knows YAML.
YAML and JSON Schema are imported when `load` is asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lifecycle.manifest.diagnostics import Diagnostic, ManifestError, Position, Severity
from lifecycle.manifest.model import (
    After,
    Authority,
    Condition,
    ConnectionDeclaration,
    DataLayer,
    DataLayerSource,
    Discovery,
    DiscoveryMode,
    DiscoveryRange,
    Endpoint,
    EndpointKind,
    EndpointPolicy,
    FlowNeed,
    FlowTransport,
    Interface,
    Link,
    Machine,
    Manifest,
    Node,
    ParameterDeclaration,
    ParameterValue,
    Policy,
    Run,
    RunKind,
    Timeouts,
    UniqueHow,
)
from lifecycle.manifest.qos import (
    PRESETS,
    Durability,
    History,
    Liveliness,
    QosProfile,
    Reliability,
)

if TYPE_CHECKING:
    from lifecycle.manifest.loading import Loaded, load

__all__ = [
    "PRESETS",
    "After",
    "Authority",
    "Condition",
    "ConnectionDeclaration",
    "DataLayer",
    "DataLayerSource",
    "Diagnostic",
    "Discovery",
    "DiscoveryMode",
    "DiscoveryRange",
    "Durability",
    "Endpoint",
    "EndpointKind",
    "EndpointPolicy",
    "FlowNeed",
    "FlowTransport",
    "History",
    "Interface",
    "Link",
    "Liveliness",
    "Loaded",
    "Machine",
    "Manifest",
    "ManifestError",
    "Node",
    "ParameterDeclaration",
    "ParameterValue",
    "Policy",
    "Position",
    "QosProfile",
    "Reliability",
    "Run",
    "RunKind",
    "Severity",
    "Timeouts",
    "UniqueHow",
    "load",
]


def __getattr__(name: str) -> object:
    """Import the reader when it is asked for (PEP 562)."""
    if name not in {"Loaded", "load"}:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from lifecycle.manifest import loading

    return getattr(loading, name)
