"""QoS profiles, interface types and parameters: the manifest's names and values as rclpy's objects.

Policies go by name: both sides use rmw's. Infinite durations are None on our side; rmw spells them
RMW_DURATION_UNSPECIFIED (0, what a default profile holds) or RMW_DURATION_INFINITE (what discovery
shows), which mean the same on Fast DDS.
"""

from __future__ import annotations

import array
import importlib
import re
import warnings
from typing import Any

from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.type_support import check_is_valid_msg_type, check_is_valid_srv_type

from lifecycle.errors import MiddlewareError
from lifecycle.manifest.model import ParameterValue
from lifecycle.manifest.qos import Durability, History, Liveliness, QosProfile, Reliability

_UNSPECIFIED_NS = 0
_INFINITE_NS = 2**63 - 1


def latched(depth: int) -> QoSProfile:
    """Return a profile whose last samples DDS keeps for subscriptions that come later."""
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


def to_rclpy(qos: QosProfile | QoSProfile) -> QoSProfile:
    """Return rclpy's profile for ours, for creating an endpoint with; its own as it is."""
    if isinstance(qos, QoSProfile):
        return qos
    return QoSProfile(
        history=HistoryPolicy[qos.history.value],
        depth=qos.depth,
        reliability=ReliabilityPolicy[qos.reliability.value],
        durability=DurabilityPolicy[qos.durability.value],
        deadline=_duration(qos.deadline_ns),
        lifespan=_duration(qos.lifespan_ns),
        liveliness=LivelinessPolicy[qos.liveliness.value],
        liveliness_lease_duration=_duration(qos.liveliness_lease_duration_ns),
    )


def from_rclpy(qos: QoSProfile) -> QosProfile:
    """Return our profile for rclpy's, of a local endpoint or as discovery shows a remote one.

    What discovery does not carry (history and depth on Fast DDS) comes back as UNKNOWN and 0.
    """
    return QosProfile(
        history=History[qos.history.name],
        depth=qos.depth,
        reliability=Reliability[qos.reliability.name],
        durability=Durability[qos.durability.name],
        deadline_ns=_nanoseconds(qos.deadline),
        lifespan_ns=_nanoseconds(qos.lifespan),
        liveliness=Liveliness[qos.liveliness.name],
        liveliness_lease_duration_ns=_nanoseconds(qos.liveliness_lease_duration),
    )


def _duration(nanoseconds: int | None) -> Duration:
    return Duration(nanoseconds=_UNSPECIFIED_NS if nanoseconds is None else nanoseconds)


def _nanoseconds(duration: Duration) -> int | None:
    value = int(duration.nanoseconds)
    return None if value in (_UNSPECIFIED_NS, _INFINITE_NS) else value


_NAME = re.compile(r"(?P<package>[a-z][a-z0-9_]*)/(?P<kind>msg|srv|action)/(?P<type>[A-Z]\w*)")


def import_interface(name: str) -> type[Any]:
    """Return the class of `package/msg/Type`, `package/srv/Type` or `package/action/Type`.

    Raises:
        MiddlewareError: malformed, or the package or the type is not installed.
    """
    parts = _NAME.fullmatch(name)
    if parts is None:
        raise MiddlewareError(
            f"cannot read interface type {name!r}: write package/msg/Type, package/srv/Type or "
            "package/action/Type"
        )
    package, kind, type_ = parts["package"], parts["kind"], parts["type"]
    try:
        module = importlib.import_module(f"{package}.{kind}")
    except ModuleNotFoundError as error:
        if error.name not in (package, f"{package}.{kind}"):
            raise
        raise MiddlewareError(
            f"cannot find interface type {name!r}: no package {package!r} with {kind} interfaces "
            "is installed",
            hint=f"install {package}, or source the workspace that has it",
        ) from error
    found = getattr(module, type_, None)
    if not isinstance(found, type):
        import difflib

        near = difflib.get_close_matches(type_, dir(module), n=1)
        raise MiddlewareError(
            f"cannot find interface type {name!r}: package {package!r} has no {kind} {type_!r}",
            hint=f"did you mean {package}/{kind}/{near[0]}?" if near else "",
        )
    return found


def load_type_support(name: str) -> None:
    """Import an interface, and of a message or service what rcl needs of it: a shared library.

    Raises:
        MiddlewareError: see import_interface.
    """
    found = import_interface(name)
    with warnings.catch_warnings():
        # What generates Python from IDL comes along, with a parser that uses what is deprecated.
        warnings.simplefilter("ignore", DeprecationWarning)
        importlib.import_module("rosidl_generator_py")
    if "/msg/" in name:
        check_is_valid_msg_type(found)
    elif "/srv/" in name:
        check_is_valid_srv_type(found)


PARAMETER_TYPES = {
    "bool": Parameter.Type.BOOL,
    "int": Parameter.Type.INTEGER,
    "double": Parameter.Type.DOUBLE,
    "string": Parameter.Type.STRING,
    "byte_array": Parameter.Type.BYTE_ARRAY,
    "bool_array": Parameter.Type.BOOL_ARRAY,
    "int_array": Parameter.Type.INTEGER_ARRAY,
    "double_array": Parameter.Type.DOUBLE_ARRAY,
    "string_array": Parameter.Type.STRING_ARRAY,
}
"""Our type name → rclpy's type, whose value is rcl_interfaces/msg/ParameterType's."""

_WORDS = {each.value: word for word, each in PARAMETER_TYPES.items()}


def type_word(type_: int) -> str:
    """Return our name of a rcl_interfaces/msg/ParameterType; empty for one that is not set."""
    return _WORDS.get(type_, "")


def parameter_value(value: Any) -> ParameterValue | None:
    """Return a value as rclpy has it in our types: arrays are tuples, bytes are integers."""
    if isinstance(value, (bytes, list, tuple, array.array)):
        return tuple(each[0] if isinstance(each, bytes) else each for each in value)
    plain: ParameterValue | None = value
    return plain


def parameter_to_rclpy(value: ParameterValue, type_: str) -> Any:
    """Return a value as rclpy wants it: YAML writes 5 for a double, and bytes as integers."""
    if isinstance(value, tuple):
        if type_ == "double_array":
            return [float(each) for each in value]
        if type_ == "byte_array":
            return [bytes((int(each),)) for each in value]
        return list(value)
    if type_ == "double" and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return value
