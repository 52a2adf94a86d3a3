"""The closed sets of words that a manifest may use.

Owns: the enums; a value is what the document says. Nothing here knows YAML. Pure.
"""

from __future__ import annotations

import enum


class EndpointKind(enum.Enum):
    """The six kinds of endpoint; values are NoDL v2's list names."""

    PUBLISHER = "publishers"
    SUBSCRIPTION = "subscriptions"
    SERVICE_SERVER = "service_servers"
    SERVICE_CLIENT = "service_clients"
    ACTION_SERVER = "action_servers"
    ACTION_CLIENT = "action_clients"

    @property
    def noun(self) -> str:
        """What messages call one endpoint of this kind, "service server"."""
        return self.value.removesuffix("s").replace("_", " ")

    @property
    def is_topic(self) -> bool:
        """Whether it is an end of a topic: a publisher or a subscription."""
        return self in (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION)

    def spell(self, name: str) -> str:
        """Return how requests and messages call an endpoint of a node, `publishers/video`."""
        return f"{self.value}/{name}"


class RunKind(enum.Enum):
    """How a node comes to run."""

    PYTHON = "python"  # our host imports module:Class
    COMMAND = "command"  # any executable, given --ros-args
    ATTACH = "attach"  # somebody else starts it


class Condition(enum.Enum):
    """What a node's own step waits for in another node; ordered.

    The condition names the step that waits: `after: {b: configured}` lets this node start at once,
    but begins its configure only when b is configured; `connected` and `active` hold its connect
    and its activate alike; `started` holds its start. A node that is not managed has only a start,
    so for it every condition holds the start, and `active` is refused: the gate needs it running.
    """

    STARTED = "started"
    CONFIGURED = "configured"
    CONNECTED = "connected"
    ACTIVE = "active"


class DiscoveryMode(enum.Enum):
    """How participants find each other."""

    DYNAMIC = "dynamic"  # by multicast: whoever comes is found
    STATIC = "static"  # nobody but the planned participants, at planned addresses and ports
    STATIC_ENDPOINTS = "static_endpoints"  # likewise, and endpoints are known without being told
    SERVER = "server"  # by a discovery server that the supervisor starts and watches


class DiscoveryRange(enum.Enum):
    """ROS_AUTOMATIC_DISCOVERY_RANGE."""

    SUBNET = "subnet"
    LOCALHOST = "localhost"
    OFF = "off"
    SYSTEM_DEFAULT = "system_default"


class Authority(enum.Enum):
    """Who calls connect_to and map_to (*Topological Discovery and Communication Negotiation*)."""

    NODES = "nodes"  # each node follows the instructions that it was started with
    SUPERVISOR = "supervisor"  # nodes have nothing open for data until they are told


class DataLayerSource(enum.Enum):
    """What the data layer graph is made from."""

    STATIC = "static"  # the manifest alone
    DYNAMIC = "dynamic"  # the node configurations, read while the system runs


class EndpointPolicy(enum.Enum):
    """Whether a node may have endpoints that the manifest does not declare."""

    DECLARED = "declared"
    OPEN = "open"


class UniqueHow(enum.Enum):
    """What a link demands of its flow."""

    NOT = "not"
    WEAKLY = "weakly"
    STRONGLY = "strongly"


class FlowIdentification(enum.Enum):
    """How publishers that need a unique flow get one (*Unique Network Flows*)."""

    PARTICIPANT = "participant"  # sockets of their own: unique transport ports
    DSCP = "dscp"  # a DSCP of their own as the sixth element of the tuple; at most 64
