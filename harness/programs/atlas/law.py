"""The law of a camera's signals.

A signal is the highest score at a damage over the threshold. What decides it is the width s of the
damage in pixels, and the noise of a pixel over its depth:

    ln(signal / threshold) = spline(ln s) + a x + b ln(pixel width) + c (fixed share)
                             + e ln(albedo),    x = ln(noise(d, albedo, frames) / depth).

The ideal detector of damage under white noise has a = -1 and b = c = e = 0, and a spline of slope
1. Real ones depart from it: noise and templates that reach over several pixels bend the spline,
holes that are narrow for their depth make b positive, a pattern that averages leave is correlated
over other widths than a frame's noise, and light of a bright board mixes into a hole. Damage is
found where the signal is above the threshold; single damages scatter normally about the law.

Not modelled: an automatic exposure that surfaces around the target choose. The noise is that of an
even plane; on dark boards of the flexx2 signals departed from it by up to .9 with one frame."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

TERMS = ("1", "size", "bend 1", "bend 2", "x", "pixel", "fixed share", "albedo")
KNOTS = (0.05, 0.35, 0.65, 0.95)
"""Knots of the natural cubic spline, as shares of the range of ln s (Harrell's places)."""
MIDDLE_ALBEDO = 0.3
"""Albedo at which the term of albedo is 0."""


@dataclass(frozen=True)
class Law:
    """A fitted law."""

    coefficients: np.ndarray
    """(t,): of `TERMS`."""
    covariance: np.ndarray
    """(t, t): of the coefficients."""
    scatter: float
    """Deviation of ln(signal / threshold) of single damages."""
    error: float
    """Deviation between the law and set-ups at distances that were left out; NaN if too few tell.
    """
    degrees: int
    """Number of departures that tell it."""
    ranges: Mapping[str, tuple[float, float]]
    """What was computed, as (lowest, highest): the axes of a question, ``x`` and
    ``log_size_px``."""

    def signal(
        self, log_size_px: np.ndarray, others: tuple[float, ...]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return ln(signal / threshold) of typical damage (n,), and the deviation of set-ups from
        it. ``others``: x, ln of the pixel's width, fixed share, ln of the relative albedo."""
        ones = np.ones_like(log_size_px)
        terms = terms_of(
            log_size_px,
            others=tuple(value * ones for value in others),
            ends=self.ranges["log_size_px"],
        )
        variance = np.einsum("ij,jk,ik->i", terms, self.covariance, terms)
        return terms @ self.coefficients, np.sqrt(variance + self.error**2)


def terms_of(
    log_size_px: np.ndarray,
    others: tuple[np.ndarray, ...],
    ends: tuple[float, float],
) -> np.ndarray:
    """Return the value of each term (n, t). ``others``: those after the spline. ``ends``: of ln
    s, between which the knots stand."""
    lowest, highest = ends
    knots = lowest + (highest - lowest) * np.array(KNOTS)

    def hinge(knot: float) -> np.ndarray:
        """Return what bends at a knot and is straight beyond the last."""
        rise = np.clip(log_size_px - knot, 0, None) ** 3
        beyond = np.clip(log_size_px - knots[-1], 0, None) ** 3
        return np.asarray((rise - beyond) / (knots[-1] - knot))

    last = hinge(knots[2])
    bends = [hinge(knots[0]) - last, hinge(knots[1]) - last]
    return np.stack([np.ones_like(log_size_px), log_size_px, *bends, *others], axis=1)
