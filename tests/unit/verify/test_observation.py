"""What a node's report says of a parameter, and what stands for a value that is too long."""

from __future__ import annotations

import hashlib

from lifecycle import codec
from lifecycle.verify.observation import LONGEST_VALUE, ParameterReport

_FITS = "x" * (LONGEST_VALUE - len('""'))
_TOO_LONG = _FITS + "x"


def test_a_report_of_a_parameter_has_its_value_as_manifests_spell_it() -> None:
    assert ParameterReport.of("gain", "double", float("inf"), read_only=False) == ParameterReport(
        name="gain", type="double", value=".inf", digest="", read_only=False
    )
    assert ParameterReport.of("gain", "double", None, read_only=True) == ParameterReport(
        name="gain", type="double", value=None, digest="", read_only=True
    )


def test_a_value_that_is_too_long_is_reported_by_its_digest_alone() -> None:
    digest = hashlib.sha256(codec.to_json(_TOO_LONG)).hexdigest()
    assert ParameterReport.of("map", "string", _TOO_LONG, read_only=True) == ParameterReport(
        name="map", type="string", value=None, digest=digest, read_only=True
    )
    assert ParameterReport.of("map", "string", _FITS, read_only=True).value == _FITS
