"""What an unquoted scalar means: YAML 1.2's core schema, and the limits on numbers.

Owns: the one place where text becomes bool, int, float, null or string; used for scalars as
written and again for a scalar that was one whole substitution. Source of the rules: YAML 1.2.2
§10.3.2. So `yes`, `on`, `off` and `1:30` are strings here, and `0o17` is octal. In one thing they
are narrower, as JSON is: an integer does not begin with 0. Of `017` YAML 1.1 makes fifteen and 1.2
seventeen, of `018` a string and eighteen, and writers of 1.1 do write the string '018' bare. A
string is what no reader can take for another number. Pure.
"""

from __future__ import annotations

import math
import re

from lifecycle.manifest.yaml.document import Scalar

INT64_MIN = -(2**63)
INT64_MAX = 2**63 - 1
"""ROS integers are int64 (rcl_interfaces/ParameterValue)."""

YAML_1_1_BOOLEANS = frozenset(
    spelled
    for word in ("y", "yes", "on", "n", "no", "off")
    for spelled in (word, word.capitalize(), word.upper())
)
"""Booleans of YAML 1.1 (and of rcl's parameter files) that YAML 1.2 reads as strings."""

_NULL = frozenset({"", "~", "null", "Null", "NULL"})
_TRUE = frozenset({"true", "True", "TRUE"})
_FALSE = frozenset({"false", "False", "FALSE"})
_DECIMAL = re.compile(r"[-+]?(0|[1-9][0-9]*)\Z")
_LEADING_ZERO = re.compile(r"[-+]?0[0-9]+\Z")
_OCTAL = re.compile(r"0o[0-7]+\Z")
_HEXADECIMAL = re.compile(r"0x[0-9a-fA-F]+\Z")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?\Z")
_NOT_FINITE = re.compile(r"([-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN))\Z")
_LONGEST_INT = 80  # digits; int() is quadratic in them and refuses 4300, INT64_MIN has 19


def resolve(text: str) -> Scalar:
    """Return what the unquoted scalar `text` means.

    Raises:
        ValueError: a number that is not finite or does not fit into 64 bits; the message is a
            phrase that follows "cannot use '…': ".
    """
    if text in _NULL:
        return None
    if text in _TRUE:
        return True
    if text in _FALSE:
        return False
    for pattern, base in ((_DECIMAL, 10), (_OCTAL, 8), (_HEXADECIMAL, 16)):
        if pattern.match(text):
            return _integer(text, base)
    if _FLOAT.match(text) and not has_leading_zero(text):
        number = float(text)
        if math.isfinite(number):
            return number
        raise ValueError("a number must be finite")
    if _NOT_FINITE.match(text):
        raise ValueError("a number must be finite")
    return text


def has_leading_zero(text: str) -> bool:
    """Whether this is digits that versions of YAML read as different values."""
    return _LEADING_ZERO.match(text) is not None


def _integer(text: str, base: int) -> int:
    if len(text) <= _LONGEST_INT:
        number = int(text, base)
        if INT64_MIN <= number <= INT64_MAX:
            return number
    raise ValueError("an integer must fit into 64 bits, -2**63 to 2**63-1")


def quote(value: object, *, limit: int = 60) -> str:
    """Spell a value for a message: as YAML would show it, cut to `limit` characters."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, (list, tuple)):
        return "a list"
    spelled = repr(value)
    return spelled if len(spelled) <= limit else f"{spelled[: limit - 2]}…{spelled[-1]}"
