"""The C ABI of rcl, rmw and rcutils that rclpy does not expose, through ctypes.

Owns: the struct layouts, the function signatures, and the check that the loaded libraries are the
ones these layouts were written for. Layouts are those of rcl 9 (ROS 2 Jazzy) and 10 (Kilted), both
with rmw 7, on any 64-bit Linux; headers rcl/{publisher,subscription,wait,guard_condition}.h,
rmw/{types,network_flow_endpoint}.h, rcutils/{allocator,error_handling}.h. With other libraries
nothing is called: `refusal` says why.
"""

from __future__ import annotations

import ctypes
import functools
import re
from collections.abc import Sequence
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation  # noqa: F401 - loads rcl

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.versions import INSTALL, KNOWN_RCL, of_rcl, private, rcl_version

RCL_RET_OK = 0
RCL_RET_TIMEOUT = 2
RCL_RET_UNSUPPORTED = 3
_FOR_EVER = -1
_ERROR_LOCATION = re.compile(r", at [^,]+?:\d+(?=,|$)")


class Allocator(ctypes.Structure):
    """rcutils_allocator_t: four functions and their state, which nothing here looks into."""

    _fields_ = (("words", ctypes.c_void_p * 5),)


class Nfe(ctypes.Structure):
    """rmw_network_flow_endpoint_t."""

    _fields_ = (
        ("transport_protocol", ctypes.c_int),
        ("internet_protocol", ctypes.c_int),
        ("transport_port", ctypes.c_uint16),
        ("flow_label", ctypes.c_uint32),
        ("dscp", ctypes.c_uint8),
        ("internet_address", ctypes.c_char * 48),
    )


class NfeArray(ctypes.Structure):
    """rmw_network_flow_endpoint_array_t."""

    _fields_ = (
        ("size", ctypes.c_size_t),
        ("items", ctypes.POINTER(Nfe)),
        ("allocator", ctypes.c_void_p),
    )


class Time(ctypes.Structure):
    """rmw_time_t."""

    _fields_ = (("sec", ctypes.c_uint64), ("nsec", ctypes.c_uint64))


class Qos(ctypes.Structure):
    """rmw_qos_profile_t."""

    _fields_ = (
        ("history", ctypes.c_int),
        ("depth", ctypes.c_size_t),
        ("reliability", ctypes.c_int),
        ("durability", ctypes.c_int),
        ("deadline", Time),
        ("lifespan", Time),
        ("liveliness", ctypes.c_int),
        ("liveliness_lease_duration", Time),
        ("avoid_ros_namespace_conventions", ctypes.c_bool),
    )


class _RmwSubscriptionOptions(ctypes.Structure):
    _fields_ = (
        ("payload", ctypes.c_void_p),
        ("ignore_local_publications", ctypes.c_bool),
        ("unique", ctypes.c_int),
        ("content_filter_options", ctypes.c_void_p),
    )


class SubscriptionOptions(ctypes.Structure):
    """rcl_subscription_options_t."""

    _fields_ = (
        ("qos", Qos),
        ("allocator", Allocator),
        ("rmw", _RmwSubscriptionOptions),
        ("disable_loaned_message", ctypes.c_bool),
    )


class WaitSet(ctypes.Structure):
    """rcl_wait_set_t: six arrays, each with its size, and a pointer; rcl alone looks into it."""

    _fields_ = (("words", ctypes.c_void_p * 13),)


class _ErrorString(ctypes.Structure):
    _fields_ = (("text", ctypes.c_char * 1024),)


class _PaddedOptions(ctypes.Structure):
    # With room behind it, for a library whose struct turns out larger.
    _fields_ = (("options", SubscriptionOptions), ("room", ctypes.c_ubyte * 1024))


_POINTER, _SIZE, _CODE = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
_GET_NFES = (_CODE, (_POINTER,) * 3)
_FUNCTIONS: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "rcutils_get_default_allocator": (Allocator, ()),
    "rcutils_get_error_string": (_ErrorString, ()),
    "rcutils_reset_error": (None, ()),
    "rmw_network_flow_endpoint_set_internet_address": (_CODE, (_POINTER, ctypes.c_char_p, _SIZE)),
    "rmw_network_flow_endpoint_array_fini": (_CODE, (_POINTER,)),
    "rcl_publisher_get_network_flow_endpoints": _GET_NFES,
    "rcl_subscription_get_network_flow_endpoints": _GET_NFES,
    "rcl_subscription_get_default_options": (_PaddedOptions, ()),
    "rcl_subscription_get_options": (ctypes.POINTER(SubscriptionOptions), (_POINTER,)),
    "rcl_subscription_init": (_CODE, (_POINTER, _POINTER, _POINTER, ctypes.c_char_p, _POINTER)),
    "rcl_subscription_fini": (_CODE, (_POINTER, _POINTER)),
    "rcl_node_get_graph_guard_condition": (_POINTER, (_POINTER,)),
    "rcl_get_zero_initialized_wait_set": (WaitSet, ()),
    "rcl_wait_set_init": (_CODE, (_POINTER, *[_SIZE] * 6, _POINTER, Allocator)),
    "rcl_wait_set_fini": (_CODE, (_POINTER,)),
    "rcl_wait_set_clear": (_CODE, (_POINTER,)),
    "rcl_wait_set_add_guard_condition": (_CODE, (_POINTER,) * 3),
    "rcl_wait": (_CODE, (_POINTER, ctypes.c_int64)),
}
"""The result and the arguments of each function that is called of a library that is known."""


class Rcl:
    """The loaded libraries by name; they release the GIL while they run. Get it from `load`."""

    def __init__(self) -> None:
        version = rcl_version()
        if of_rcl(version) is None:
            raise MiddlewareError(f"rcl {version} is not known (known: {KNOWN_RCL})", hint=INSTALL)
        self.call = {name: bind(name, *signature) for name, signature in _FUNCTIONS.items()}
        self.default_allocator: Allocator = self.call["rcutils_get_default_allocator"]()
        self._check_layout(version)

    def take_error(self) -> str:
        """Return and clear this thread's rcl error, without the C file names it drags along."""
        text: str = self.call["rcutils_get_error_string"]().text.decode(errors="replace")
        self.call["rcutils_reset_error"]()
        return _ERROR_LOCATION.sub("", text).strip() or "no reason given"

    def flow_endpoints(self, kind: str, entity: int) -> tuple[int, list[Nfe]]:
        """Return the code of rcl and the NFEs of a "publisher" or "subscription"."""
        array = NfeArray()
        get = self.call[f"rcl_{kind}_get_network_flow_endpoints"]
        code = get(entity, ctypes.byref(self.default_allocator), ctypes.byref(array))
        if code != RCL_RET_OK:
            return code, []
        found = [Nfe.from_buffer_copy(array.items[index]) for index in range(array.size)]
        if array.allocator:  # an empty list was never initialised, and fini would complain of it
            self.call["rmw_network_flow_endpoint_array_fini"](ctypes.byref(array))
        return code, found

    def remake_unique(
        self, subscription: int, node: int, type_: object, topic: str, unique: int
    ) -> int:
        """Make a subscription again in place, with the option for unique NFEs; return the code.

        Args:
            subscription: address of its rcl_subscription_t.
            node: address of its rcl_node_t.
            type_: message class that rclpy has used.
            topic: as rclpy was given it: rcl must apply remap rules exactly once.
            unique: of rmw_unique_network_flow_endpoints_requirement_t.

        Raises:
            MiddlewareError: it could not be ended; it is as before.
        """
        held = self.call["rcl_subscription_get_options"](subscription).contents
        options = type(held).from_buffer_copy(held)  # fini frees the original
        options.rmw.unique = unique
        if self.call["rcl_subscription_fini"](subscription, node) != RCL_RET_OK:
            raise MiddlewareError(f"cannot re-create subscription {topic!r}: {self.take_error()}")
        made = self.call["rcl_subscription_init"](
            subscription, node, type_support(type_), topic.encode(), ctypes.byref(options)
        )
        return int(made)

    def _check_layout(self, version: str) -> None:
        """Compare the defaults that the libraries put into our structs with those of rmw and rcl.

        A field that moved shows as a wrong default before anything is written through it.
        """
        expected = (1, 10, 1, 2, False, bytes(self.default_allocator), 0)
        options = self.call["rcl_subscription_get_default_options"]().options
        found = (
            options.qos.history,
            options.qos.depth,
            options.qos.reliability,
            options.qos.durability,
            options.qos.avoid_ros_namespace_conventions,
            bytes(options.allocator),
            options.rmw.unique,
        )
        if found != expected or options.rmw.payload is not None:
            raise _layout_error("rcl_subscription_options_t", version)
        # One spare element behind it, should the library's struct be longer.
        probe = (Nfe * 2)()
        put = self.call["rmw_network_flow_endpoint_set_internet_address"]
        put(ctypes.byref(probe), b"192.0.2.1", 9)
        if probe[0].internet_address != b"192.0.2.1" or bytes(probe[1]).strip(b"\0"):
            raise _layout_error("rmw_network_flow_endpoint_t", version)


class GuardWait:
    """Waits for guard conditions of one context; `close` it after the last `wait` has returned.

    Raises:
        MiddlewareError: rcl refuses, also to wait.
    """

    def __init__(self, context: int, count: int) -> None:
        self._rcl = load()
        self._call = self._rcl.call
        self._set = self._call["rcl_get_zero_initialized_wait_set"]()
        sizes, allocator = (0, count, 0, 0, 0, 0), self._rcl.default_allocator
        at = ctypes.byref(self._set)
        self._check(self._call["rcl_wait_set_init"](at, *sizes, context, allocator))

    def wait(self, guards: Sequence[int], timeout_s: float | None) -> bool:
        """Return whether one of the guard conditions was triggered in time, None for ever."""
        wait_set = ctypes.byref(self._set)
        self._check(self._call["rcl_wait_set_clear"](wait_set))
        for each in guards:
            self._check(self._call["rcl_wait_set_add_guard_condition"](wait_set, each, None))
        timeout_ns = _FOR_EVER if timeout_s is None else round(timeout_s * 1e9)
        result = self._call["rcl_wait"](wait_set, timeout_ns)
        if result == RCL_RET_TIMEOUT:
            return False
        self._check(result)
        return True

    def close(self) -> None:
        """Free it."""
        self._call["rcl_wait_set_fini"](ctypes.byref(self._set))

    def _check(self, result: int) -> None:
        if result != RCL_RET_OK:
            raise MiddlewareError(f"cannot wait for graph changes: {self._rcl.take_error()}")


@functools.lru_cache(maxsize=1)
def load() -> Rcl:
    """Load and check the libraries; raises MiddlewareError where they are not as known."""
    return Rcl()


def refusal() -> str:
    """Return why the installed libraries are not used: version, layout; empty if they are."""
    try:
        load()
    except MiddlewareError as error:
        return error.message
    return ""


def assert_liveliness(publisher: int) -> bool:
    """Assert the liveliness of an rcl_publisher_t without the GIL; return whether it was."""
    call = bind("rcl_publisher_assert_liveliness", _CODE, (_POINTER,))
    return bool(call(publisher) == RCL_RET_OK)


def type_support(message_type: object) -> int:
    """Return the address of a message class's rosidl_message_type_support_t, once rclpy used it."""
    capsule = private(type(message_type), "_TYPE_SUPPORT", f"read the type of {message_type!r}")
    name = ctypes.pythonapi.PyCapsule_GetName
    name.restype, name.argtypes = ctypes.c_char_p, (ctypes.py_object,)
    pointer = ctypes.pythonapi.PyCapsule_GetPointer
    pointer.restype, pointer.argtypes = ctypes.c_void_p, (ctypes.py_object, ctypes.c_char_p)
    return int(pointer(capsule, name(capsule)))


@functools.cache
def bind(symbol: str, result: Any, arguments: tuple[Any, ...]) -> Any:
    """Return a function of the library that its name begins with: rcl, rmw or rcutils.

    Raises:
        MiddlewareError: there is none.
    """
    # rclpy has loaded the very same libraries: dlopen finds them by name wherever they are
    # installed, and never a second copy.
    library = symbol.partition("_")[0]
    try:
        function = getattr(ctypes.CDLL(f"lib{library}.so"), symbol)
    except (OSError, AttributeError) as error:
        raise MiddlewareError(
            f"cannot find {symbol!r} in the installed ROS libraries (rcl {rcl_version() or '?'}): "
            f"{error}",
            hint=INSTALL,
        ) from error
    function.restype, function.argtypes = result, arguments
    return function


def _layout_error(struct: str, version: str) -> MiddlewareError:
    return MiddlewareError(
        f"rcl {version or 'of unknown version'} was built otherwise: its {struct} is not laid out "
        f"as that of {KNOWN_RCL}",
        hint=INSTALL,
    )
