"""One damage of a study kept for its report: the residual around it, and how it fared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Where = Literal["below", "at", "above"]


@dataclass(frozen=True, eq=False)
class StudyExample:
    """A cut-out (h, w) of one run's pixel grid around one damage. ``where``: its size against the set-up's limit.

    ``diameter_mm``, ``depth_mm`` are true; ``pod``: what the curve says of that size. ``score``: the damage's signal,
    NaN where no pixel there was judged; ``threshold`` in the same units. ``residual_mm`` (h, w): distance behind (+) or
    before (-) the fitted surface, NaN where there is none. ``detected`` (h, w) bool: pixels of findings.
    ``outline_px`` (k, 2): the true rim, columns and rows in the cut-out, the centre of its first pixel being (0, 0).
    ``pitch_mm``: a pixel's width at the board.
    """

    variant: str
    frames: int
    board: int
    hole: str
    where: Where
    diameter_mm: float
    depth_mm: float
    pod: float
    hit: bool
    score: float
    threshold: float
    residual_mm: np.ndarray
    detected: np.ndarray
    outline_px: np.ndarray
    pitch_mm: float
