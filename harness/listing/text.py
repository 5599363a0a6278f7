"""Tables, sizes and ages as text."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from harness.vocabulary.errors import UserError

BYTES = {"kB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
"""Powers of ten, as disks are sold; the powers of two of the same letters differ by 7 % at GB."""
SECONDS = {"h": 3600.0, "d": 86_400.0, "w": 604_800.0}


def many(count: int, what: str) -> str:
    """Return ``1 trial``, ``2 trials``."""
    return f"{count} {what}" + ("" if count == 1 else "s")


def table_lines(rows: Sequence[Sequence[str]], indent: str = "  ") -> Iterator[str]:
    """Yield lines with columns below each other; the last cell of a row is as long as it likes."""
    widths: dict[int, int] = {}
    for row in rows:
        for column, cell in enumerate(row[:-1]):
            widths[column] = max(widths.get(column, 0), len(cell))
    for row in rows:
        cells = [cell.ljust(widths[column]) for column, cell in enumerate(row[:-1])]
        yield (indent + "  ".join([*cells, row[-1]])).rstrip()


def size_text(count: float) -> str:
    """Return a number of bytes with three digits, in powers of ten."""
    for unit, factor in reversed(BYTES.items()):
        if count >= 0.9995 * factor:
            value = count / factor
            return f"{value:.0f} {unit}" if value >= 99.95 else f"{value:.3g} {unit}"
    return f"{count:.0f} B"


def age_text(seconds: float) -> str:
    """Return how long ago; what lies in the future, by a clock that was set, is now."""
    if seconds < 60:
        return "just now"
    for unit, length, most in (("min", 60.0, 120.0), ("h", 3600.0, 48.0), ("days", 86_400.0, float("inf"))):
        if seconds < length * most:
            return f"{seconds / length:.0f} {unit} ago"
    raise AssertionError("the last unit has no end")


def bytes_of(text: str) -> int:
    """Read a size such as ``5GB`` or ``500 MB``. Raises UserError."""
    return round(_quantity(text, BYTES, "a size", "such as 500MB, 5GB or 1.5TB"))


def seconds_of(text: str) -> float:
    """Read an age such as ``30d``. Raises UserError."""
    return _quantity(text, SECONDS, "an age", "such as 12h, 30d (days) or 4w (weeks)")


def _quantity(text: str, units: dict[str, float] | dict[str, int], what: str, legal: str) -> float:
    found = re.fullmatch(r"([0-9]{1,12}(?:\.[0-9]{1,6})?) ?([A-Za-z]{1,3})", text.strip())
    factors = {unit.lower(): factor for unit, factor in units.items()}
    if found is None or found[2].lower() not in factors:
        raise UserError(f"{text!r} is not {what}", legal=legal)
    return float(found[1]) * factors[found[2].lower()]


def cache_folder(out: Path) -> Path:
    """Return where sweeps that write to ``out`` keep their renders."""
    return Path(out) / ".cache" / "renders"
