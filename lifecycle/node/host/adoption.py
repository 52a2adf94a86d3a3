"""Make the nodes of the user's classes and functions, each as one planned node.

Owns: wrappers of public methods of rclpy.node.Node, by which a process that hosts nodes gives them
their planned names and knows each endpoint that those of rclpy's own classes make.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import os
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from rclpy.context import Context
from rclpy.node import Node

from lifecycle.errors import BringUpError, LifecycleError
from lifecycle.manifest.model import EndpointKind
from lifecycle.middleware.fastdds.discovery import reach
from lifecycle.middleware.fastdds.factory import initialised
from lifecycle.middleware.fastdds.participant import made_participant
from lifecycle.middleware.fastdds.prober import Prober
from lifecycle.middleware.fastdds.profiles import ParticipantSettings
from lifecycle.middleware.rcl.graph_queries import OVER_DDS
from lifecycle.middleware.rcl.rclpy_nodes import is_rclpy_managed, noted_action
from lifecycle.node.host.foreign import ForeignNode
from lifecycle.node.managed import Managed
from lifecycle.node.node import LifecycleNode
from lifecycle.node.planned import Construction, load_nodes, planned_options
from lifecycle.plan.model import PlannedNode

if TYPE_CHECKING:
    from lifecycle.node.host.loop import NodeLoop

Hosted = Managed | ForeignNode
"""What a host knows of one of its nodes."""

_FACTORIES = {
    "create_publisher": (EndpointKind.PUBLISHER, ("msg_type", "topic", "qos_profile")),
    "create_subscription": (
        EndpointKind.SUBSCRIPTION,
        ("msg_type", "topic", "callback", "qos_profile"),
    ),
    "create_service": (EndpointKind.SERVICE_SERVER, ()),
    "create_client": (EndpointKind.SERVICE_CLIENT, ()),
}
"""What each makes, and its positional parameters where it can be made with a flow of its own."""
_REMOVERS = ("destroy_publisher", "destroy_subscription", "destroy_service", "destroy_client")


class Participants:
    """Contexts, and with them participants, for nodes that may share one and nodes that must not.

    Nodes of equal transports, datagram size and connection URLs share. The first ones get the
    process's default context, which is what code that names none uses.
    """

    def __init__(self, default: Context) -> None:
        self._default = default
        self._made: dict[ParticipantSettings, Context] = {}
        self._probers: list[Prober] = []

    @contextlib.contextmanager
    def carrying(self, settings: ParticipantSettings) -> Iterator[Context]:
        """Yield the context that a node is to be constructed on, inside the block."""
        context = self._made.get(settings)
        if context is not None:
            yield context
            return
        context = self._default
        if self._made:
            context = initialised(settings, self._default.get_domain_id(), context=Context())
        with made_participant(context, settings):
            yield context
        self._made[settings] = context

    def ask_others(self) -> None:
        """Have those that run announce themselves to these participants now.

        They answer a new participant once, before it listens, and announce themselves again within
        a second. Call it once the sender sockets of all are known, see `nfe.senders_of`.
        """
        for settings in self._made if OVER_DDS else ():
            reached = reach(self._default.get_domain_id(), settings.urls, os.environ)
            self._probers.append(Prober(reached))
            self._probers[-1].ask(counted=False)


class Adoption:
    """Makes nodes of the user's classes and functions, each as one planned node.

    Args:
        context: of the process: its first nodes are constructed on it.
        loop: runs the callbacks of nodes that are not ours.
        supervisor: name of the system whose gate holds the nodes; empty for none.
        use_global_arguments: nodes take remaps from the process's own --ros-args.

    Attributes:
        participants: of the process.
        made: what stands for each node, by its key in the plan.
    """

    def __init__(
        self,
        context: Context,
        loop: NodeLoop,
        *,
        supervisor: str = "",
        use_global_arguments: bool = False,
    ) -> None:
        self.participants = Participants(context)
        self._loop = loop
        self._supervisor = supervisor
        self._use_global_arguments = use_global_arguments
        self._waiting: list[PlannedNode] = []
        self._current: PlannedNode | None = None
        self._unplanned: Construction | None = None
        self._constructed: dict[str, Node] = {}
        self._foreign: dict[int, ForeignNode] = {}
        self.made: dict[str, Hosted] = {}
        self._before: dict[str, Callable[..., Any]] = {}
        self._wrap("__init__", self._initialise)
        self._wrap("destroy_node", self._destroy)
        self._wrap("add_waitable", self._add_waitable)
        self._wrap("remove_waitable", self._remove_waitable)
        for name, (kind, names) in _FACTORIES.items():
            self._wrap(name, functools.partial(self._create, kind, names))
        for name in _REMOVERS:
            self._wrap(name, self._remove)

    def unfollow(self) -> None:
        """Take no node that is made from now on for one of the plan."""
        for name, method in self._before.items():
            setattr(Node, name, method)

    def _wrap(self, name: str, around: Callable[..., Any]) -> None:
        """Have a method of all nodes, whatever class they are of, called by `around`."""
        method = self._before[name] = getattr(Node, name)

        @functools.wraps(method)
        def wrapped(node: Node, *arguments: Any, **options: Any) -> Any:
            return around(method, node, *arguments, **options)

        setattr(Node, name, wrapped)

    def _initialise(
        self, initialise: Callable[..., None], node: Node, node_name: str, **options: Any
    ) -> None:
        """Have rclpy construct a node as planned; one that is not planned is not touched."""
        planned = self._take(node_name, options.get("namespace"))
        ours = isinstance(node, LifecycleNode)
        if planned is None:
            if ours and self._unplanned is not None:
                node._construction, self._unplanned = self._unplanned, None  # noqa: SLF001
                options["use_global_arguments"] = self._use_global_arguments
            initialise(node, node_name, **options)
            return
        refuse_unmanaged(planned, type(node))
        options = planned_options(node, planned, options)
        options["namespace"] = planned.namespace
        options["use_global_arguments"] = self._use_global_arguments
        if ours:
            # Of a plain node no states are driven.
            supervisor = self._supervisor if planned.managed else ""
            node._construction = Construction(  # noqa: SLF001 - it is for us
                spec=planned, supervisor=supervisor
            )
        with self.participants.carrying(ParticipantSettings.of(planned)) as context:
            initialise(node, planned.name, **{**options, "context": context})
        if not (ours and planned.managed):
            self._foreign[id(node)] = ForeignNode(
                node, planned, supervisor=self._supervisor, loop=self._loop
            )
        self._constructed[planned.key] = node

    def _destroy(self, destroy: Callable[[Node], None], node: Node) -> None:
        if (foreign := self._foreign.get(id(node))) is not None:
            foreign.close()
        destroy(node)
        for hosted in self.made.values():
            if hosted.node is node and not hosted.is_destroyed:
                hosted.is_destroyed = True
                for listener in hosted.listeners:
                    listener(hosted)

    def _add_waitable(self, add: Callable[..., None], node: Node, waitable: Any) -> None:
        self._loop.take_waitable(node, waitable)  # before its executor can look
        add(node, waitable)
        kind, foreign = noted_action(node, waitable), self._foreign.get(id(node))
        if kind is not None and foreign is not None:
            foreign.made(kind, waitable)

    def _remove_waitable(self, remove: Callable[..., None], node: Node, waitable: Any) -> None:
        remove(node, waitable)
        self._loop.watching.give_back(waitable)

    def _create(
        self,
        kind: EndpointKind,
        names: Sequence[str],
        make: Callable[..., Any],
        node: Node,
        *arguments: Any,
        **options: Any,
    ) -> Any:
        foreign = self._foreign.get(id(node))
        if foreign is None:
            return make(node, *arguments, **options)
        given = {**dict(zip(names, arguments, strict=False)), **options}
        entity = foreign.make(kind, given) if names else None
        if entity is None:
            entity = make(node, *arguments, **options)
            foreign.made(kind, entity)
        return entity

    def _remove(self, destroy: Callable[..., Any], node: Node, entity: Any) -> Any:
        if (foreign := self._foreign.get(id(node))) is not None:
            foreign.removed(entity)
        result = destroy(node, entity)
        for each in getattr(entity, "event_handlers", ()):
            self._loop.watching.give_back(each)
        return result

    def make(
        self, planned: PlannedNode, group: Sequence[PlannedNode], what: Callable[..., Any]
    ) -> tuple[Hosted, ...]:
        """Construct a planned node, and those of its group that the same class or function makes.

        Raises:
            LifecycleError: something else was made. What the class or function raises passes.
        """
        with self.expecting(planned, group):
            returned = what(**keywords(planned, what))
        self._check(planned, what, returned)
        made: list[Hosted] = []
        for key, node in self._constructed.items():
            foreign = self._foreign.get(id(node))
            if foreign is not None:
                foreign.constructed()
            made.append(foreign or node.lifecycle)
            self.made[key] = made[-1]
        self._constructed.clear()
        return tuple(made)

    @contextlib.contextmanager
    def expecting(self, planned: PlannedNode, group: Sequence[PlannedNode]) -> Iterator[None]:
        """Take nodes that are constructed in the block for those of the plan."""
        self._waiting = [each for each in group if each.key not in self.made]
        self._current = planned
        try:
            yield
        finally:
            self._waiting, self._current = [], None

    def make_unplanned(self, what: Callable[..., Any]) -> Managed:
        """Construct a LifecycleNode that has no plan, on the default context."""
        with self.participants.carrying(ParticipantSettings()):
            self._unplanned = Construction(spec=None)
            made: Managed = what().lifecycle
            return made

    def _check(self, planned: PlannedNode, what: Callable[..., Any], returned: Any) -> None:
        reference = planned.run.python
        several = isinstance(returned, (list, tuple, set, frozenset))
        nodes = [each for each in (returned if several else (returned,)) if isinstance(each, Node)]
        if planned.key not in self._constructed or not (isinstance(what, type) or nodes):
            names = ", ".join(each.get_fully_qualified_name() for each in nodes) or repr(returned)
            raise BringUpError(
                f"cannot use {reference!r}: it returned {names}, not {planned.full_name}",
                hint="return the node, or a list of nodes; the host spins and destroys them",
            )
        known = {id(each.node) for each in self.made.values()}
        known.update(map(id, self._constructed.values()))
        for each in (node for node in nodes if id(node) not in known):
            raise BringUpError(
                f"cannot host {each.get_fully_qualified_name()}, which {reference!r} returns: no "
                f"node is declared for it beside {planned.full_name}",
                hint="add a node of that name with the same `run:` and `process: "
                f"{planned.process}`",
            )

    def _take(self, name: str, namespace: str | None) -> PlannedNode | None:
        """Choose whose construction this is: by name among the group, else the one asked for."""
        full = f"/{(namespace or '').strip('/')}/{name}".replace("//", "/")
        chosen = (
            next((each for each in self._waiting if each.full_name == full), None)
            or next((each for each in self._waiting if each.name == name), None)
            or next((each for each in self._waiting if each is self._current), None)
        )
        if chosen is not None:
            self._waiting.remove(chosen)
        return chosen


def maker_of(planned: PlannedNode, folders: tuple[str, ...]) -> Callable[..., Any]:
    """Import the class or function of one planned node; raises LifecycleError."""
    found = load_nodes(planned.run.python, folders)
    if isinstance(found, type):
        refuse_unmanaged(planned, found)
    return found


def refuse_unmanaged(planned: PlannedNode, node_class: type) -> None:
    """Raise LifecycleError for a class that is to be managed, and knows nothing of that."""
    known = issubclass(node_class, LifecycleNode) or is_rclpy_managed(node_class)
    if planned.managed and not known:
        raise LifecycleError(
            f"cannot manage {planned.full_name}: {planned.run.python!r} makes a plain node, a "
            f"{node_class.__name__}",
            hint="say `managed: false`, or subclass lifecycle.LifecycleNode",
        )


def keywords(planned: PlannedNode, what: Callable[..., Any]) -> dict[str, Any]:
    """Return what a class or function is called with; one that needs a `node_name` gets it."""
    keywords = {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in planned.run.arguments.items()
    }
    wanted = inspect.signature(what).parameters.get("node_name")
    named = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    if wanted is not None and wanted.default is wanted.empty and wanted.kind in named:
        keywords.setdefault("node_name", planned.name)
    return keywords
