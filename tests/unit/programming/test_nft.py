"""nftables rulesets: whole outputs, accepted by nft itself, replaced and removed as a whole."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.errors import UsageError
from lifecycle.network.dscp import MAX_DSCP
from lifecycle.programming.host import MAX_COMMENT_BYTES, table_name
from lifecycle.programming.nft import NftTarget
from lifecycle.programming.rules import FlowRule
from tests.unit.programming.flow_samples import (
    EXPECTED,
    LEFT_OUT,
    RULES,
    VIDEO,
    in_a_network_namespace,
)
from tests.unit.programming.samples import exported


def ruleset(*rules: FlowRule, left_out: tuple[str, ...] = ()) -> str:
    return exported(NftTarget, None, rules, left_out=left_out)


def test_a_ruleset_is_one_table_that_is_replaced_in_one_transaction() -> None:
    made = ruleset(*RULES, left_out=LEFT_OUT)
    assert made == (EXPECTED / "teleop.nft").read_text(encoding="utf-8")


def test_nft_knows_how_every_dscp_is_spelled(tmp_path: Path) -> None:
    rules = [
        replace(VIDEO, dscp=dscp, destination_port=1000 + dscp) for dscp in range(MAX_DSCP + 1)
    ]
    file = tmp_path / "all.nft"
    file.write_text(ruleset(*rules), encoding="utf-8")
    script = f"nft -f {file} && nft -nn list table inet flowqos_teleop"
    done = in_a_network_namespace("sh", "-c", script, needs="nft")
    assert (done.returncode, done.stderr) == (0, "")
    listed = re.findall(r'ip dscp set (\S+) counter packets 0 bytes 0 comment "(.*)"', done.stdout)
    spelled = {int(value, 0): comment for value, comment in listed}
    assert sorted(spelled) == list(range(MAX_DSCP + 1))
    assert all(f"DSCP {dscp} = " in comment for dscp, comment in spelled.items())


def test_without_rules_the_table_is_there_and_empty() -> None:
    assert ruleset().splitlines()[3:] == [
        "add table inet flowqos_teleop",
        "delete table inet flowqos_teleop",
        "table inet flowqos_teleop {",
        '  comment "managed-by=lifecycle"',
        "  chain post {",
        "    type filter hook postrouting priority mangle; policy accept;",
        "  }",
        "}",
    ]


def test_a_comment_that_nftables_would_not_keep_is_cut() -> None:
    long = replace(VIDEO, names=((f'/{"é" * 100}"', "/robot/camera", "/viewer"),))
    (comment,) = re.findall(r'counter comment "(.*)"', ruleset(long))
    assert comment == f"EF = DSCP 46 = TOS 184 (0xb8): /{'é' * 46}..."
    assert len(comment.encode()) <= MAX_COMMENT_BYTES


@pytest.mark.parametrize("system", ["", "1a", "a b", "a;b", "a}b", "é"])
def test_a_name_that_no_manifest_may_have_makes_no_table(system: str) -> None:
    message = (
        f"cannot name an nftables table after system {system!r}; "
        "use letters, digits, '_' and '-', a letter first"
    )
    with pytest.raises(UsageError, match=f"^{re.escape(message)}$"):
        table_name(system)
