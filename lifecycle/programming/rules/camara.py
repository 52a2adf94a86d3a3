"""Flow rules as bodies of CAMARA QualityOnDemand sessions.

Owns: our own model of CreateSession (QualityOnDemand 1.1.0) and how a flow becomes one. Pure.

A session has no protocol and no direction: it treats what goes between a device's ports and a
server's ports, both ways, UDP and TCP alike.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

from lifecycle import dataclasses
from lifecycle.programming.rules.mobile import (
    DeviceEnd,
    Requests,
    class_name,
    document,
    parse_devices,
    requests_of,
)
from lifecycle.programming.rules.packet_filter import (
    PortRange,
    check_address,
    check_port,
    check_same_family,
)
from lifecycle.programming.rules.rules import FlowRule, LeftOut

API_VERSION = "1.1.0"

_PROFILE = re.compile(r"[a-zA-Z0-9_.-]{3,256}")
_SINK = re.compile(r"https://[^\s/]+\S*")
_MAX_INT32 = 2**31 - 1


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class QodSession:
    """CreateSession, the part of it that we ask with.

    Attributes:
        device: private address of the device, the one that its packets carry.
        public_device: address that the outside sees; equal to `device` where nothing translates.
            Empty for IPv6, and `device` too where an access token names the device.
        server: address of the other end.
        device_ports: on the device.
        server_ports: on the other end.
        qos_profile: name of a profile that the provider offers, 3–256 of letters, digits and _.-
        duration_s: 1–2147483647; the provider may grant less.
        sink: https URL that the network reports to; empty for none.
        public_port: 1–65535, that the outside sees the device at, where several devices share its
            public address; it then takes the place of the private address. 0 for none.
    """

    device: str
    public_device: str
    server: str
    device_ports: tuple[PortRange, ...]
    server_ports: tuple[PortRange, ...]
    qos_profile: str
    duration_s: int
    sink: str = ""
    public_port: int = 0

    def __post_init__(self) -> None:
        check_address(self.server)
        if self.device:
            check_same_family(self.device, self.server)
        if bool(self.public_device) != (
            bool(self.device) and check_address(self.server).version == 4
        ):
            raise ValueError(
                f"cannot name device {self.device!r} by public address {self.public_device!r}; "
                f"an IPv4 device needs one, an IPv6 device none"
            )
        if self.public_device and check_address(self.public_device).version != 4:
            raise ValueError(f"cannot use public address {self.public_device}; use an IPv4 address")
        if self.public_port:
            check_port(self.public_port)
        if not (self.device_ports and self.server_ports):
            raise ValueError("cannot ask for no port; a flow has a port at each end")
        _check_profile(self.qos_profile)
        _check_duration(self.duration_s)
        _check_sink(self.sink)

    def body(self) -> dict[str, object]:
        """Return the JSON object for POST /sessions."""
        ipv6 = check_address(self.server).version == 6
        device: dict[str, object] = {"ipv6Address": self.device}
        if not ipv6:
            other = (
                {"publicPort": self.public_port}
                if self.public_port
                else {"privateAddress": self.device}
            )
            device = {"ipv4Address": {"publicAddress": self.public_device, **other}}
        return {
            **({"device": device} if self.device else {}),
            "applicationServer": {"ipv6Address" if ipv6 else "ipv4Address": self.server},
            "devicePorts": _ports(self.device_ports),
            "applicationServerPorts": _ports(self.server_ports),
            "qosProfile": self.qos_profile,
            **({"sink": self.sink} if self.sink else {}),
            "duration": self.duration_s,
        }


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class CamaraSettings:
    """What the flows themselves do not say.

    Attributes:
        devices: addresses or networks of the network's devices, `10.45.0.0/16`, or `source` or
            `destination` for that end of every flow.
        qos_profiles: the provider's names of profiles, by 5QI.
        default_qos_profile: for flows whose 5QI is not named; empty leaves them out.
        duration_s: 1–2147483647; sessions are renewed, or they expire.
        sink: https URL that the network reports to; empty for none.
        public_address: of the one device, where a translation hides it and `public_addresses`
            does not name it; empty if there is none.
        public_addresses: of devices behind a translation, by private address.
        public_port: 1–65535, that the outside sees the one device at; 0 for none.
        device_by_token: the access token names the device (three-legged), so that the body must
            not: a server answers 422 UNNECESSARY_IDENTIFIER otherwise.
    """

    devices: tuple[str, ...]
    qos_profiles: Mapping[int, str] = dataclasses.field(default_factory=dict)
    default_qos_profile: str = ""
    duration_s: int = 3600
    sink: str = ""
    public_addresses: Mapping[str, str] = dataclasses.field(default_factory=dict)
    device_by_token: bool = False
    public_address: str = ""
    public_port: int = 0

    def __post_init__(self) -> None:
        parse_devices(self.devices)
        for profile in (*self.qos_profiles.values(), *filter(None, [self.default_qos_profile])):
            _check_profile(profile)
        _check_duration(self.duration_s)
        _check_sink(self.sink)


def camara_sessions(rules: Iterable[FlowRule], settings: CamaraSettings) -> Requests[QodSession]:
    """Return one session per flow and device, and the flows that cannot be asked for."""
    return requests_of(
        rules,
        parse_devices(settings.devices),
        lambda rule, end: _session(rule, end, settings),
    )


def render_camara(
    rules: Iterable[FlowRule], settings: CamaraSettings, *, left_out: Iterable[LeftOut] = ()
) -> str:
    """Return the sessions as JSON: `{"sessions": [{key, flow, asks, body}], …}`."""
    return document("sessions", camara_sessions(rules, settings), left_out)


def _session(rule: FlowRule, end: DeviceEnd, settings: CamaraSettings) -> QodSession:
    ipv4 = check_address(end.device).version == 4
    device = "" if settings.device_by_token else end.device
    public = settings.public_addresses.get(end.device, settings.public_address or end.device)
    return QodSession(
        device=device,
        public_device=public if device and ipv4 else "",
        server=end.server,
        device_ports=(PortRange(low=end.device_port, high=end.device_port),),
        server_ports=(PortRange(low=end.server_port, high=end.server_port),),
        qos_profile=class_name(
            rule, settings.qos_profiles, settings.default_qos_profile, setting="qos_profiles"
        ),
        duration_s=settings.duration_s,
        sink=settings.sink,
        public_port=settings.public_port if device and ipv4 else 0,
    )


def _ports(ports: Iterable[PortRange]) -> dict[str, object]:
    """PortsSpec: single ports and ranges are apart, and neither list may be empty."""
    every = tuple(ports)
    single = [each.low for each in every if each.low == each.high]
    ranges = [{"from": each.low, "to": each.high} for each in every if each.low != each.high]
    return {**({"ports": single} if single else {}), **({"ranges": ranges} if ranges else {})}


def _check_profile(profile: str) -> None:
    if not _PROFILE.fullmatch(profile):
        raise ValueError(
            f"cannot use qosProfile {profile!r}; "
            f"use 3 to 256 letters, digits, '_', '.' and '-', such as QOS_E"
        )


def _check_duration(duration_s: int) -> None:
    if not 1 <= duration_s <= _MAX_INT32:
        raise ValueError(f"cannot use a duration of {duration_s} s; use 1 to {_MAX_INT32}")


def _check_sink(sink: str) -> None:
    if sink and not _SINK.fullmatch(sink):
        raise ValueError(f"cannot use sink {sink!r}; use an https URL, or none")
