"""Participants of Fast DDS made from a profile: what rclpy and the environment cannot say.

Owns: the eight public functions of Fast DDS that are called in a process of ours, and the only file
that may call any: ctypes finds them by their mangled names, which are checked when it is loaded.
And the only moment at which settings can be applied, when the first node of a context is
constructed; whether a participant has shared memory; and what a library that is not known costs.

Profiles are read from the environment once per process, and rmw_fastrtps gives every participant
the factory's default QoS. So that default is changed for one participant at a time;
DomainParticipantQos objects stay opaque, made and destroyed by their own constructor and
destructor.

For LOCALHOST rmw_fastrtps adds a shared memory and a UDP transport to whatever a profile says
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
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from msgspec.structs import replace
from rclpy.context import Context
from rclpy.node import Node
from rclpy.utilities import get_default_context, get_rmw_implementation_identifier

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.profiles import (
    DISCOVERY_SERVER_VARIABLE,
    PEERS_VARIABLE,
    RANGE_VARIABLE,
    ParticipantSettings,
    default_profile,
    endpoint_profiles,
    profile,
)
from lifecycle.middleware.fastdds.sockets import check_free, check_host
from lifecycle.middleware.process.shared_memory import own_segments
from lifecycle.middleware.rcl import abi
from lifecycle.middleware.versions import INSTALL, KNOWN_FAST_DDS, installed
from lifecycle.network.medium import RMW_DISCOVERY, TRANSPORTS_VARIABLE
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.model import PlannedNode, PlannedParticipant, StaticEndpoint

RMW = "rmw_fastrtps_cpp"

_DDS = "8eprosima7fastdds3dds"
_FACTORY = f"{_DDS}24DomainParticipantFactory"
_QOS = f"{_DDS}20DomainParticipantQos"
_STRING = "NSt7__cxx1112basic_stringIcSt11char_traitsIcESaIcEEE"
_QOS_ROOM_BYTES = 16384
"""Thirteen times sizeof(DomainParticipantQos) in 2.14.5."""
_OK = 0
_DRAFT = "lifecycle_draft_of_a_profile"
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


def _fast_dds_refusal() -> str:
    """Return why the loaded Fast DDS is not used beyond what rmw does; empty if it is, or none."""
    if get_rmw_implementation_identifier() == RMW:
        try:
            _library()
        except MiddlewareError:
            return f"the loaded Fast DDS is not known (known: {KNOWN_FAST_DDS})"
    return ""


def _load_endpoint_profiles(endpoints: Sequence[StaticEndpoint]) -> None:
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

    A process that is killed while it holds the mutex of a port there blocks each process that sends
    to it for 10 s at a time. It is chosen where these settings, a profile or the environment say
    what transports there are, and by another RMW.
    """
    if get_rmw_implementation_identifier() != RMW or _fast_dds_refusal():
        return settings
    if settings or super_client:
        connections = replace(settings.connections, super_client=super_client)
        return replace(settings, connections=connections)
    with contextlib.suppress(MiddlewareError):  # Fast DDS ignores such a profile
        base = default_profile()
        if not (os.environ.get(TRANSPORTS_VARIABLE) or (base and base.chosen_transports)):
            return replace(settings, transports=(RMW_DISCOVERY,), announces_often=True)
    return settings


def _localhost_peers() -> tuple[str, ...] | None:
    """Return the static peers where the environment asks for LOCALHOST; None if it does not."""
    if os.environ.get(RANGE_VARIABLE) != "LOCALHOST":
        return None
    return tuple(filter(None, os.environ.get(PEERS_VARIABLE, "").split(";")))


def initialised(
    settings: ParticipantSettings,
    domain_id: int | None,
    *,
    context: Context | None = None,
    args: Sequence[str] = (),
    **options: Any,
) -> Context:
    """Initialise a context whose participant is to have these settings, by default the process's.

    rcl reads the range from the environment then (rcl/discovery_options.h): rmw leaves discovery to
    the participant's profile where that says all. Other options are those of rclpy's `init`.
    """
    made = context or get_default_context()
    before = os.environ.get(RANGE_VARIABLE)
    is_left = settings.chooses_transports and before == "LOCALHOST"
    if settings.governs_discovery or is_left:
        os.environ[RANGE_VARIABLE] = "SYSTEM_DEFAULT"
    try:
        made.init(args=[*args], domain_id=domain_id, **options)
    finally:
        os.environ.pop(RANGE_VARIABLE, None)
        if before is not None:
            os.environ[RANGE_VARIABLE] = before
    return made


_SHARED_MEMORY_OF: weakref.WeakKeyDictionary[Context, bool] = weakref.WeakKeyDictionary()


def has_shared_memory(node: Node) -> bool:
    """Return whether the participant of `node` has a shared memory transport.

    Of one that was made otherwise than by this package it is what the process has.
    """
    if node.context not in _SHARED_MEMORY_OF:
        _SHARED_MEMORY_OF[node.context] = bool(own_segments())
    return _SHARED_MEMORY_OF[node.context]


@contextlib.contextmanager
def participant_settings(context: Context, settings: ParticipantSettings) -> Iterator[None]:
    """Give the participant of `context` these settings: construct its first node in the block.

    Participants that other contexts get inside the block have the settings as well. Empty ones
    change nothing, and need no Fast DDS.

    Args:
        context: made by `initialised`; without effect if it has a node already.
        settings: of the participant.

    Raises:
        MiddlewareError: another RMW than rmw_fastrtps_cpp, an unknown version of it, a default
            profile that already chooses transports, or URLs with an address that this host has not,
            or a port that is taken; nothing was changed.
    """
    before = own_segments()
    with _applied(context, settings) if settings else contextlib.nullcontext():
        yield
    # Not by a subscription, whose list has it: one that is announced and taken back while others
    # discover the participant may cost another participant of the process its subscriptions.
    opened = not own_segments() <= before
    # Of the default context others may have made the participant, with what was there before.
    is_ours = context is not get_default_context() or not before
    if opened or is_ours:
        _SHARED_MEMORY_OF.setdefault(context, opened)


@contextlib.contextmanager
def _applied(context: Context, settings: ParticipantSettings) -> Iterator[None]:
    """Have participants that are created inside the block made from a profile.

    One block at a time: other threads that use this function wait; participants that they create
    otherwise meanwhile get this profile too. Fast DDS keeps each profile for good, so equal ones
    are loaded once.
    """
    rmw = get_rmw_implementation_identifier()
    if rmw != RMW:
        raise MiddlewareError(
            f"cannot choose the transports of a participant with RMW {rmw!r}",
            hint=f"set RMW_IMPLEMENTATION={RMW}",
        )
    if settings.urls:
        server = os.environ.get(DISCOVERY_SERVER_VARIABLE, "")
        if server and not any(url.server for url in settings.urls):
            raise MiddlewareError(
                f"cannot connect by {str(settings.urls[0])!r}: {DISCOVERY_SERVER_VARIABLE}="
                f"{server!r} makes every participant a client of that server",
                hint=f"unset {DISCOVERY_SERVER_VARIABLE}, or name the server in the URL, "
                "server=ADDRESS:PORT",
            )
        check_host(settings.urls)
    _load_endpoint_profiles(settings.static_endpoints)
    is_open = settings.chooses_transports and not settings.governs_discovery
    xml = profile(
        _DRAFT,
        settings,
        base=default_profile(),
        localhost_peers=_localhost_peers() if is_open else None,
        domain_id=context.get_domain_id(),
    )
    dds = _library()
    name = f"lifecycle_{hashlib.sha256(xml.encode()).hexdigest()[:16]}"
    data = name.encode()
    text = _String(data=data, size=len(data), capacity=len(data))
    with dds.lock, dds.copied_default() as before, dds.copied_default() as wanted:
        # Under the lock: no other participant of ours is made in between.
        check_free(settings.urls)
        result = _OK if name in dds.loaded else dds.load(xml.replace(_DRAFT, name))
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


def unknown_versions() -> str:
    """Return which of the libraries here are not known, and what that costs; empty if all are."""
    unknown = []
    if refusal := abi.refusal():
        unknown.append(
            f"{refusal}: nodes, endpoints and states are "
            "verified; network flow endpoints cannot be read or made unique, so that what requires "
            "them is unverifiable or refused"
        )
    if refusal := _fast_dds_refusal():
        unknown.append(
            f"{refusal}: participants get no connections, transports or DSCP of their own"
        )
    return "; ".join(unknown)


def refuse_unsupported(nodes: Iterable[PlannedNode]) -> None:
    """Refuse nodes in hosts of ours that the libraries loaded here could not connect."""
    rcl, fast_dds = abi.refusal(), _fast_dds_refusal()
    for node in nodes:
        for each in node.endpoints if rcl else ():
            if each.unique is UniqueRequirement.STRICTLY_REQUIRED:
                at = each.at or node.at
                raise MiddlewareError(
                    f"{at.spelled}: cannot give {each.kind.noun} {each.name!r} of "
                    f"{node.key!r} a flow of its own ('unique: strictly_required'): {rcl}",
                    hint=f"use 'unique: optionally_required', or {INSTALL}",
                )
        carrying: list[PlannedNode | PlannedParticipant] = [node, *node.participants]
        for made in carrying if fast_dds else ():
            if ParticipantSettings.of(made):
                key = "'connections', 'transport' or 'discovery' as declared"
                if isinstance(made, PlannedParticipant):
                    key = f"'transport' or 'connections' as declared ({made.reason})"
                raise MiddlewareError(
                    f"{node.at.spelled}: cannot make a participant of {node.key!r} with {key}: "
                    f"{fast_dds}",
                    hint=INSTALL,
                )
