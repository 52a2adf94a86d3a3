"""Participant settings and discovery range of an rclpy context, applied while rmw makes it.

Owns: applying a ParticipantSettings at the only moment there is: while rmw_fastrtps makes the
participant, which is when the first node of a context is constructed; and keeping rmw_fastrtps from
adding discovery of its own to it.

Profiles are read from the environment once per process, and rmw_fastrtps gives every participant
the factory's default QoS. So that default is changed for one participant at a time, by the few C++
functions of Fast DDS that no environment variable replaces, called by mangled name through
ctypes; the DomainParticipantQos objects stay opaque, made and destroyed by their own constructor
and destructor.

For LOCALHOST it adds a shared memory and a UDP transport to whatever a profile says
(create_participant of rmw_fastrtps_shared_cpp), so a participant without shared memory has to bring
the same discovery in its own profile; for SUBNET it adds a multicast group as soon as there is a
static peer.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import threading
import weakref
from collections.abc import Iterator, Sequence
from typing import Any

from rclpy.context import Context
from rclpy.utilities import get_rmw_implementation_identifier

from lifecycle import dataclasses
from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.participant_profile import (
    DISCOVERY_SERVER_VARIABLE,
    ParticipantSettings,
    default_profile,
    profile,
    without_shared_memory,
)
from lifecycle.middleware.fastdds.profiles import PROFILE_NAME
from lifecycle.middleware.fastdds.sockets import (
    check_free,
    check_host,
    check_sockets,
    open_sockets,
)
from lifecycle.middleware.fastdds.static_edp import endpoint_profiles
from lifecycle.middleware.process.shared_memory import own_segments
from lifecycle.middleware.rcl import abi
from lifecycle.middleware.versions import INSTALL, KNOWN_FAST_DDS, installed
from lifecycle.plan.model import StaticEndpoint

_DDS = "8eprosima7fastdds3dds"
_FACTORY = f"{_DDS}24DomainParticipantFactory"
_QOS = f"{_DDS}20DomainParticipantQos"
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


@functools.lru_cache(maxsize=1)
def _shared_library() -> ctypes.CDLL:
    return ctypes.CDLL(installed().library)


class _FastDds:
    """The loaded library; get it from `_library`."""

    def __init__(self) -> None:
        try:
            _shared_library()
        except OSError as error:
            raise MiddlewareError(
                f"cannot use Fast DDS, only {KNOWN_FAST_DDS} is known: {error}", hint=INSTALL
            ) from error
        pointer = ctypes.c_void_p
        code = ctypes.c_uint32  # ReturnCode_t is a trivially copyable class of one uint32_t

        def bind(symbol: str, result: Any, *arguments: Any) -> Any:
            function = fast_dds_function(symbol, result, *arguments)
            if function is None:
                raise MiddlewareError(
                    f"cannot find {symbol!r} in Fast DDS: only {KNOWN_FAST_DDS} is known",
                    hint=INSTALL,
                )
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
        self.copy_qos = bind(f"_ZN{_QOS}C1ERKS2_", None, pointer, pointer)
        self.destroy_qos = bind(f"_ZN{_QOS}D1Ev", None, pointer)
        self.loaded: set[str] = set()
        self.static: dict[tuple[bool, str], int] = {}
        self.lock = threading.RLock()

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


_PARTICIPANT_OF = "_ZN16rmw_fastrtps_cpp22get_domain_participantEP10rmw_node_s"


def participant_of(rcl_node: int) -> int | None:
    """Return the address of the DomainParticipant of a node; None where the libraries are others.

    Args:
        rcl_node: address of the rcl_node_t.
    """
    functions = _node_functions()
    if functions is None:
        return None
    rmw_handle, domain_participant = functions
    found: int | None = domain_participant(rmw_handle(rcl_node))
    return found


@functools.lru_cache(maxsize=1)
def _node_functions() -> tuple[Any, Any] | None:
    """Return rcl_node_get_rmw_handle and rmw_fastrtps_cpp's get_domain_participant, if they are."""
    if not abi.is_known() or get_rmw_implementation_identifier() != _RMW:
        return None
    pointer = ctypes.c_void_p
    try:
        return (
            abi.bind("rcl", "rcl_node_get_rmw_handle", pointer, (pointer,)),
            abi.bind(_RMW, _PARTICIPANT_OF, pointer, (pointer,)),
        )
    except MiddlewareError:
        return None


@functools.cache
def fast_dds_function(symbol: str, result: Any, *arguments: Any) -> Any:
    """Return a function of Fast DDS by its mangled name; None where there is none.

    It loads the library: only for who has a participant of it, see `participant_of`.
    """
    try:
        function = _shared_library()[symbol]
    except (OSError, AttributeError):
        return None
    function.restype, function.argtypes = result, arguments
    return function


def fast_dds_address(symbol: str) -> int | None:
    """Return where a variable of libfastrtps 2.14 is, by its mangled name; None if there is none.

    As for `fast_dds_function`.
    """
    try:
        return ctypes.addressof(ctypes.c_char.in_dll(_shared_library(), symbol))
    except (OSError, ValueError):
        return None


def unknown_versions() -> str:
    """Return which of the libraries here are not known, and what that costs; empty if all are.

    It needs rclpy, and loads nothing that rclpy has not loaded.
    """
    unknown = []
    if refusal := abi.refusal():
        unknown.append(
            f"{refusal}: nodes, endpoints and states are "
            "verified; network flow endpoints cannot be read or made unique, so that what requires "
            "them is unverifiable or refused"
        )
    if refusal := fast_dds_refusal():
        unknown.append(
            f"{refusal}: participants get no connections, transports or DSCP of their own"
        )
    return "; ".join(unknown)


def fast_dds_refusal() -> str:
    """Return why the loaded Fast DDS is not used beyond what rmw does; empty if it is, or none."""
    if get_rmw_implementation_identifier() == _RMW:
        try:
            _library()
        except MiddlewareError:
            return f"the loaded Fast DDS is not known (known: {KNOWN_FAST_DDS})"
    return ""


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
        if (result := dds.load(xml)) != _OK:
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


def observer_settings(settings: ParticipantSettings, *, super_client: bool) -> ParticipantSettings:
    """Return the settings of an observer's participant: no shared memory, unless it is chosen.

    Args:
        settings: what it needs otherwise.
        super_client: it is to be, see ParticipantSettings.

    Returns:
        `settings`, where they, a profile or the environment say what transports it has, and with
        another RMW or an unknown version of Fast DDS.
    """
    if get_rmw_implementation_identifier() != _RMW:
        return settings
    try:
        _library()
        if settings or super_client:
            return dataclasses.replace(settings, super_client=super_client)
        transports = without_shared_memory(os.environ)
        return dataclasses.replace(
            settings, transports=transports, announces_often=bool(transports)
        )
    except MiddlewareError:
        # An error of a profile is reported where the profile is needed; Fast DDS ignores it.
        return settings


def host_settings(settings: ParticipantSettings) -> ParticipantSettings:
    """Return the settings of a host's first participant that is to be unannounced, if it can be.

    It cannot with another RMW, an unknown version of Fast DDS, a discovery server, connection URLs
    or a profile of the user's.
    """
    if get_rmw_implementation_identifier() != _RMW or settings.urls:
        return settings
    try:
        _library()
        base = default_profile()
    except MiddlewareError:
        # An error of a profile is reported where the profile is needed; Fast DDS ignores it.
        return settings
    if os.environ.get(DISCOVERY_SERVER_VARIABLE) or (base and base.name != PROFILE_NAME):
        return settings
    return dataclasses.replace(settings, unannounced=True)


_RANGE, _PEERS = "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS"
_LOCALHOST_ONLY = "ROS_LOCALHOST_ONLY"
"""ROS 2 of before Jazzy has that for a range of LOCALHOST, and it counts first."""


def _localhost_peers() -> tuple[str, ...] | None:
    """Return the static peers where the environment asks for LOCALHOST; None if it does not."""
    if os.environ.get(_LOCALHOST_ONLY) == "1":
        return ()
    if os.environ.get(_RANGE) != "LOCALHOST":
        return None
    return tuple(filter(None, os.environ.get(_PEERS, "").split(";")))


@contextlib.contextmanager
def discovery_by_profile(settings: ParticipantSettings) -> Iterator[None]:
    """Have rmw leave discovery to the profile of a context that is initialised in the block.

    rcl reads the range from the environment then (rcl/discovery_options.h).

    Args:
        settings: that the context's participant gets; what they leave open stays as it is.
    """
    is_left = settings.chooses_transports and _localhost_peers() is not None
    if not (settings.governs_discovery or is_left):
        yield
        return
    before = {each: os.environ.pop(each, None) for each in (_RANGE, _LOCALHOST_ONLY)}
    os.environ[_RANGE] = "SYSTEM_DEFAULT"
    try:
        yield
    finally:
        del os.environ[_RANGE]
        os.environ.update({name: value for name, value in before.items() if value is not None})


_RMW = "rmw_fastrtps_cpp"


_SHARED_MEMORY_OF: weakref.WeakKeyDictionary[Context, bool] = weakref.WeakKeyDictionary()


def noted_shared_memory(context: Context) -> bool | None:
    """Return whether the participant of a context has it, where that was seen when it was made."""
    return _SHARED_MEMORY_OF.get(context)


@contextlib.contextmanager
def noting_shared_memory(context: Context, *, is_new: bool) -> Iterator[None]:
    """Note whether the participant of a context has it, which is made in the block and no other.

    Where that cannot be seen nothing is noted: nothing was opened, and the participant may have
    been there, beside others.

    Args:
        context: of the next node.
        is_new: it has no participant yet.

    To ask for it costs a subscription, which is announced and taken back while others discover the
    participant; then another one in the same process may lack all its subscriptions for good.
    """
    before = own_segments()
    yield
    if get_rmw_implementation_identifier() == _RMW:
        opened = not own_segments() <= before
        if opened or is_new or not before:
            _SHARED_MEMORY_OF[context] = opened


_DRAFT = "lifecycle_draft_of_a_profile"


@contextlib.contextmanager
def participant_settings(context: Context, settings: ParticipantSettings) -> Iterator[None]:
    """Give the participant of `context` these settings: construct its first node in the block.

    Everything is as before after the block, and later participants get what they always got.
    Participants that other contexts get inside the block have the settings as well.

    Args:
        context: initialised in `discovery_by_profile`, without a node yet; otherwise it has no
            effect.
        settings: empty ones change nothing, and need no Fast DDS.

    Raises:
        MiddlewareError: another RMW than rmw_fastrtps_cpp, an unknown version of it, a default
            profile that already chooses transports, or URLs with an address that this host has
            not; nothing was changed. At the end of the block: the participant has not got the
            ports of its URLs; its node is the caller's to destroy.
    """
    if not settings:
        yield
        return
    rmw = get_rmw_implementation_identifier()
    if rmw != _RMW:
        raise MiddlewareError(
            f"cannot choose the transports of a participant with RMW {rmw!r}",
            hint=f"set RMW_IMPLEMENTATION={_RMW}",
        )
    if settings.urls:
        _check_environment(settings)
        check_host(settings.urls)
    domain_id = context.get_domain_id()
    with contextlib.ExitStack() as stack:
        is_open = settings.chooses_transports and not settings.governs_discovery
        peers = _localhost_peers() if is_open else None
        if settings.static_participants:
            load_endpoint_profiles(settings.static_endpoints)
        base = default_profile()
        # The name says what is in it: equal profiles are loaded once.
        draft = profile(_DRAFT, settings, base=base, localhost_peers=peers, domain_id=domain_id)
        name = f"lifecycle_{hashlib.sha256(draft.encode()).hexdigest()[:16]}"
        load_profile(name, draft.replace(_DRAFT, name))
        stack.enter_context(default_participant(name))
        if not settings.urls:
            yield
            return
        # Under the lock of the default profile: no participant of ours is made in between.
        check_free(settings.urls)
        before = {each.inode for each in open_sockets()}
        yield
        opened = [each for each in open_sockets() if each.inode not in before]
        check_sockets(settings.urls, opened)


def _check_environment(settings: ParticipantSettings) -> None:
    server = os.environ.get(DISCOVERY_SERVER_VARIABLE, "")
    if server and not any(url.server for url in settings.urls):
        raise MiddlewareError(
            f"cannot connect by {str(settings.urls[0])!r}: {DISCOVERY_SERVER_VARIABLE}={server!r} "
            "makes every participant a client of that server",
            hint=f"unset {DISCOVERY_SERVER_VARIABLE}, or name the server in the URL, "
            "server=ADDRESS:PORT",
        )
