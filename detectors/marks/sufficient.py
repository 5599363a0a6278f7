"""Whether a registration can rest on some marks: three or more, trusted, and not on a line."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from detectors.marks.mark import Mark
from harness.vocabulary.units import MM

LEAST_MARKS = 3
OFF_LINE_SIGMAS = 5.0
"""Marks lie on a line where their root mean square distance from it is less than so many standard deviations of one
mark's place: the turn about the line would be wrong by a fifth of a radian."""
OFF_LINE_SHARE = 0.02
"""... or less than this part of their root mean square distance along it: each millimetre that a view is wrong at a
mark would become 50 mm at the same distance across the line."""


def problem_of(marks: Sequence[Mark], missing: str = "") -> str:
    """Why no registration can rest on these marks; empty where one can. ``missing`` says why there are not more."""
    trusted = [mark for mark in marks if not mark.doubt]
    doubtful = [mark for mark in marks if mark.doubt]
    if len(trusted) < LEAST_MARKS:
        found = f"{len(trusted)} {'mark' if len(trusted) == 1 else 'marks'} found, {LEAST_MARKS} needed"
        doubts = f"; {len(doubtful)} more in doubt: {'; '.join(_in_short(doubtful))}" if doubtful else ""
        return found + doubts + (f"; {missing}" if missing else "")
    return off_line_problem(trusted)


def _in_short(doubtful: Sequence[Mark]) -> list[str]:
    """Each doubt once, with how many marks share it."""
    doubts = sorted({mark.doubt for mark in doubtful})
    times = [sum(mark.doubt == doubt for mark in doubtful) for doubt in doubts]
    return [doubt if n == 1 else f"{doubt} ({n} times)" for doubt, n in zip(doubts, times, strict=True)]


def off_line_problem(marks: Sequence[Mark]) -> str:
    """That the marks lie on a line, and how far off it they stray; empty where they do not."""
    places = np.stack([mark.centre_m for mark in marks])
    sizes = np.linalg.svd(places - places.mean(axis=0), compute_uv=False) / np.sqrt(len(marks))
    error = float(np.sqrt(np.mean([np.linalg.eigvalsh(mark.covariance_m2)[-1] for mark in marks])))
    if sizes[1] >= max(OFF_LINE_SIGMAS * error, OFF_LINE_SHARE * sizes[0]):
        return ""
    return (
        f"the {len(marks)} marks lie on a line, {sizes[1] / MM:.1f} mm off it, which leaves the turn about it open;"
        " a mark beside the line is missing"
    )
