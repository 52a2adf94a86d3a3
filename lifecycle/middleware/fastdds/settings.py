"""Participant settings and discovery range of an rclpy context, applied while rmw makes it.

Owns: applying a ParticipantSettings at the only moment there is: while rmw_fastrtps makes the
participant, which is when the first node of a context is constructed; and reading how far that
participant looks for others (the discovery range that rmw gets), and taking it away from
rmw_fastrtps; and `stop_listening`, before a participant is destroyed.

Profiles are read from the environment once per process, and rmw_fastrtps gives every participant
the factory's default QoS. So that default is changed for one participant at a time, by the few C++
functions of libfastrtps 2.14 that no environment variable replaces, called by mangled name through
ctypes; the DomainParticipantQos objects stay opaque, made and destroyed by their own constructor
and destructor.

For LOCALHOST it adds a shared memory and a UDP transport to whatever a profile says
(create_participant of rmw_fastrtps_shared_cpp), so a participant without shared memory has to bring
the same discovery in its own profile; for SUBNET it adds a multicast group as soon as there is a
static peer. Layouts are those of rmw 7: rmw/{init,init_options,discovery_options}.h.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import rclpy.node
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.utilities import get_rmw_implementation_identifier

from lifecycle import dataclasses
from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.participant_profile import (
    DISCOVERY_SERVER_VARIABLE,
    ParticipantSettings,
    are_names_open,
    default_profile,
    endpoint_profiles,
    for_a_host,
    profile,
    without_shared_memory,
)
from lifecycle.middleware.fastdds.url_check import (
    check_free,
    check_host,
    check_sockets,
    open_sockets,
)
from lifecycle.middleware.fastdds.url_profile import families
from lifecycle.middleware.process.shared_memory import own_segments
from lifecycle.middleware.rcl import abi

_LIBRARY = "libfastrtps.so.2.14"
_KNOWN = "Fast DDS 2.14 (ROS 2 Jazzy)"
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


@functools.lru_cache(maxsize=1)
def _shared_library() -> ctypes.CDLL:
    return ctypes.CDLL(_LIBRARY)


class _FastDds:
    """The loaded library; get it from `_library`."""

    def __init__(self) -> None:
        try:
            library = _shared_library()
        except OSError as error:
            raise MiddlewareError(
                f"cannot use Fast DDS, only {_KNOWN} is known: {error}", hint=abi.INSTALL
            ) from error
        pointer = ctypes.c_void_p
        code = ctypes.c_uint32  # ReturnCode_t is a trivially copyable class of one uint32_t

        def bind(symbol: str, result: Any, *arguments: Any) -> Any:
            try:
                function = getattr(library, symbol)
            except AttributeError as error:
                raise MiddlewareError(
                    f"cannot find {symbol!r} in {_LIBRARY}: only {_KNOWN} is known",
                    hint=abi.INSTALL,
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


def load_library() -> None:
    """Load what participants are made and found through, for a process that forks others."""
    if get_rmw_implementation_identifier() == _RMW:
        with contextlib.suppress(MiddlewareError):  # of another version, which hosts do without
            _library()
        _node_functions()


@functools.lru_cache(maxsize=1)
def _library() -> _FastDds:
    return _FastDds()


_SET_LISTENER = (
    f"_ZN{_DDS}17DomainParticipant12set_listenerEPNS1_25DomainParticipantListenerE"
    "NSt6chrono8durationIlSt5ratioILl1ELl1EEEE"
)
_PARTICIPANT_OF = "_ZN16rmw_fastrtps_cpp22get_domain_participantEP10rmw_node_s"
_LISTENS_S = 1


def stop_listening(node: rclpy.node.Node) -> None:
    """Have the participant of a node notice no others any more; before it is destroyed, bounded.

    rmw_fastrtps does this while it destroys a participant, and waits for callbacks that are running
    until the end of time. In Fast DDS 2.14 that date overflows, into the past
    (DomainParticipant::set_listener): it does not wait then but looks again and again, and hardly
    ever lets go of the lock that the callback needs to end. One of about 1,000 hosts hung so, where
    twenty left at once. What has no listener has no callback to wait for.
    """
    pointer = ctypes.c_void_p
    with contextlib.suppress(InvalidHandle), node.handle:
        participant = participant_of(node.handle.pointer)
        if not participant:
            return
        set_listener = fast_dds_function(
            _SET_LISTENER, ctypes.c_uint32, pointer, pointer, ctypes.c_int64
        )
        if set_listener is not None:
            set_listener(participant, None, _LISTENS_S)


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
    """Return a function of libfastrtps 2.14 by its mangled name; None where there is none.

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
    if not abi.is_known():
        version = abi.rcl_version() or "of unknown version"
        unknown.append(
            f"rcl {version} is not known (known: {abi.KNOWN}): nodes, endpoints and states are "
            "verified; network flow endpoints cannot be read or made unique, so that what requires "
            "them is unverifiable or refused"
        )
    if get_rmw_implementation_identifier() == _RMW:
        try:
            _library()
        except MiddlewareError:
            unknown.append(
                f"the loaded Fast DDS is not known (known: {_KNOWN}): participants get no "
                "connections, transports or DSCP of their own, and which endpoints are matched is "
                "counted only"
            )
    return "; ".join(unknown)


def observer_settings(
    settings: ParticipantSettings, *, unannounced: bool, super_client: bool
) -> ParticipantSettings:
    """Return the settings of an observer's participant: no shared memory, unless it is chosen.

    It asks soon for names of nodes that it has not received, too.

    Args:
        settings: what it needs otherwise.
        unannounced: it is to be, see ParticipantSettings.
        super_client: likewise.

    Returns:
        `settings`, where they, a profile or the environment say what transports it has, and with
        another RMW or an unknown version of Fast DDS.
    """
    if get_rmw_implementation_identifier() != _RMW:
        return settings
    try:
        _library()
        if settings or unannounced or super_client:
            return dataclasses.replace(settings, unannounced=unannounced, super_client=super_client)
        transports = without_shared_memory(os.environ)
        asks = bool(transports) and are_names_open(os.environ)
        return dataclasses.replace(settings, transports=transports, asks_for_names_soon=asks)
    except MiddlewareError:
        # An error of a profile is reported where the profile is needed; Fast DDS ignores it.
        return settings


def host_settings(
    settings: ParticipantSettings, *, unannounced: bool, names_by_udp: bool, participants: int
) -> ParticipantSettings:
    """Return the settings of a host's first participant, see `for_a_host`.

    Args:
        settings: what it needs otherwise.
        unannounced: it is to be, where that is possible.
        names_by_udp: likewise.
        participants: how many are made together, ≥ 0.

    Returns:
        `settings` with another RMW, and an unknown version of Fast DDS.
    """
    if get_rmw_implementation_identifier() != _RMW:
        return settings
    try:
        _library()
        return for_a_host(
            settings,
            os.environ,
            unannounced=unannounced,
            names_by_udp=names_by_udp,
            participants=participants,
        )
    except MiddlewareError:
        # As for an observer.
        return settings


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
def with_endpoint_profiles(xml: str) -> Iterator[None]:
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


_LOCALHOST = 2
_SYSTEM_DEFAULT = 4
_PEER_BYTES = 256


class _Security(ctypes.Structure):
    _fields_ = (("enforce", ctypes.c_int), ("root_path", ctypes.c_void_p))


class _Peer(ctypes.Structure):
    _fields_ = (("address", ctypes.c_char * _PEER_BYTES),)


class _Discovery(ctypes.Structure):
    # rmw_discovery_options_t
    _fields_ = (
        ("range", ctypes.c_int),
        ("peers", ctypes.POINTER(_Peer)),
        ("peers_count", ctypes.c_size_t),
        ("allocator", abi.Allocator),
    )


class _InitOptions(ctypes.Structure):
    # rmw_init_options_t
    _fields_ = (
        ("instance_id", ctypes.c_uint64),
        ("identifier", ctypes.c_void_p),
        ("domain_id", ctypes.c_size_t),
        ("security", _Security),
        ("localhost_only", ctypes.c_int),
        ("discovery", _Discovery),
        ("enclave", ctypes.c_char_p),
        ("allocator", abi.Allocator),
        ("impl", ctypes.c_void_p),
    )


class _RmwContext(ctypes.Structure):
    # rmw_context_t
    _fields_ = (
        ("instance_id", ctypes.c_uint64),
        ("identifier", ctypes.c_void_p),
        ("options", _InitOptions),
        ("domain_id", ctypes.c_size_t),
        ("impl", ctypes.c_void_p),
    )


@contextlib.contextmanager
def without_localhost(context: Context) -> Iterator[tuple[str, ...] | None]:
    """Have rmw leave discovery alone, inside the block, if it were to look on this host only.

    Args:
        context: initialised; without a node yet, or its participant exists already.

    Yields:
        The context's static peers, if it was LOCALHOST; None if nothing was changed.

    Raises:
        MiddlewareError: the installed rmw is laid out otherwise.
    """
    with context.handle:
        discovery = _discovery(context)
        if discovery.range != _LOCALHOST:
            yield None
            return
        peers = tuple(
            discovery.peers[index].address.decode() for index in range(discovery.peers_count)
        )
        with _set(discovery, _SYSTEM_DEFAULT):
            yield peers


@contextlib.contextmanager
def system_default(context: Context) -> Iterator[None]:
    """Have rmw leave discovery alone inside the block, whatever the environment asked for.

    Args:
        context: initialised; without a node yet, or its participant exists already.

    Raises:
        MiddlewareError: the installed rmw is laid out otherwise.
    """
    with context.handle, _set(_discovery(context), _SYSTEM_DEFAULT):
        yield


@contextlib.contextmanager
def _set(discovery: Any, range_: int) -> Iterator[None]:
    before = discovery.range
    discovery.range = range_
    try:
        yield
    finally:
        discovery.range = before


def _discovery(context: Context) -> Any:
    address = abi.load().rmw_context(context.handle.pointer)
    found = _RmwContext.from_address(address)
    domain_id = context.get_domain_id()
    options = found.options
    laid_out_as_known = (
        found.identifier == options.identifier
        and (found.domain_id, options.domain_id) == (domain_id, domain_id)
        and found.instance_id == options.instance_id
        and 0 < options.discovery.range <= _SYSTEM_DEFAULT
        and bytes(options.allocator) == bytes(abi.load().default_allocator)
    )
    if not laid_out_as_known:
        raise MiddlewareError(
            f"cannot use the installed rcl {abi.rcl_version() or '(version unknown)'}: its "
            f"rmw_context_t is not laid out as rcl {abi.SUPPORTED_RCL_MAJOR}'s",
            hint=abi.INSTALL,
        )
    return options.discovery


_RMW = "rmw_fastrtps_cpp"


_REFUSED_PORT = "unique_network_request cannot be set along specific locators"
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
    participant. Of one in the same process another then lacks all its subscriptions for good, at
    times: Fast DDS 2.14 delivers endpoints by function calls there, and never again. It was 1 of
    560 processes with three participants that were made one after the other, and none of 8,000.
    """
    before = own_segments()
    yield
    if get_rmw_implementation_identifier() == _RMW:
        opened = not own_segments() <= before
        if opened or is_new or not before:
            _SHARED_MEMORY_OF[context] = opened


@contextlib.contextmanager
def once_participant_is_made(
    call: Callable[[int], None],
    *,
    names_by_udp: Callable[[], bool] = lambda: False,
    check_names: Callable[[], None] = lambda: None,
) -> Iterator[None]:
    """Call this when the next node's participant is there, and nothing of the node but its name.

    rclpy makes services, publishers and subscriptions of a node after rcl has made the node.

    Args:
        call: blocks the constructor of the first node that is made in the block, in its thread;
            given the address of its rcl_node_t.
        names_by_udp: its participant is made so (ParticipantSettings). rmw asks for a port for them
            alone first, which Fast DDS refuses with a message, and then without.
        check_names: raises MiddlewareError where they do not arrive. Then it is made again, for as
            long as a participant takes that just left to close its ports.
    """
    from lifecycle.middleware.fastdds.log import without_message  # it needs this module

    library = rclpy.node._rclpy  # noqa: SLF001 - there is no other moment
    made = library.Node

    def make(*args: Any, **kwargs: Any) -> Any:
        library.Node = made
        if names_by_udp():
            with without_message(_REFUSED_PORT):
                node = _made_with_names(lambda: made(*args, **kwargs), check_names)
        else:
            node = made(*args, **kwargs)
        call(node.pointer)
        return node

    library.Node = make
    try:
        yield
    finally:
        library.Node = made


_NAMES_WITHIN_S = 2.0
"""Others that start at the same time have half a pair of ports for a moment. 0.2 s were too little
once in 760 starts of ten nodes, on a busy machine."""

_NAMES_AGAIN_S = 0.02


def _made_with_names(make: Callable[[], Any], check_names: Callable[[], None]) -> Any:
    """Make a node, and again if names of other nodes would not arrive at its participant."""
    deadline = time.monotonic() + _NAMES_WITHIN_S
    while True:
        node = make()
        try:
            check_names()
        except MiddlewareError:
            node.destroy_when_not_in_use()
            if time.monotonic() >= deadline:
                raise
            try:
                check_names()
            except MiddlewareError:  # also without it: another socket of the process is meant
                return make()
            time.sleep(_NAMES_AGAIN_S)  # the kernel gives no event
        else:
            return node


_DRAFT = "lifecycle_draft_of_a_profile"


@contextlib.contextmanager
def participant_settings(context: Context, settings: ParticipantSettings) -> Iterator[None]:
    """Give the participant of `context` these settings: construct its first node in the block.

    Everything is as before after the block, and later participants get what they always got.
    Participants that other contexts get inside the block have the settings as well.

    Args:
        context: initialised, without a node yet; otherwise it has no effect.
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
        peers = None
        if settings.governs_discovery:
            stack.enter_context(system_default(context))
        elif settings.chooses_transports:
            peers = stack.enter_context(without_localhost(context))
        if settings.static_participants:
            # The participant's own endpoints, of the graph topic, are made with it.
            own = endpoint_profiles(settings.static_endpoints)
            stack.enter_context(with_endpoint_profiles(own))
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
        kinds = [family.kind for family in families(settings.urls)]
        before = {each.inode for each in open_sockets(kinds=kinds)}
        yield
        opened = [each for each in open_sockets(kinds=kinds) if each.inode not in before]
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
