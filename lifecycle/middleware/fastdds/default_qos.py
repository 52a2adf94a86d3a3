"""The default participant QoS of Fast DDS, changed for one participant at a time.

Owns: the few C++ functions of libfastrtps 2.14 that no environment variable replaces: profiles are
read from the environment once per process, and rmw_fastrtps gives every participant the factory's
default QoS. All of it is called by mangled name through ctypes; the DomainParticipantQos objects
stay opaque, made and destroyed by their own constructor and destructor.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import threading
from collections.abc import Iterator
from typing import Any

from lifecycle.errors import MiddlewareError

_LIBRARY = "libfastrtps.so.2.14"
_DDS = "8eprosima7fastdds3dds"
_FACTORY = f"{_DDS}24DomainParticipantFactory"
_QOS = f"{_DDS}20DomainParticipantQos"
_PROFILES = "8eprosima8fastrtps9xmlparser17XMLProfileManager"
_STRING = "NSt7__cxx1112basic_stringIcSt11char_traitsIcESaIcEEE"
_QOS_ROOM_BYTES = 16384
"""Thirteen times sizeof(DomainParticipantQos) in 2.14.5."""
_OK = 0


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
            library = ctypes.CDLL(_LIBRARY)
        except OSError as error:
            raise MiddlewareError(
                f"cannot load Fast DDS: {error}", hint="install ros-jazzy-rclpy[fastrtps]"
            ) from error
        pointer = ctypes.c_void_p
        code = ctypes.c_uint32  # ReturnCode_t is a trivially copyable class of one uint32_t

        def bind(symbol: str, result: Any, *arguments: Any) -> Any:
            try:
                function = getattr(library, symbol)
            except AttributeError as error:
                raise MiddlewareError(
                    f"cannot find {symbol!r} in {_LIBRARY}: it is not the Fast DDS 2.14 that ROS 2 "
                    "Jazzy comes with",
                    hint="install ros-jazzy-rclpy[fastrtps]",
                ) from error
            function.restype, function.argtypes = result, arguments
            return function

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
        self.forget_profiles = bind(f"_ZN{_PROFILES}14DeleteInstanceEv", None)
        self.load_default_files = bind(f"_ZN{_PROFILES}18loadDefaultXMLFileEv", code)
        self.copy_qos = bind(f"_ZN{_QOS}C1ERKS2_", None, pointer, pointer)
        self.destroy_qos = bind(f"_ZN{_QOS}D1Ev", None, pointer)
        self.loaded: set[str] = set()
        self.lock = threading.RLock()

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


def load_profile(name: str, xml: str) -> None:
    """Make a participant profile known to this process; again is harmless.

    Args:
        name: of the profile; Fast DDS keeps it, and what was first loaded under it, for good.
        xml: contains it, not as a default profile.

    Raises:
        MiddlewareError: Fast DDS refused it, which it explains on standard error.
    """
    dds = _library()
    with dds.lock:
        if name in dds.loaded:
            return
        # What the environment names comes first, as without us.
        dds.load_profiles(dds.factory())
        data = xml.encode()
        result = dds.load_string(dds.factory(), data, len(data))
        if result != _OK:
            raise MiddlewareError(
                f"cannot load participant profile {name!r}: Fast DDS refused it (code {result})"
            )
        dds.loaded.add(name)


@contextlib.contextmanager
def default_participant(name: str) -> Iterator[None]:
    """Have participants that are created inside the block made from a loaded profile.

    The default QoS before it is put back exactly, whatever set it. One block at a time: other
    threads that use this function wait; participants that they create otherwise meanwhile get this
    profile too.

    Raises:
        MiddlewareError: no such profile, or Fast DDS refused it.
    """
    dds = _library()
    with dds.lock, dds.copied_default() as before, dds.copied_default() as wanted:
        data = name.encode()
        text = _String(data=data, size=len(data), capacity=len(data))
        result = dds.qos_from_profile(dds.factory(), ctypes.byref(text), wanted)
        if result == _OK:
            result = dds.set_default_qos(dds.factory(), wanted)
        if result != _OK:
            raise MiddlewareError(f"cannot use participant profile {name!r}: code {result}")
        try:
            yield
        finally:
            result = dds.set_default_qos(dds.factory(), before)
            if result != _OK:
                raise MiddlewareError(f"cannot restore the default profile: code {result}")


@contextlib.contextmanager
def endpoint_profiles(xml: str) -> Iterator[None]:
    """Have endpoints that are created inside the block made from these profiles.

    rmw_fastrtps looks for a profile by an endpoint's topic, and Fast DDS keeps the first that it
    was given for good: so all profiles are forgotten, and those of the environment's files loaded
    again, before and after. Profiles that other code loaded from the program are lost. Other
    threads must not create endpoints meanwhile; those of this function wait.

    Raises:
        MiddlewareError: Fast DDS refused them, which it explains on standard error; a file of the
            environment's may have a profile for the same topic.
    """
    dds = _library()

    def start_again() -> None:
        dds.forget_profiles()
        dds.loaded.clear()
        dds.load_default_files()

    with dds.lock:
        dds.load_profiles(dds.factory())
        start_again()
        try:
            data = xml.encode()
            result = dds.load_string(dds.factory(), data, len(data))
            if result != _OK:
                raise MiddlewareError(
                    f"cannot load endpoint profiles: Fast DDS refused them (code {result})",
                    hint="profiles of the environment's for the same topics must go",
                )
            yield
        finally:
            start_again()
