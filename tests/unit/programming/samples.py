"""Rules, reports, ledgers and settings files for the tests of programming."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from lifecycle.network.nfe import TransportProtocol
from lifecycle.programming.ledger import Ledger
from lifecycle.programming.rules import FlowRule, RuleSet
from lifecycle.programming.target import Means, Target
from lifecycle.run_directory import private_directory


def rule(
    topic: str = "/video",
    port: int = 17900,
    *,
    source: str = "10.45.0.3",
    destination: str = "198.51.100.7",
    destination_port: int = 17910,
    dscp: int | None = 46,
    five_qi: int | None = 85,
) -> FlowRule:
    """A verified flow from a device to a server."""
    return FlowRule(
        key=f"{topic} /camera → /viewer udp {destination}",
        names=((topic, "/camera", "/viewer"),),
        transport_protocol=TransportProtocol.UDP,
        source_address=source,
        source_port=port,
        destination_address=destination,
        destination_port=destination_port,
        dscp=dscp,
        five_qi=five_qi,
    )


def ledger_in(path: Path, system: str = "robot") -> Ledger:
    """A ledger of its own, with its directory made."""
    directory = path / "run" / f"{system}@7"
    for each in (directory.parent, directory):
        private_directory(each)
    return Ledger(directory, system)


def exported(
    kind: type[Target],
    settings: object,
    rules: Iterable[FlowRule],
    system: str = "teleop",
    left_out: Iterable[str] = (),
) -> str:
    """What a target exports of rules."""
    target = kind(settings, Means(Ledger(Path("unused"), system)))
    return target.export(RuleSet(rules=tuple(rules), left_out=tuple(left_out)))


def settings_file(path: Path, **targets: object) -> str:
    """A settings file."""
    file = path / "targets.json"
    file.write_text(json.dumps(targets), encoding="utf-8")
    return str(file)


def nef_settings(url: str, **rest: object) -> dict[str, object]:
    """Settings of a NEF whose devices are 10.45.0.0/16."""
    return {
        "url": url,
        "scs_as_id": "robots",
        "notification_destination": "https://robots.example.net/events",
        "devices": ["10.45.0.0/16"],
        "qos_references": {"85": "robot-control"},
        "token": {"env": "TEST_TOKEN"},
        **rest,
    }


def camara_settings(url: str, **rest: object) -> dict[str, object]:
    """Settings of a CAMARA interface whose devices are 10.45.0.0/16."""
    return {
        "url": url,
        "devices": ["10.45.0.0/16"],
        "qos_profiles": {"85": "QOS_E"},
        "token": {"env": "TEST_TOKEN"},
        **rest,
    }
