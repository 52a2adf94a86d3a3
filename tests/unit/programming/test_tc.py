"""Lines for tc: whole batches, accepted by tc twice, and classes that fit their link."""

from __future__ import annotations

import re

import pytest
from msgspec.structs import replace

from lifecycle.network.dscp import MAX_DSCP
from lifecycle.programming.tc import TcMatch, TcSettings, TcTarget, class_of, classes_of, divide
from tests.unit.programming.flow_samples import EXPECTED, LEFT_OUT, RULES, VIDEO
from tests.unit.programming.samples import exported


def settings(**rest: object) -> TcSettings:
    return TcSettings(device="eth0", **{"link_kbit": 20_000, **rest})


CASES = {
    "htb_flow": settings(guaranteed_kbit={"ef": 4000}),
    "htb_mark": settings(match=TcMatch.MARK),
}


def cannot(message: str) -> object:
    return pytest.raises(ValueError, match=f"^{re.escape(message)}$")


def script(case: TcSettings) -> str:
    return exported(TcTarget, case, RULES, left_out=LEFT_OUT)


@pytest.mark.parametrize("name", CASES)
def test_a_script_makes_a_class_per_dscp_or_5qi_and_puts_each_flow_into_one(name: str) -> None:
    assert script(CASES[name]) == (EXPECTED / f"{name}.sh").read_text(encoding="utf-8")


def test_ef_comes_first_and_less_than_best_effort_last() -> None:
    rules = [replace(VIDEO, dscp=dscp, five_qi=None) for dscp in range(MAX_DSCP + 1)]
    names = [each.name for each in classes_of(rules)]
    assert names[:4] == ["ef", "va", "dscp63", "dscp62"]
    assert names[-2:] == ["cs1", "le"]
    assert "df" not in names
    assert [each.name for each in classes_of(rules) if each.below_default] == ["cs1", "le"]


def test_5qis_are_ranked_by_their_guarantee_and_then_their_priority() -> None:
    rules = [replace(VIDEO, dscp=None, five_qi=each) for each in (9, 5, 4, 3, 85)]
    assert [each.name for each in classes_of(rules)] == ["5qi85", "5qi3", "5qi4", "5qi5", "5qi9"]


def test_a_rule_without_dscp_and_5qi_and_one_of_df_stay_with_the_rest() -> None:
    assert class_of(replace(VIDEO, dscp=None, five_qi=None)) is None
    assert class_of(replace(VIDEO, dscp=0)) is None


def test_a_link_is_divided_without_remainder_lost_or_spent_twice() -> None:
    classes = classes_of(RULES)
    rates = divide(classes, link_kbit=20_001, guaranteed_kbit={"ef": 4000})
    assert [(each.name, rate) for each, rate in rates.items()] == [
        ("ef", 4000),
        ("nqb", 3950),
        ("dscp5", 3950),
        ("5qi9", 3950),
        ("everything else", 3951),
        ("le", 200),
    ]


@pytest.mark.parametrize(
    ("link", "guaranteed", "message"),
    [
        (
            20_000,
            {"af41": 1},
            (
                "cannot guarantee a rate to class 'af41'; "
                "classes of these rules are: ef, nqb, dscp5, 5qi9, le"
            ),
        ),
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
    "device", ["", "eth0; reboot", "a" * 16, "eth/0", "..", "eth0\nqdisc", "eth*", 'e"0']
)
def test_a_device_is_a_name_and_nothing_else(device: str) -> None:
    with cannot(
        f"cannot use device {device!r}; "
        "use the name of a network device, such as eth0, of at most 15 characters"
    ):
        TcSettings(device=device, link_kbit=1)
