"""Values of ROS parameters: types of rcl_interfaces/ParameterType, and how JSON has them. Pure."""

from __future__ import annotations

import math
import re

from lifecycle.manifest.model import ParameterValue
from lifecycle.manifest.yaml.document import quote

NOT_FINITE = (".nan", ".inf", "-.inf")
"""Doubles that JSON has no numbers for, as YAML spells them."""

SCALARS = {bool: "bool", int: "int", float: "double", str: "string"}


def type_of(value: ParameterValue) -> str:
    """Return a value's type, `int`, `string_array`; `array` for an empty array, which fits all."""
    if isinstance(value, tuple):
        return f"{SCALARS[type(value[0])]}_array" if value else "array"
    return SCALARS[type(value)]


_NUMBERS = {"int": re.compile(r"[+-]?\d+"), "double": re.compile(r"[+-]?\d+(\.\d*)?")}
_IMPLICIT = ("use_sim_time", "start_type_description_service")


def is_implicit(name: str) -> bool:
    """Whether ROS declares this parameter itself, in every node or for every topic."""
    return name in _IMPLICIT or name.startswith("qos_overrides.")


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
    """Return how to write the value so that it fits; empty if not known."""
    if declared == "double" and isinstance(value, int) and not isinstance(value, bool):
        return f"write {float(value)}"
    if declared in _NUMBERS and isinstance(value, str) and _NUMBERS[declared].fullmatch(value):
        return f"write {value} as a number, not as text"
    if declared == "string" and not isinstance(value, (str, tuple)):
        return "put it in quotes"
    if declared == "double_array" and type_of(value) == "int_array" and isinstance(value, tuple):
        return f"write [{', '.join(str(float(each)) for each in value)}]"
    if declared.endswith("_array") and not isinstance(value, tuple):
        return f"write [{_show(value)}]"
    return ""


def _show(value: ParameterValue) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(quote(each) for each in value[:4])}{', …' if len(value) > 4 else ''}]"
    return quote(value)


def as_type(value: ParameterValue, type_: str) -> ParameterValue:
    """Return `value` as a parameter of `type_` has it: YAML writes 5 where a double is meant."""
    if type_.removesuffix("_array") != "double":
        return value
    if isinstance(value, tuple):
        return tuple(float(each) if _is_int(each) else each for each in value)
    return float(value) if _is_int(value) else value


def portable(value: ParameterValue) -> ParameterValue:
    """Return `value` so that JSON can carry it: doubles that are not finite become text."""
    if isinstance(value, tuple):
        return tuple(_portable(each) for each in value)
    return _portable(value)


def _portable(value: bool | float | str) -> bool | int | float | str:
    if isinstance(value, float) and not math.isfinite(value):
        return NOT_FINITE[0 if math.isnan(value) else 1 if value > 0 else 2]
    if isinstance(value, str):
        # A lone surrogate, which Python has and UTF-8 has not.
        return value.encode("utf-8", "backslashreplace").decode("utf-8")
    return value


def _is_int(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
