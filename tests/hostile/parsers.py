"""Every reader of data that others write, each with a good document.

Owns: `READERS`, the one list of them, which property tests go through
(tests/unit/test_foreign_data.py).
"""

from __future__ import annotations

import asyncio
import dataclasses
import json
import os
from collections.abc import Callable
from pathlib import Path

from lifecycle import codec
from lifecycle.codec import from_json, to_json
from lifecycle.errors import LifecycleError
from lifecycle.graph.status import NodeStatus, NodeStatusError, encode
from lifecycle.graph.status import decode as decode_status
from lifecycle.manifest.diagnostics import Diagnostic, ManifestError, Position
from lifecycle.manifest.installed_types import installed_hash
from lifecycle.manifest.interface import read_interface
from lifecycle.manifest.loading import load
from lifecycle.node.host.control import Event
from lifecycle.plan.comparison import PlanNoticeError, notice_of
from lifecycle.plan.comparison import decode as decode_notice
from lifecycle.plan.comparison import encode as encode_notice
from lifecycle.programming.host import HostTool
from lifecycle.programming.http import load_settings
from lifecycle.programming.ledger import Ledger
from lifecycle.programming.nef import NefSettings
from lifecycle.programming.nft import NftTarget
from lifecycle.programming.target import Means, ProgrammingError
from lifecycle.run_directory import read_record
from lifecycle.supervisor.control.protocol import Answer
from lifecycle.supervisor.core.state import Order
from lifecycle.verify.observation import ConfigurationError, decode_configuration
from lifecycle.verify.verdict import Stage
from tests.unit.programming.fakes import FakeTool, failed, printed
from tests.unit.programming.samples import nef_settings
from tests.unit.verify.perfect import perfect
from tests.unit.verify.test_verify_rules import PLAN


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reader:
    """One reader of foreign data.

    Attributes:
        good: what it is made for.
        read: reads bytes; a folder of its own is there to put them into a file.
        errors: what it may raise; anything else is unhandled.
    """

    good: bytes
    read: Callable[[bytes, Path], object]
    errors: tuple[type[Exception], ...]


def _text(data: bytes) -> str:
    return data.decode(errors="replace")


def _file(name: str, read: Callable[[Path], object]) -> Callable[[bytes, Path], object]:
    def in_file(data: bytes, folder: Path) -> object:
        path = folder / name
        path.write_bytes(data)
        return read(path)

    return in_file


def _installed(data: bytes, folder: Path) -> object:
    for name in ("share/ament_index/resource_index/rosidl_interfaces/a", "share/a/msg/B.json"):
        (folder / name).parent.mkdir(parents=True)
        (folder / name).write_bytes(data)
    return installed_hash("a/msg/B", [folder])


def _nodl(path: Path) -> object:
    at = Position(file="m.lifecycle.yaml", line=1, column=1)
    found: list[Diagnostic] = []
    return read_interface(
        f"local://{path.name}", base=path.parent, at=at, environment=os.environ, found=found
    )


def _ledger(path: Path) -> object:
    return Ledger(path.parent, "robot").read()


def _qdiscs(data: bytes, _: Path) -> object:
    from lifecycle.programming.tc import qdiscs

    return asyncio.run(qdiscs(FakeTool(("tc", printed(_text(data)))), doing="list qdiscs"))


def _nft(data: bytes, folder: Path) -> object:
    tool = FakeTool(("nft", printed(_text(data))))
    return asyncio.run(NftTarget(None, Means(Ledger(folder, "robot")), tool).plan([]))


def _printed(data: bytes, folder: Path) -> object:
    (folder / "out").write_bytes(data)
    return asyncio.run(HostTool().run(["cat", str(folder / "out")]))


def _tc(data: bytes, folder: Path) -> object:
    from lifecycle.programming.tc import TcSettings, TcTarget

    tool = FakeTool(
        ("tc", printed(_text(data))),
        ("nft list", failed("Error: No such file or directory")),
    )
    settings = TcSettings(device="eth0", link_kbit=20_000)
    return asyncio.run(TcTarget(settings, Means(Ledger(folder, "robot")), tool).plan([]))


_SEEN = perfect(PLAN, Stage.ACTIVE)
_CONFIGURATION = codec.to_json(_SEEN.configurations[0])
_NAME = json.loads(_CONFIGURATION)["name"]
_QDISCS = json.dumps(
    [{"dev": "eth0", "kind": "htb", "handle": "1f10:", "root": True, "options": {"r2q": 10}}]
).encode()
_NODL = b"""nodl_version: 2
node:
  name: talker
publishers:
  - {name: chatter, type: std_msgs/msg/String, qos: {history: KEEP_LAST, depth: 1}}
parameters:
  rate: {type: double, default_value: 1.0}
"""
_HASHES = json.dumps(
    {"type_hashes": [{"type_name": "a/msg/B", "hash_string": "RIHS01_ab"}]}
).encode()
_MANIFEST = b"""manifest_version: 1
system: robot
nodes:
  talker:
    run: {python: "x:Talker"}
    interface:
      publishers: [{name: chatter, type: std_msgs/msg/String, qos: {depth: 3}}]
    flows: {publishers: {chatter: {unique: strictly_required, dscp: EF}}}
links: []
"""

READERS: dict[str, Reader] = {
    "graph message": Reader(
        good=encode(NodeStatus(node="/a", instance="1", state="active", checksum="ab")),
        read=lambda data, _: decode_status(data),
        errors=(NodeStatusError,),
    ),
    "configuration report": Reader(
        good=_CONFIGURATION,
        read=lambda data, _: decode_configuration(_text(data), _NAME),
        errors=(ConfigurationError,),
    ),
    "plan notice": Reader(
        good=encode_notice(notice_of(PLAN, run="r", host="h", machines=("local",))).encode(),
        read=lambda data, _: decode_notice(_text(data)),
        errors=(PlanNoticeError,),
    ),
    "control question": Reader(
        good=b'{"ask":"restart","node":"talker","plan":null}',
        read=lambda data, _: from_json(data, Order),
        errors=(ValueError,),
    ),
    "control answer": Reader(
        good=to_json(Answer(exit_code=0, error="x", differences=("a",))),
        read=lambda data, _: from_json(data, Answer),
        errors=(ValueError,),
    ),
    "host event": Reader(
        good=b'{"id":1,"kind":"state","node":"/a","state":"active","connected":true}',
        read=lambda data, _: from_json(data, Event),
        errors=(ValueError,),
    ),
    "run record": Reader(
        good=b'{"run_id":"a","boot_id":"b","supervisor":'
        b'{"name":"supervisor","pid":1,"start_ticks":1}}',
        read=_file("record.json", lambda path: read_record(path.parent)),
        errors=(),
    ),
    "ledger": Reader(
        good=b'{"version":1,"system":"robot","targets":[{"target":"nft","scope":"t"}]}',
        read=_file("programmed.json", _ledger),
        errors=(ProgrammingError,),
    ),
    "settings of a server": Reader(
        good=json.dumps({"nef": nef_settings("https://nef.test")}).encode(),
        read=_file("targets.json", lambda path: load_settings(str(path), "nef", NefSettings)),
        errors=(LifecycleError,),
    ),
    "nft listing": Reader(
        good=b'table inet flowqos_a {\n comment "managed-by=lifecycle"\n}',
        read=_nft,
        errors=(LifecycleError,),
    ),
    "qdiscs of tc": Reader(good=_QDISCS, read=_qdiscs, errors=(ProgrammingError,)),
    "root qdisc of a device": Reader(
        good=_QDISCS.replace(b"1f10:", b"0:"), read=_tc, errors=(LifecycleError,)
    ),
    "output of a tool": Reader(good=b"qdisc htb 1f10:", read=_printed, errors=()),
    "NoDL document": Reader(good=_NODL, read=_file("a.nodl.yaml", _nodl), errors=(ManifestError,)),
    "installed type hashes": Reader(good=_HASHES, read=_installed, errors=()),
    "manifest": Reader(
        good=_MANIFEST, read=_file("m.lifecycle.yaml", load), errors=(ManifestError,)
    ),
}
