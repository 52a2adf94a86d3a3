"""Participants of Fast DDS made from a profile: what rclpy and the environment cannot say.

Owns: the eight public functions of Fast DDS that are called in a process of ours, and the only file
that may call any: ctypes finds them by their mangled names, which are checked when it is loaded.

Profiles are read from the environment once per process, and rmw_fastrtps gives every participant
the factory's default QoS. So that default is changed for one participant at a time;
DomainParticipantQos objects stay opaque, made and destroyed by their own constructor and
destructor.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import threading
from collections.abc import Iterator, Sequence
from typing import Any

from rclpy.utilities import get_rmw_implementation_identifier

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.static_edp import endpoint_profiles
from lifecycle.middleware.versions import INSTALL, KNOWN_FAST_DDS, installed
from lifecycle.plan.model import StaticEndpoint

RMW = "rmw_fastrtps_cpp"

_DDS = "8eprosima7fastdds3dds"
_FACTORY = f"{_DDS}24DomainParticipantFactory"
_QOS = f"{_DDS}20DomainParticipantQos"
_STRING = "NSt7__cxx1112basic_stringIcSt11char_traitsIcESaIcEEE"
_QOS_ROOM_BYTES = 16384
"""Thirteen times sizeof(DomainParticipantQos) in 2.14.5."""
_OK = 0
DRAFT = "lifecycle_draft_of_a_profile"
"""The name of a profile, and what those of its transports begin with, before it has one."""


class _String(ctypes.Structure):
    # std::string of libstdc++'s C++11 ABI; never grown, so it may point at our bytes.
    _fields_ = (
        ("data", ctypes.c_char_p),
        ("size", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        ("unused", ctypes.c_size_t),
    )


class _FastDds:
    """The loaded library; get it from `_library`."""

    def __init__(self) -> None:
        try:
            self._library = ctypes.CDLL(installed().library)
        except OSError as error:
            raise MiddlewareError(
                f"cannot use Fast DDS, only {KNOWN_FAST_DDS} is known: {error}", hint=INSTALL
            ) from error
        pointer = ctypes.c_void_p
        code = ctypes.c_uint32  # ReturnCode_t is a trivially copyable class of one uint32_t
        bind = self._bind
        self.factory = bind(f"_ZN{_FACTORY}12get_instanceEv", pointer)
        self.load_profiles = bind(f"_ZN{_FACTORY}13load_profilesEv", code, pointer)
        self.load_string = bind(
            f"_ZN{_FACTORY}24load_XML_profiles_stringEPKcm",
            *(code, pointer, ctypes.c_char_p, ctypes.c_size_t),
        )
        self.default_qos = bind(f"_ZNK{_FACTORY}27get_default_participant_qosEv", pointer, pointer)
        self.set_default_qos = bind(
            f"_ZN{_FACTORY}27set_default_participant_qosERKNS1_20DomainParticipantQosE",
            *(code, pointer, pointer),
        )
        self.qos_from_profile = bind(
            f"_ZNK{_FACTORY}32get_participant_qos_from_profileERK{_STRING}"
            "RNS1_20DomainParticipantQosE",
            *(code, pointer, pointer, pointer),
        )
        self.copy_qos = bind(f"_ZN{_QOS}C1ERKS2_", None, pointer, pointer)
        self.destroy_qos = bind(f"_ZN{_QOS}D1Ev", None, pointer)
        self.loaded: set[str] = set()
        self.static: dict[tuple[bool, str], int] = {}
        self.lock = threading.RLock()

    def _bind(self, symbol: str, result: Any, *arguments: Any) -> Any:
        try:
            function = self._library[symbol]
        except AttributeError as error:
            raise MiddlewareError(
                f"cannot find {symbol!r} in Fast DDS: only {KNOWN_FAST_DDS} is known", hint=INSTALL
            ) from error
        function.restype, function.argtypes = result, arguments
        return function

    def load(self, xml: str) -> int:
        """Make profiles known to this process; returns the code."""
        # What the environment names comes first, as without us.
        self.load_profiles(self.factory())
        data = xml.encode()
        return int(self.load_string(self.factory(), data, len(data)))

    @contextlib.contextmanager
    def copied_default(self) -> Iterator[int]:
        """Yield the address of a copy of the default QoS."""
        room = ctypes.create_string_buffer(_QOS_ROOM_BYTES + 16)
        address = (ctypes.addressof(room) + 15) & ~15
        self.copy_qos(address, self.default_qos(self.factory()))
        try:
            yield address
        finally:
            self.destroy_qos(address)


@functools.lru_cache(maxsize=1)
def _library() -> _FastDds:
    return _FastDds()


def fast_dds_refusal() -> str:
    """Return why the loaded Fast DDS is not used beyond what rmw does; empty if it is, or none."""
    if get_rmw_implementation_identifier() == RMW:
        try:
            _library()
        except MiddlewareError:
            return f"the loaded Fast DDS is not known (known: {KNOWN_FAST_DDS})"
    return ""


@contextlib.contextmanager
def default_participant(xml: str) -> Iterator[None]:
    """Have participants that are created inside the block made from a profile.

    The default QoS before it is put back exactly, whatever set it. One block at a time: other
    threads that use this function wait; participants that they create otherwise meanwhile get this
    profile too.

    Args:
        xml: the profile, not as a default one, with DRAFT for its name. Fast DDS keeps each for
            good, so equal ones are loaded once.

    Raises:
        MiddlewareError: Fast DDS refused it, which it explains on standard error.
    """
    dds = _library()
    name = f"lifecycle_{hashlib.sha256(xml.encode()).hexdigest()[:16]}"
    data = name.encode()
    text = _String(data=data, size=len(data), capacity=len(data))
    with dds.lock, dds.copied_default() as before, dds.copied_default() as wanted:
        result = _OK if name in dds.loaded else dds.load(xml.replace(DRAFT, name))
        if result == _OK:
            dds.loaded.add(name)
            result = dds.qos_from_profile(dds.factory(), ctypes.byref(text), wanted)
        if result == _OK:
            result = dds.set_default_qos(dds.factory(), wanted)
        if result != _OK:
            raise MiddlewareError(
                f"cannot use participant profile {name!r}: Fast DDS refused it (code {result})"
            )
        try:
            yield
        finally:
            dds.set_default_qos(dds.factory(), before)


def load_endpoint_profiles(endpoints: Sequence[StaticEndpoint]) -> None:
    """Have these endpoints made with the ids of their lines in the table of static discovery.

    rmw_fastrtps looks for an endpoint's profile by its topic, and Fast DDS keeps the first that it
    gets for good: a process has one such participant.

    Raises:
        MiddlewareError: an endpoint of this process on the same topic has another id, or Fast DDS
            refused the profiles, which it explains on standard error.
    """
    dds = _library()
    with dds.lock:
        new = []
        for each in endpoints:
            known = dds.static.get((each.writer, each.profile))
            if known is None:
                new.append(each)
            elif known != each.user_id:
                raise MiddlewareError(
                    f"cannot discover {each.profile!r} statically: this process has it with id "
                    f"{known} already, not {each.user_id}",
                    hint="run the nodes in processes of their own",
                )
        if not new:
            return
        if (result := dds.load(endpoint_profiles(new))) != _OK:
            raise MiddlewareError(
                f"cannot load endpoint profiles: Fast DDS refused them (code {result})",
                hint="profiles of the environment's for the same topics must go",
            )
        dds.static.update(((each.writer, each.profile), each.user_id) for each in new)
