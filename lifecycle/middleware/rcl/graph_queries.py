r"""What rclpy's graph queries return, of any name that a DDS participant may choose.

Owns: the graph queries of rcl and rmw, called as C has them. rclpy's own raise as soon as one name
is outside ROS's alphabet: a topic that cannot be expanded (ValueError), a name that is no
UTF-8 (UnicodeDecodeError, for all names together), a node name that rcl cannot validate (RCLError),
an empty one (RCLError of rcl_get_node_names, for all nodes together). Any participant of the domain
can announce such names, so none may hide what else is there.

Bytes that are no UTF-8 are written as `\xff`; everything else is left as it is announced. With an
rcl that is not known (`abi.is_known`) rclpy's own queries are all there is: what they raise at is
left out then.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
from collections.abc import Callable, Iterator
from typing import Any

from rclpy.exceptions import NameValidationException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, ReliabilityPolicy

from lifecycle import dataclasses
from lifecycle.errors import MiddlewareError
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import Durability, History, Liveliness, QosProfile, Reliability
from lifecycle.middleware.rcl import abi
from lifecycle.middleware.rcl.qos import from_rclpy

_UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"
"""How rmw_dds_common names the node of an endpoint that it does not know (yet)."""

_INFINITE_NS = 2**63 - 1
"""RMW_DURATION_INFINITE; what is longer was announced as no duration can be."""

_GID_BYTES = 16
_HASH_BYTES = 32

_HISTORIES = {int(each): History[each.name] for each in HistoryPolicy}
_RELIABILITIES = {int(each): Reliability[each.name] for each in ReliabilityPolicy}
_DURABILITIES = {int(each): Durability[each.name] for each in DurabilityPolicy}
_LIVELINESSES = {int(each): Liveliness[each.name] for each in LivelinessPolicy}


class _Strings(ctypes.Structure):
    """rcutils_string_array_t."""

    _fields_ = (
        ("size", ctypes.c_size_t),
        ("data", ctypes.POINTER(ctypes.c_char_p)),
        ("allocator", abi.Allocator),
    )

    def all(self) -> tuple[bytes, ...]:
        return tuple([each or b"" for each in self.data[: self.size]])


class _NamesAndTypes(ctypes.Structure):
    """rmw_names_and_types_t."""

    _fields_ = (("names", _Strings), ("types", ctypes.POINTER(_Strings)))


class _Announced(ctypes.Structure):
    """The part of rmw_topic_endpoint_info_t that is no pointer: it comes last."""

    _fields_ = (
        ("hash_version", ctypes.c_uint8),
        ("hash_value", ctypes.c_uint8 * _HASH_BYTES),
        ("endpoint_type", ctypes.c_int),
        ("gid", ctypes.c_uint8 * _GID_BYTES),
        ("qos", abi.Qos),
    )


class _Info(ctypes.Structure):
    """rmw_topic_endpoint_info_t."""

    _fields_ = (
        ("node_name", ctypes.c_char_p),
        ("node_namespace", ctypes.c_char_p),
        ("topic_type", ctypes.c_char_p),
        ("announced", _Announced),
    )


_Named = tuple[tuple[bytes, tuple[bytes, ...]], ...]
"""Names, and the types of each."""


class _Infos(ctypes.Structure):
    """rmw_topic_endpoint_info_array_t."""

    _fields_ = (("size", ctypes.c_size_t), ("items", ctypes.POINTER(_Info)))


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class EndpointInfo:
    """A DDS endpoint as discovery shows it.

    Attributes:
        node: fully qualified name of its node; empty while that is not known.
        type: `std_msgs/msg/String`; that of DDS where it was asked for by a DDS name.
        gid: hex, 32 digits.
        qos: history and depth are UNKNOWN and 0 over Fast DDS.
        type_hash: `RIHS01_df66…`; empty if it announces none.
    """

    node: str
    type: str
    gid: str
    qos: QosProfile
    type_hash: str


def node_names(node: Node) -> list[str]:
    """Return the fully qualified names of all nodes that `node` sees, as often as there are.

    A node whose name is not known yet has a placeholder's, see `verify.tool_filter.known_node`.

    Raises:
        MiddlewareError: the graph cannot be read; all functions here.
    """
    if not abi.is_known():
        with _read("nodes"):
            return [full_name(*each) for each in node.get_node_names_and_namespaces()]
    library = _library()
    names, spaces = _Strings(), _Strings()
    with node.handle:
        handle = library.rmw_handle(node.handle.pointer)
        try:
            library.check(
                library.node_names(handle, ctypes.byref(names), ctypes.byref(spaces)), "nodes"
            )
            return [
                full_name(_text(name), _text(space))
                for name, space in zip(names.all(), spaces.all(), strict=True)
            ]
        finally:
            library.strings_fini(ctypes.byref(names))
            library.strings_fini(ctypes.byref(spaces))


def topic_endpoints(node: Node) -> Iterator[tuple[EndpointKind, str, EndpointInfo]]:
    """Yield kind, topic and endpoint of all publishers and subscriptions that `node` sees.

    A topic of a node that avoids the naming conventions of ROS has the type that DDS has, and its
    name there behind `dds:`: `dds:/chatter` is not `/chatter`. Services are left out.
    """
    names = _topics(node)
    mangled = any(name.startswith(_OF_TOPICS) for name in names)  # not by RMWs without DDS
    for name in names:
        if name.startswith(_OF_SERVICES) or name == _DISCOVERY_INFO:
            continue
        ros = name.startswith(_OF_TOPICS) or not mangled
        topic = name.removeprefix(b"rt") if mangled and ros else name
        shown = _text(topic) if ros else f"{RAW}{_text(name)}"
        for kind in (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION):
            for info in _endpoints(node, kind, topic, no_mangle=not ros):
                yield kind, shown, info


RAW = "dds:"
"""What names of topics begin with here that are no names of ROS."""
_OF_TOPICS = b"rt/"
_OF_SERVICES = b"rq/", b"rr/"
_DISCOVERY_INFO = b"ros_discovery_info"
"""How DDS names what RMWs add to topics, `rt/chatter` (rmw_dds_common)."""


def _topics(node: Node) -> list[bytes]:
    if not abi.is_known():
        with _read("topics"):
            return [name.encode() for name, _ in node.get_topic_names_and_types(no_demangle=True)]
    library = _library()

    def query(handle: int, result: object) -> int:
        return int(library.topics(handle, library.allocator, True, result))

    return [topic for topic, _ in _names_and_types(node, query, "topics") or ()]


def endpoints_of(
    node: Node, kind: EndpointKind, topic: str, *, no_mangle: bool = False
) -> list[EndpointInfo]:
    """Return the publishers or the subscriptions of a topic that `node` sees.

    Args:
        node: that queries.
        kind: PUBLISHER or SUBSCRIPTION.
        topic: fully qualified.
        no_mangle: it is a name of DDS, `rq/resetRequest`, and types are to be DDS's own too.
    """
    return _endpoints(node, kind, topic.encode(), no_mangle=no_mangle)


def endpoints_of_node(
    node: Node, kind: EndpointKind, full_name: str
) -> tuple[tuple[str, str], ...] | None:
    """Return name and type of a node's publishers, subscriptions, servers or clients.

    Returns:
        None where rcl shows no such node: it has left, or has a name that no rcl would give it.
    """
    namespace, _, name = full_name.rpartition("/")
    if not abi.is_known():
        return _shown_of_node(node, kind, name, namespace or "/")
    library = _library()
    arguments = (name.encode(errors="replace"), (namespace or "/").encode(errors="replace"))
    function = library.by_node[kind]

    def query(handle: int, result: object) -> int:
        if kind.is_topic:
            return int(function(handle, library.allocator, False, *arguments, result))
        return int(function(handle, library.allocator, *arguments, result))

    found = _names_and_types(node, query, "")
    return None if found is None else _as_text(found)


@functools.lru_cache(maxsize=1 << 10)
def _as_text(found: _Named) -> tuple[tuple[str, str], ...]:
    """Return name and type as text; graphs are read again and again, and hardly change."""
    return tuple((_text(each), _text(type_)) for each, types in found for type_ in types)


def full_name(name: str, namespace: str) -> str:
    """Return the fully qualified name of a node."""
    return f"{namespace.rstrip('/')}/{name}"


def fingerprint(node: Node) -> object:
    """Return what differs whenever the graph that `node` sees has changed; None if unreadable.

    For an rcl that is not known.
    """
    try:
        return (
            sorted(node_names(node)),
            sorted((kind.value, topic, info.gid) for kind, topic, info in topic_endpoints(node)),
            sorted(name for name, _ in node.get_service_names_and_types()),
        )
    except (MiddlewareError, *_REFUSED):
        return None


def _endpoints(
    node: Node, kind: EndpointKind, topic: bytes, *, no_mangle: bool
) -> list[EndpointInfo]:
    if not abi.is_known():
        return _shown(node, kind, _text(topic), no_mangle=no_mangle)
    library = _library()
    infos = _Infos()
    with node.handle:
        try:
            library.check(
                library.infos[kind](
                    node.handle.pointer,
                    *(library.allocator, topic, no_mangle, ctypes.byref(infos)),
                ),
                "endpoints",
            )
            if not infos.size:
                return []
            raw = ctypes.string_at(infos.items, infos.size * _INFO_BYTES)
            return [
                _endpoint(
                    info.node_name or b"",
                    info.node_namespace or b"",
                    info.topic_type or b"",
                    raw[index * _INFO_BYTES + _ANNOUNCED_AT : (index + 1) * _INFO_BYTES],
                )
                for index, info in enumerate(infos.items[: infos.size])
            ]
        finally:
            library.infos_fini(ctypes.byref(infos), library.allocator)


_INFO_BYTES = ctypes.sizeof(_Info)
_ANNOUNCED_AT = _Info.announced.offset
_MOST_KEPT = 1 << 14
"""Endpoints whose infos are kept, 0.8 kB each; the graph of 200 nodes has about 4,000."""


@functools.lru_cache(maxsize=_MOST_KEPT)
def _endpoint(name: bytes, namespace: bytes, type_: bytes, announced: bytes) -> EndpointInfo:
    """Read an info; graphs are read again and again, and hardly change."""
    info = _Announced.from_buffer_copy(announced)
    base, version = _text(name), info.hash_version
    return EndpointInfo(
        node="" if base == _UNKNOWN_NODE else full_name(base, _text(namespace)),
        type=_text(type_),
        gid=bytes(info.gid).hex(),
        qos=QosProfile(
            history=_HISTORIES.get(info.qos.history, History.UNKNOWN),
            depth=info.qos.depth,
            reliability=_RELIABILITIES.get(info.qos.reliability, Reliability.UNKNOWN),
            durability=_DURABILITIES.get(info.qos.durability, Durability.UNKNOWN),
            deadline_ns=_nanoseconds(info.qos.deadline),
            lifespan_ns=_nanoseconds(info.qos.lifespan),
            liveliness=_LIVELINESSES.get(info.qos.liveliness, Liveliness.UNKNOWN),
            liveliness_lease_duration_ns=_nanoseconds(info.qos.liveliness_lease_duration),
        ),
        type_hash=f"RIHS{version:02}_{bytes(info.hash_value).hex()}" if version else "",
    )


_REFUSED = (ValueError, rclpy_implementation.RCLError, NameValidationException)
"""What rclpy's graph queries raise at names that are not ROS's; UnicodeDecodeError is one."""


@contextlib.contextmanager
def _read(what: str) -> Iterator[None]:
    try:
        yield
    except _REFUSED as error:
        raise MiddlewareError(f"cannot read the {what} of the graph: {error}") from error


def _shown(node: Node, kind: EndpointKind, topic: str, *, no_mangle: bool) -> list[EndpointInfo]:
    """As `endpoints_of`, by rclpy's own query; nothing for a topic that it refuses."""
    is_publisher = kind is EndpointKind.PUBLISHER
    ask = (
        node.get_publishers_info_by_topic if is_publisher else node.get_subscriptions_info_by_topic
    )
    try:
        infos = ask(topic, no_mangle)
    except _REFUSED:
        return []
    return [
        EndpointInfo(
            node=""
            if info.node_name == _UNKNOWN_NODE
            else full_name(info.node_name, info.node_namespace),
            type=info.topic_type,
            gid=bytes(info.endpoint_gid[:_GID_BYTES]).hex(),
            qos=from_rclpy(info.qos_profile),
            type_hash=_spelled(getattr(info, "topic_type_hash", None)),
        )
        for info in infos
    ]


def _spelled(type_hash: Any) -> str:
    return str(type_hash) if type_hash is not None and type_hash.version > 0 else ""


def _shown_of_node(
    node: Node, kind: EndpointKind, name: str, namespace: str
) -> tuple[tuple[str, str], ...] | None:
    """As `endpoints_of_node`, by rclpy's own queries."""
    ask = {
        EndpointKind.PUBLISHER: node.get_publisher_names_and_types_by_node,
        EndpointKind.SUBSCRIPTION: node.get_subscriber_names_and_types_by_node,
        EndpointKind.SERVICE_SERVER: node.get_service_names_and_types_by_node,
        EndpointKind.SERVICE_CLIENT: node.get_client_names_and_types_by_node,
    }[kind]
    try:
        return tuple((each, type_) for each, types in ask(name, namespace) for type_ in types)
    except (*_REFUSED, rclpy_implementation.NodeNameNonExistentError):
        return None


def _nanoseconds(duration: Any) -> int | None:
    value = duration.sec * 10**9 + duration.nsec
    return value if 0 < value < _INFINITE_NS else None


def _names_and_types(node: Node, query: Callable[[int, object], int], what: str) -> _Named | None:
    """Return what `query` fills in; None if it fails and `what` does not say what of."""
    library = _library()
    found = _NamesAndTypes()
    with node.handle:
        try:
            status = query(node.handle.pointer, ctypes.byref(found))
            if status and not what:
                library.take_error()
                return None
            library.check(status, what)
            size = found.names.size
            types = found.types[:size] if size else []
            return tuple(
                [(n, each.all()) for n, each in zip(found.names.all(), types, strict=True)]
            )
        finally:
            library.names_and_types_fini(ctypes.byref(found))


def _text(name: bytes) -> str:
    return name.decode(errors="backslashreplace")


class _Library:
    """The functions, bound; get it from `_library`."""

    def __init__(self) -> None:
        rcl = abi.load()
        self.take_error = rcl.take_error
        self.allocator = ctypes.byref(rcl.default_allocator)
        pointer, text, flag = ctypes.c_void_p, ctypes.c_char_p, ctypes.c_bool
        self.rmw_handle = abi.bind("rcl", "rcl_node_get_rmw_handle", pointer, (pointer,))
        # rcl's own refuses all names if one of them is empty.
        self.node_names = abi.bind("rcl", "rmw_get_node_names", ctypes.c_int, (pointer,) * 3)
        self.strings_fini = abi.bind(
            "rcutils", "rcutils_string_array_fini", ctypes.c_int, (pointer,)
        )
        self.topics = abi.bind(
            *("rcl", "rcl_get_topic_names_and_types", ctypes.c_int),
            (pointer, pointer, flag, pointer),
        )
        self.names_and_types_fini = abi.bind(
            "rcl", "rcl_names_and_types_fini", ctypes.c_int, (pointer,)
        )
        self.infos_fini = abi.bind(
            "rmw", "rmw_topic_endpoint_info_array_fini", ctypes.c_int, (pointer, pointer)
        )
        self.infos = {
            kind: abi.bind(
                *("rcl", f"rcl_get_{word}_info_by_topic", ctypes.c_int),
                (pointer, pointer, text, flag, pointer),
            )
            for kind, word in (
                (EndpointKind.PUBLISHER, "publishers"),
                (EndpointKind.SUBSCRIPTION, "subscriptions"),
            )
        }
        self.by_node = {
            kind: abi.bind(
                *("rcl", f"rcl_get_{word}_names_and_types_by_node", ctypes.c_int),
                (pointer, pointer, *((flag,) if kind.is_topic else ()), text, text, pointer),
            )
            for kind, word in (
                (EndpointKind.PUBLISHER, "publisher"),
                (EndpointKind.SUBSCRIPTION, "subscriber"),
                (EndpointKind.SERVICE_SERVER, "service"),
                (EndpointKind.SERVICE_CLIENT, "client"),
            )
        }

    def check(self, status: int, what: str) -> None:
        if status:
            raise MiddlewareError(f"cannot read the {what} of the graph: {self.take_error()}")


@functools.lru_cache(maxsize=1)
def _library() -> _Library:
    return _Library()
