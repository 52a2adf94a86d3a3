"""Types of parameter values, as rcl_interfaces/ParameterType has them.

Owns: whether a value fits a declared type, and what rcl makes of a scalar in a parameter file.
Pure.
"""

from __future__ import annotations

import re

from lifecycle.manifest.model import ParameterValue
from lifecycle.manifest.yaml.scalars import INT64_MAX, INT64_MIN, quote

_SCALARS = {bool: "bool", int: "int", float: "double", str: "string"}
_IMPLICIT = ("use_sim_time", "start_type_description_service")


def _spellings(word: str) -> tuple[str, str, str]:
    return word, word.capitalize(), word.upper()


# rcl_yaml_param_parser's get_value(): YAML 1.1 booleans, strtoll with base 0, then strtod.
_TRUE = frozenset(("Y", "y", *_spellings("yes"), *_spellings("true"), *_spellings("on")))
_FALSE = frozenset(("N", "n", *_spellings("no"), *_spellings("false"), *_spellings("off")))
_INTEGER = re.compile(r"\s*([-+]?)(0[xX][0-9a-fA-F]+|0[0-7]*|[1-9][0-9]*)\Z", re.ASCII)
_DOUBLE = re.compile(
    r"\s*[-+]?(\.?(inf|nan)|infinity|([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?)\Z",
    re.ASCII | re.IGNORECASE,
)
_LONGEST_INTEGER = 80


def is_implicit(name: str) -> bool:
    """Tell whether ROS declares this parameter itself, in every node or for every topic."""
    return name in _IMPLICIT or name.startswith("qos_overrides.")


def type_of(value: ParameterValue) -> str:
    """Return a value's type, `int`, `string_array`; `array` for an empty array, which fits all."""
    if isinstance(value, tuple):
        return f"{_SCALARS[type(value[0])]}_array" if value else "array"
    return _SCALARS[type(value)]


def misfit(value: ParameterValue, declared: str) -> str:
    """Return how a value fails its declared type, to follow "cannot set … to "; empty if it fits.

    ROS converts nothing: an integer for a double ends the node when it declares the parameter.
    """
    given = type_of(value)
    bytes_given = declared == "byte_array" and given == "int_array"
    if given == declared or (given == "array" and declared.endswith("_array")):
        return ""
    if bytes_given and isinstance(value, tuple):
        if all(isinstance(each, int) and 0 <= each <= 0xFF for each in value):
            return ""
        return f"{_show(value)}: a byte_array holds 0 to 255"
    article = "an" if given[0] in "ai" else "a"
    return f"{_show(value)}: it is {article} {given}, declared is {declared}"


def suggestion(value: ParameterValue, declared: str) -> str:
    """Return how to write the value so that it fits; empty where that cannot be told."""
    if declared == "double" and isinstance(value, int) and not isinstance(value, bool):
        return f"write {float(value)}"
    if declared == "string" and not isinstance(value, (str, tuple)):
        return "put it in quotes"
    if declared == "double_array" and type_of(value) == "int_array" and isinstance(value, tuple):
        return f"write [{', '.join(str(float(each)) for each in value)}]"
    if declared.endswith("_array") and not isinstance(value, tuple):
        return f"write [{_show(value)}]"
    return ""


def read_scalar(text: str, *, quoted: bool) -> bool | int | float | str:
    """Return what rcl makes of a scalar in a parameter file.

    Args:
        text: as written, without quotes.
        quoted: it stood in quotes.
    """
    if quoted:
        return text
    if text in _TRUE or text in _FALSE:
        return text in _TRUE
    if (match := _INTEGER.match(text)) and len(text) <= _LONGEST_INTEGER:
        digits = match[2]
        octal = digits.startswith("0") and digits[1:2] not in ("", "x", "X")
        number = int(f"{match[1]}{digits}", 8 if octal else 0)
        if INT64_MIN <= number <= INT64_MAX:
            return number
    if _DOUBLE.match(text):
        return float(text.strip().replace(".inf", "inf").replace(".nan", "nan").lower())
    return text


def _show(value: ParameterValue) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(quote(each) for each in value[:4])}{', …' if len(value) > 4 else ''}]"
    return quote(value)
