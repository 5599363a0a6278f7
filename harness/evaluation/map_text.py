"""Numbers of the rules about maps as text."""

from __future__ import annotations

import numpy as np

from harness.evaluation.intervals import Interval
from harness.evaluation.paired import Change


def frames_text(frames: int) -> str:
    """``50 frames a view``."""
    return f"{frames} frame{'s' if frames > 1 else ''} a view"


def span(interval: Interval, digits: int = 2) -> str:
    """``0.10 to 0.20``, or that it is unknown."""
    if not interval.known:
        return "interval unknown"
    low, high = (round(end, digits) + 0.0 for end in (interval.low, interval.high))  # + 0.0 turns -0.0 into 0.0
    return f"{low:.{digits}f} to {high:.{digits}f}"


def change_text(change: Change, unit: str = " mm") -> str:
    """``+0.12 mm (0.05 to 0.19)``."""
    if not np.isfinite(change.mean):
        return "not compared"
    return f"{round(change.mean, 2) + 0.0:+.2f}{unit} ({span(change.interval)})"


def ratio_text(change: Change) -> str:
    """A change of a logarithm as a factor: ``× 0.61 (0.60 to 0.62)``."""
    if not np.isfinite(change.mean):
        return "not compared"
    return f"× {np.exp(change.mean):.2f} ({span(Interval(*np.exp([change.interval.low, change.interval.high])))})"
