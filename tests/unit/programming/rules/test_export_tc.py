"""Lines for tc: whole batches, accepted by tc twice, and classes that fit their link."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from lifecycle.network.dscp import MAX_DSCP
from lifecycle.programming.rules.tc import (
    MAX_FILTERS,
    TcFeatures,
    TcMatch,
    TcSettings,
    class_of,
    classes_of,
    divide,
    render_tc,
    render_tc_removal,
    tc_filters,
)
from tests.unit.programming.rules.samples import (
    EXPECTED,
    LEFT_OUT,
    RULES,
    VIDEO,
    in_a_network_namespace,
)

DIGEST = "0123456789abcdef"
U32 = TcFeatures(classifiers=("u32",))


def settings(**rest: object) -> TcSettings:
    return TcSettings(device="eth0", **{"link_kbit": 20_000, **rest})


CASES = {
    "htb_flower": settings(guaranteed_kbit={"ef": 4000}),
    "htb_u32": settings(features=U32),
    "htb_u32_mark": settings(features=U32, match=TcMatch.MARK),
    "prio_flower": settings(link_kbit=None),
}


def cannot(message: str) -> object:
    return pytest.raises(ValueError, match=f"^{re.escape(message)}$")


def batch(case: TcSettings, *, with_qdisc: bool = True) -> str:
    return render_tc(
        RULES, case, system="teleop", digest=DIGEST, with_qdisc=with_qdisc, left_out=LEFT_OUT
    )


@pytest.mark.parametrize("name", CASES)
def test_a_batch_makes_a_class_per_dscp_or_5qi_and_a_filter_per_flow(name: str) -> None:
    assert batch(CASES[name]) == (EXPECTED / f"{name}.tc").read_text(encoding="utf-8")


def test_a_second_batch_differs_in_the_qdisc_only() -> None:
    first, second = (
        batch(CASES["htb_u32"], with_qdisc=each).splitlines() for each in (True, False)
    )
    assert [line for line in first if line not in second] == [
        "qdisc add dev eth0 root handle 1f10: htb default 0xfff"
    ]
    assert [line for line in second if line not in first] == []
    bands = CASES["prio_flower"]
    assert "qdisc replace dev eth0 root handle 1f10: prio bands 6" in batch(bands, with_qdisc=False)


@pytest.mark.parametrize("match", TcMatch)
def test_tc_takes_the_batch_twice_and_removes_it_whole(tmp_path: Path, match: TcMatch) -> None:
    case = TcSettings(device="lo", link_kbit=20_000, match=match, features=U32)
    (tmp_path / "first").write_text(batch(case), encoding="utf-8")
    (tmp_path / "again").write_text(batch(case, with_qdisc=False), encoding="utf-8")
    (tmp_path / "gone").write_text(render_tc_removal("lo"), encoding="utf-8")
    drop = "\n".join(each.removal for each in tc_filters(RULES, case)) + "\n"
    (tmp_path / "drop").write_text(drop, encoding="utf-8")
    script = f"""cd {tmp_path}
tc qdisc add dev lo root handle 1: htb || exit 77
tc filter add dev lo parent 1: protocol ip u32 match u32 0 0 || exit 77
set -e
tc qdisc del dev lo root
tc -batch first; tc filter show dev lo > once; tc class show dev lo >> once
tc -batch again; tc filter show dev lo > twice; tc class show dev lo >> twice
tc -batch drop; tc filter show dev lo > dropped
tc -batch gone; tc qdisc show dev lo > shown
if tc -batch gone 2>&1; then exit 1; fi"""
    done = in_a_network_namespace("sh", "-c", script, needs="tc")
    if done.returncode == 77:
        pytest.skip(f"this kernel has no htb or no u32: {done.stderr.strip()}")
    assert done.returncode == 0, done.stderr
    once = (tmp_path / "once").read_text(encoding="utf-8")
    assert once == (tmp_path / "twice").read_text(encoding="utf-8")
    assert once.count("flowid") == len(tc_filters(RULES, case)) + 2
    # Only the two that hold the first places are left.
    assert (tmp_path / "dropped").read_text(encoding="utf-8").count("flowid") == 2
    assert "1f10:" not in (tmp_path / "shown").read_text(encoding="utf-8")


def test_a_removal_names_our_handle_so_that_nobody_elses_qdisc_goes() -> None:
    assert render_tc_removal("eth0") == "qdisc del dev eth0 root handle 1f10:\n"


def test_u32_looks_at_ports_of_first_fragments_without_options_only() -> None:
    (line,) = [each.line for each in tc_filters([VIDEO], CASES["htb_u32"])]
    assert "match u8 0x05 0x0f at 0 match u16 0 0x1fff at 6" in line


def test_filters_that_are_there_keep_their_numbers() -> None:
    case = CASES["htb_flower"]
    before = {each.key: each.number for each in tc_filters(RULES, case)}
    after = tc_filters((RULES[2], RULES[0], *RULES[3:]), case, numbers=before)
    assert {each.key: each.number for each in after} == {
        key: number for key, number in before.items() if key != RULES[1].key
    }
    newcomer = dataclasses.replace(VIDEO, key="newcomer")
    both = tc_filters((newcomer, VIDEO), case, numbers=before)
    assert [(each.key, each.number) for each in both] == [("newcomer", 2), (VIDEO.key, 1)]


def test_more_filters_than_u32_can_number_are_refused() -> None:
    rules = [dataclasses.replace(VIDEO, key=str(number)) for number in range(MAX_FILTERS + 1)]
    with cannot(
        "cannot make 4095 filters on eth0: 4094 fit; match by mark, or program fewer flows"
    ):
        tc_filters(rules, settings())


def test_ef_comes_first_and_less_than_best_effort_last() -> None:
    rules = [dataclasses.replace(VIDEO, dscp=dscp, five_qi=None) for dscp in range(MAX_DSCP + 1)]
    names = [each.name for each in classes_of(rules)]
    assert names[:4] == ["ef", "va", "dscp63", "dscp62"]
    assert names[-2:] == ["cs1", "le"]
    assert "df" not in names
    assert [each.name for each in classes_of(rules) if each.below_default] == ["cs1", "le"]


def test_5qis_are_ranked_by_their_guarantee_and_then_their_priority() -> None:
    rules = [dataclasses.replace(VIDEO, dscp=None, five_qi=each) for each in (9, 5, 4, 3, 85)]
    assert [each.name for each in classes_of(rules)] == ["5qi85", "5qi3", "5qi4", "5qi5", "5qi9"]


def test_a_rule_without_dscp_and_5qi_and_one_of_df_stay_with_the_rest() -> None:
    assert class_of(dataclasses.replace(VIDEO, dscp=None, five_qi=None)) is None
    assert class_of(dataclasses.replace(VIDEO, dscp=0)) is None


def test_a_link_is_divided_without_remainder_lost_or_spent_twice() -> None:
    classes = classes_of(RULES)
    rates, rest = divide(classes, link_kbit=20_000, guaranteed_kbit={"ef": 4000})
    assert rates == {"ef": 4000, "nqb": 3950, "dscp5": 3950, "5qi9": 3950, "le": 200}
    assert rest == 3950
    assert sum(rates.values()) + rest <= 20_000


@pytest.mark.parametrize(
    ("link", "guaranteed", "message"),
    [
        (0, {}, "cannot divide a link of 0 kbit/s; use 1 or more"),
        (
            20_000,
            {"af41": 1},
            (
                "cannot guarantee a rate to class 'af41'; "
                "classes of these rules are: ef, nqb, dscp5, 5qi9, le"
            ),
        ),
        (20_000, {"ef": 0}, "cannot guarantee 0 kbit/s to class ef; use 1 or more"),
        (
            20_000,
            {"ef": 20_000},
            (
                "cannot guarantee 20200 kbit/s (ef 20000, le 200) on a link of 20000 kbit/s: "
                "something must be left for nqb, dscp5, 5qi9, everything else"
            ),
        ),
    ],
)
def test_rates_that_do_not_fit_are_refused(
    link: int, guaranteed: dict[str, int], message: str
) -> None:
    with cannot(message):
        divide(classes_of(RULES), link_kbit=link, guaranteed_kbit=guaranteed)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"features": TcFeatures(classifiers=())},
            (
                "cannot find a classifier in this kernel: flower or u32 would do; "
                "load the module cls_flower or cls_u32, or use a kernel that has it"
            ),
        ),
        (
            {"features": TcFeatures(qdiscs=())},
            (
                "cannot find a queueing discipline in this kernel: htb or prio would do; "
                "load the module sch_htb or sch_prio, or use a kernel that has it"
            ),
        ),
        (
            {"features": TcFeatures(qdiscs=("htb",)), "link_kbit": None},
            (
                "cannot find a queueing discipline in this kernel: prio would do; load the module "
                "sch_prio, or use a kernel that has it; with the rate of the link, htb will do"
            ),
        ),
        (
            {"link_kbit": None, "guaranteed_kbit": {"ef": 1}},
            (
                "cannot guarantee a rate to ef with prio; "
                "give the rate of the link, and a kernel with htb"
            ),
        ),
    ],
)
def test_what_the_kernel_lacks_is_said_before_anything_is_sent(
    change: dict[str, object], message: str
) -> None:
    with cannot(message):
        batch(settings(**change))


def test_prio_has_sixteen_bands() -> None:
    rules = [dataclasses.replace(VIDEO, dscp=dscp) for dscp in range(1, 17)]
    with cannot(
        "cannot give 16 classes a band each: prio has 16; "
        "give the rate of the link, then htb has no such limit"
    ):
        render_tc(rules, settings(link_kbit=None), system="teleop", digest=DIGEST)


@pytest.mark.parametrize("device", ["", "eth0; reboot", "a" * 16, "eth/0", "..", "eth0\nqdisc"])
def test_a_device_is_a_name_and_nothing_else(device: str) -> None:
    with cannot(
        f"cannot use device {device!r}; "
        "use the name of a network device, such as eth0, of at most 15 characters"
    ):
        TcSettings(device=device)
