"""Lengths as users write them in options, YAML and ``--set``: ``5mm``, ``0.5 cm``, ``0.25in``.

A bare number is in the unit that the option's help or the key's name states."""

import re
from decimal import Decimal
from typing import Any

UNITS_M = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
LEGAL = "such as 5mm, 0.5cm, 1m or 0.25in"
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d{1,3})?"
_LENGTH = re.compile(rf"\s*({_NUMBER})\s*({'|'.join(UNITS_M)})?\s*", re.ASCII)
_KEY_WITH_UNIT = re.compile(rf"(?:.*\.)?\w*_({'|'.join(UNITS_M)})", re.ASCII)


def in_unit(text: str, unit: str) -> float | None:
    """Return a length in ``unit``, which a bare number is in already; None if the text is none.

    Computed in decimals, so that 90cm is 0.9 m to the last digit, as if it had been written so."""
    match = _LENGTH.fullmatch(text)
    if match is None:
        return None
    number = Decimal(match[1])
    written = Decimal(str(UNITS_M[match[2] or unit]))
    return float(number * written / Decimal(str(UNITS_M[unit])))


def states_unit(text: str) -> bool:
    """Return whether a text is a length with its unit."""
    match = _LENGTH.fullmatch(text)
    return match is not None and match[2] is not None


def unit_of_key(key: str) -> str | None:
    """Return ``mm`` for ``diameter_mm`` and for a dotted path that ends so; None without unit."""
    match = _KEY_WITH_UNIT.fullmatch(key)
    return None if match is None else match[1]


def converted(key: str, value: Any) -> Any:
    """Return a value of a key, also a list, whose texts with a unit are numbers in the key's unit;
    a value of a key without unit, and what is no length, unchanged."""
    unit = unit_of_key(key)
    if unit is None:
        return value
    if isinstance(value, list):
        return [converted(key, item) for item in value]
    if isinstance(value, str) and states_unit(value):
        return in_unit(value, unit)
    return value
