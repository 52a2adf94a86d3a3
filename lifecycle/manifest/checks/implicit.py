"""Endpoints that every ROS 2 node, or every managed one, has without declaring them.

Owns: their names, so that what talks to them is not called unconnected. Sources: rcl's rosout and
type description service, rclpy's parameter services, rcl_lifecycle's services and event. Pure.
"""

from __future__ import annotations

from lifecycle.manifest.checks.system import System, full_name
from lifecycle.manifest.model import EndpointKind

_EVERY_NODE = (
    (EndpointKind.SERVICE_SERVER, "describe_parameters"),
    (EndpointKind.SERVICE_SERVER, "get_parameter_types"),
    (EndpointKind.SERVICE_SERVER, "get_parameters"),
    (EndpointKind.SERVICE_SERVER, "get_type_description"),
    (EndpointKind.SERVICE_SERVER, "list_parameters"),
    (EndpointKind.SERVICE_SERVER, "set_parameters"),
    (EndpointKind.SERVICE_SERVER, "set_parameters_atomically"),
)
_MANAGED_NODE = (
    (EndpointKind.PUBLISHER, "transition_event"),
    (EndpointKind.SERVICE_SERVER, "change_state"),
    (EndpointKind.SERVICE_SERVER, "get_available_states"),
    (EndpointKind.SERVICE_SERVER, "get_available_transitions"),
    (EndpointKind.SERVICE_SERVER, "get_state"),
    (EndpointKind.SERVICE_SERVER, "get_transition_graph"),
)
_OWN_NODE = tuple(
    (EndpointKind.SERVICE_SERVER, name)
    for name in ("alias", "connect_to", "disconnect", "get_configuration", "map_to", "remap")
)

_OF_THE_GRAPH = (
    (EndpointKind.PUBLISHER, "/parameter_events"),
    (EndpointKind.PUBLISHER, "/rosout"),
    # What tools and simulators take part in, outside of any one system.
    (EndpointKind.PUBLISHER, "/clock"),
    # The graph interface's transport.
    (EndpointKind.PUBLISHER, "/lifecycle/graph"),
    (EndpointKind.SUBSCRIPTION, "/lifecycle/graph"),
    (EndpointKind.SUBSCRIPTION, "/diagnostics"),
    (EndpointKind.SUBSCRIPTION, "/parameter_events"),
    (EndpointKind.SUBSCRIPTION, "/rosout"),
)


def implicit_names(system: System) -> frozenset[tuple[EndpointKind, str]]:
    """Return kind and fully qualified name of every endpoint that exists undeclared."""
    names = set(_OF_THE_GRAPH)
    for node in system.manifest.nodes:
        own = (*_EVERY_NODE, *(_MANAGED_NODE if node.managed else ()), *_OWN_NODE)
        names.update((kind, f"{full_name(node)}/{name}") for kind, name in own)
    return frozenset(names)
