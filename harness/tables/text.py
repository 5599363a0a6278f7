"""Numbers as text, for all tables, pages and terminals: sizes in mm, shares, intervals, p-values, dashes."""

from __future__ import annotations

import re
from fractions import Fraction
from typing import Any

import numpy as np

UNKNOWN_TEXT = "–"
INCHES = {n: str(Fraction(n, 16)) for n in (1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 16)}
"""Drills by sixteenths of an inch."""


def plain(value: Any) -> str:
    """Return text and counts as they are, other numbers with three digits, and a dash for what is unknown."""
    if value is None or (isinstance(value, float | np.floating) and np.isnan(value)):
        return UNKNOWN_TEXT
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    return f"{value:.3g}" if isinstance(value, float | np.floating) else str(value)


def mm(value: float, digits: int = 2) -> str:
    """Return a number of millimetres, or a dash where it is not finite."""
    return f"{value:.{digits}f}" if np.isfinite(value) else UNKNOWN_TEXT


def plus_minus(mean: float, std: float) -> str:
    """Return ``3.20 ± 0.10``, or a dash where the mean is unknown."""
    return UNKNOWN_TEXT if np.isnan(mean) else f"{mean:.2f}\u00a0±\u00a0{std:.2f}"


def size(value: float, most: float = np.inf) -> str:
    """Return a size in mm: two decimals below 100 mm, as many as a drill's size has; ``> 15.9`` beyond ``most``, the
    largest size inspected; ``none`` for NaN."""
    if np.isnan(value):
        return "none"
    if value > most:
        return f">\u00a0{most:.3g}"
    if np.isinf(value):
        return "∞"
    return f"{value:.2f}" if abs(value) < 100 else f"{value:.3g}"


def percent(share: float) -> str:
    """Return ``93`` for 0.93; near 0 and 1 with a decimal, since a whole number would say impossible or certain."""
    value = 100 * share
    if np.isnan(value):
        return UNKNOWN_TEXT
    if 1 <= value <= 99:
        return f"{value:.0f}"
    return "< 0.1" if value < 0.05 else "> 99.9" if value > 99.95 else f"{value:.1f}"


def p_value(p: float) -> str:
    """Return a p-value with two digits."""
    return "< 0.0001" if p < 0.0001 else UNKNOWN_TEXT if np.isnan(p) else f"{p:.2g}"


def interval(low: float, high: float, digits: int = 2, most: float = np.inf) -> str:
    """Return ``4.80 to 5.62``, or ``4.80 to > 15.9`` with an end beyond ``most``; ``unknown`` where there is none."""
    if np.isnan(low) or np.isnan(high):
        return "unknown"
    return " to ".join(_number(end, digits, most) for end in (low, high))


def with_interval(value: float, low: float, high: float, digits: int = 2, most: float = np.inf) -> str:
    """Return ``5.10 (4.80 to 5.62)``; the estimate alone where its interval is unknown or lies beyond ``most``."""
    text = _number(value, digits, most)
    if np.isnan(low) or np.isnan(high) or np.isnan(value) or min(value, low) > most:
        return text
    return f"{text} ({interval(low, high, digits, most)})"


def bounded(value: float, low: float, high: float, digits: int = 2) -> str:
    """Return ``0.50 (0.37 to 0.63)``; a dash where the estimate is unknown."""
    return f"{value:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})" if np.isfinite(value) else UNKNOWN_TEXT


def many(count: int, what: str) -> str:
    """Return ``1 trial``, ``2 trials``."""
    return f"{count} {what}" + ("" if count == 1 else "s")


def unbroken(text: str) -> str:
    """Return ``text`` with numbers held to the words after them by unbreakable spaces: ``0.7 m``, ``50 frames``."""
    return re.sub(r"(?<=\d) (?=[^\W\d])", "\u00a0", text)


def unmeasured(note: str) -> str:
    """Return a statement's note without the number of a size that nobody inspected."""
    return re.sub(r" = \S+ (?=lies (outside|beyond) the)", " ", note)


def inches(diameter_mm: float) -> str:
    """Return a drill's size as a fraction of an inch where it is a common one, else nothing: ``1/4 in``."""
    sixteenths = diameter_mm / 25.4 * 16
    known = INCHES.get(round(sixteenths)) if abs(sixteenths - round(sixteenths)) < 1e-3 else None
    return f"{known} in" if known else ""


def _number(value: float, digits: int, most: float) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) and not value > most else size(value, most)
