"""Construct the nodes of a host process: rclpy contexts, participants, node classes.

Owns: which nodes of a process share a participant, and what a class must be to be hosted.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from lifecycle.errors import LifecycleError
from lifecycle.middleware import ParticipantSettings, participant_settings
from lifecycle.node.author.node import LifecycleNode
from lifecycle.node.author.spec import Construction, Mode, constructing, load_class, ros_arguments
from lifecycle.node.host.control import HostSpec
from lifecycle.plan import PlannedNode, parameter_text


def process_context(spec: HostSpec) -> Context:
    """Initialise rclpy for a process and return its default context."""
    arguments: list[str] = []
    if len(spec.nodes) == 1 and not spec.nodes[0].managed:
        # A plain node names itself; only process-wide arguments can give it name and parameters.
        node = spec.nodes[0]
        words = ros_arguments(node) or ["--ros-args"]
        arguments = [*words, "-r", f"__node:={node.name}", "-r", f"__ns:={node.namespace}"]
        for name, value in node.parameters:
            arguments += ["-p", f"{name}:={parameter_text(value)}"]
    rclpy.init(
        args=arguments,
        domain_id=spec.domain_id,
        signal_handler_options=SignalHandlerOptions.NO,
    )
    return rclpy.get_default_context()


class Participants:
    """Contexts, and with them participants, for nodes that may share one and nodes that must not.

    Nodes of equal transports, datagram size and connection URLs share. The first ones get the
    process's default context, which is what code that names none uses.
    """

    def __init__(self, default: Context) -> None:
        self._default = default
        self._made: dict[ParticipantSettings, Context] = {}

    @contextlib.contextmanager
    def carrying(self, planned: PlannedNode) -> Iterator[Context]:
        """Yield the context that `planned` is to be constructed on, inside the block.

        Raises:
            LifecycleError: its participant cannot be made as planned.
        """
        settings = ParticipantSettings.of(
            planned.connections,
            transports=planned.transports,
            max_datagram_bytes=planned.max_datagram_bytes,
        )
        context = self._made.get(settings)
        if context is not None:
            yield context
            return
        context = self._default
        if self._made:
            context = Context()
            context.init(args=[], domain_id=self._default.get_domain_id())
        # The participant is made with the context's first node.
        with participant_settings(context, settings):
            yield context
        self._made[settings] = context


def class_of(planned: PlannedNode, *, alone: bool) -> type[Node]:
    """Import the class of one planned node.

    Args:
        planned: names it.
        alone: it is the only node of its process.

    Raises:
        LifecycleError: the class cannot be used as planned. What its module raises passes.
    """
    node_class = load_class(planned.run.python)
    managed = issubclass(node_class, LifecycleNode)
    if planned.managed and not managed:
        raise LifecycleError(
            f"cannot manage {planned.full_name}: {planned.run.python!r} is not a LifecycleNode",
            hint="subclass lifecycle.LifecycleNode, or say `managed: false`",
        )
    if not managed and not alone:
        raise LifecycleError(
            f"cannot host {planned.full_name} beside other nodes: a plain node takes its name "
            "and remaps from its process",
            hint="give it a process of its own",
        )
    return node_class


def construct(planned: PlannedNode, node_class: type[Node], context: Context, system: str) -> Node:
    """Construct one planned node of a supervised system; what its constructor raises passes."""
    # Of a plain node the supervisor drives no states.
    supervisor = system if planned.managed else ""
    construction = Construction(
        spec=planned, mode=Mode.MANUAL, context=context, supervisor=supervisor
    )
    with constructing(construction):
        return node_class()
