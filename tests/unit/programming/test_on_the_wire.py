"""What the rulesets do to real packets, on the loopback interface of a namespace of their own."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest

from lifecycle.programming.nft import NftTarget
from lifecycle.programming.tc import TcMatch, TcSettings, TcTarget
from tests.unit.programming.flow_samples import in_a_network_namespace, rule
from tests.unit.programming.samples import exported

RULES = (
    rule("/video", "127.0.0.1:17900", "127.0.0.1:17910", dscp=46),
    rule("/bulk", "*:17901", "127.0.0.1:17911", dscp=1),
    rule("/lidar", "::1:17904", "::1:17914", dscp=45, flow_label=0x12345),
)
ECT_0 = 2
"""ECN-capable transport (RFC 3168): two bits that no rule may touch."""

SENDER = f"""
import json, socket
# The names that Python's socket module has only on some platforms.
RECVTOS, RECVTCLASS, TCLASS = 13, 66, 67
seen = {{}}
for host, sends, takes in (
    ("127.0.0.1", 17900, 17910), ("127.0.0.1", 17901, 17911), ("::1", 17904, 17914),
    ("127.0.0.1", 17900, 17919), ("::1", 17904, 17919),
):
    v6 = ":" in host
    family, level = (socket.AF_INET6, 41) if v6 else (socket.AF_INET, 0)
    one, other = (socket.socket(family, socket.SOCK_DGRAM) for _ in range(2))
    with one as a, other as b:
        a.bind((host, sends))
        b.bind((host, takes))
        a.setsockopt(level, TCLASS if v6 else 1, {ECT_0})
        b.setsockopt(level, RECVTCLASS if v6 else RECVTOS, 1)
        b.settimeout(5)
        a.sendto(b"x" * 100, (host, takes))
        data, ancillary, flags, address = b.recvmsg(200, 100)
        seen[f"{{host}} {{takes}}"] = ancillary[0][2][0]
print(json.dumps(seen))
"""


def run(script: str, needs: str) -> str:
    done = in_a_network_namespace("sh", "-c", f"ip link set lo up\n{script}", needs=needs)
    if done.returncode == 77:
        pytest.skip(f"this kernel lacks something: {done.stderr.strip()}")
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_marked_flows_carry_their_dscp_keep_their_ecn_and_others_stay_as_they_are(
    tmp_path: Path,
) -> None:
    (tmp_path / "nft").write_text(exported(NftTarget, None, RULES, "wire"), encoding="utf-8")
    (tmp_path / "send.py").write_text(SENDER, encoding="utf-8")
    out = run(
        f"""set -e
nft -f {tmp_path}/nft
{sys.executable} {tmp_path}/send.py
nft list chain inet flowqos_wire post""",
        "nft",
    )
    seen, _, chain = out.partition("\n")
    assert json.loads(seen) == {
        "127.0.0.1 17910": 46 << 2 | ECT_0,
        "127.0.0.1 17911": 1 << 2 | ECT_0,
        "::1 17914": 45 << 2 | ECT_0,
        "127.0.0.1 17919": ECT_0,
        "::1 17919": ECT_0,
    }
    assert re.findall(r'packets (\d+) bytes \d+ comment "(.*?): /', chain) == [
        ("1", "EF = DSCP 46 = TOS 184 (0xb8)"),
        ("1", "LE = DSCP 1 = TOS 4 (0x04)"),
        ("1", "NQB = DSCP 45 = TOS 180 (0xb4)"),
        ("1", "flow label 0x12345"),
    ]


@pytest.mark.parametrize("match", TcMatch)
def test_each_flow_goes_to_its_class_and_the_rest_to_the_rest(
    tmp_path: Path, match: TcMatch
) -> None:
    settings = TcSettings(device="lo", link_kbit=100_000, match=match)
    (tmp_path / "tc").write_text(exported(TcTarget, settings, RULES, "wire"), encoding="utf-8")
    (tmp_path / "nft").write_text(exported(NftTarget, None, RULES, "wire"), encoding="utf-8")
    (tmp_path / "send.py").write_text(SENDER, encoding="utf-8")
    # Marks are set before packets are queued, so nft and tc work together on one host.
    out = run(
        f"""tc qdisc add dev lo root handle 1: htb || exit 77
set -e
tc qdisc del dev lo root
{f"nft -f {tmp_path}/nft" if match is TcMatch.MARK else ":"}
sh {tmp_path}/tc
{sys.executable} {tmp_path}/send.py > /dev/null
tc -s class show dev lo""",
        "nft",
    )
    sent = re.findall(r"class htb 1f10:(\w+) parent .*?\n Sent \d+ bytes (\d+) pkt", out)
    counts = {minor: int(packets) for minor, packets in sent}
    assert {minor: counts[minor] for minor in ("12e", "101", "12d")} == {
        "12e": 1,
        "101": 1,
        "12d": 1,
    }
    assert counts["fff"] >= 2
