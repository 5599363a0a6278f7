"""Fits the law of a camera's signals to all damage of one kind in the atlas at once.

Signals tell more than hits and misses, and damage of all sizes, depths and set-ups tells of the
same few coefficients: limits of single set-ups of 42 holes, fitted one by one, differed by their
own chance so much that a law through them missed set-ups left out by 16 to 71 %. A miss says only
that the signal is below its set-up's threshold, and a signal above `SATURATED` typical thresholds
only that it is above, as `harness.evaluation.study.signals` explains. Thresholds, of six boards
each, differ from set-up to set-up by chance; the law is that of the camera's middle one.

The prior is the ideal detector's law. The stated error is how far distances that were left out
depart from the law of the others, less the chance of their own damage, and never less than that
chance hides. Not modelled: damage of
one board has the same noise, which that error contains."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import optimize, special

from harness.evaluation.study.signals import SATURATED
from harness.programs.atlas.law import Law, terms_of

PRIOR_MEANS = np.array([0.0, 1.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
PRIOR_DEVIATIONS = np.array([5.0, 1.0, 1.5, 1.5, 0.3, 0.5, 0.5, 0.3])
"""Prior of the coefficients: an ideal filter's, wide where the data tell."""
SCATTER = 0.4
"""Middle of the prior of the scatter; one deviation is a factor of e."""
OFFSET_DEVIATION = 2.0
"""Prior deviation of the departure of a distance; a factor of 7 in signals."""
TELLING = 0.5
"""Largest standard error of a departure that counts; larger if all is found, or nothing."""
LEAST_TELLING = 3
"""Least number of departures that tell the error of a law."""
STEP = 1e-4
"""Step of derivatives of the gradient."""
LN_ROOT_2PI = 0.5 * np.log(2 * np.pi)


@dataclass(frozen=True)
class Sites:
    """Damage of one kind that was inspected, of all distances of a camera."""

    log_size_px: np.ndarray
    """(n,): ln of the size over the width of a pixel."""
    x: np.ndarray
    """(n,): ln of the noise over the depth."""
    log_pixel_mm: np.ndarray
    """(n,): ln of the width of a pixel on the target."""
    fixed_share: np.ndarray
    """(n,): share of the noise's variance that no averaging removes."""
    log_albedo: np.ndarray
    """(n,): ln of the albedo over its middle, `MIDDLE_ALBEDO`."""
    log_signal: np.ndarray
    """(n,): ln of the signal over the camera's typical threshold; NaN if nothing was judged there.
    """
    log_threshold: np.ndarray
    """(n,): ln of the threshold of the set-up over that."""
    is_found: np.ndarray
    """(n,): whether it was hit."""
    part: np.ndarray
    """(n,): number of its distance, ascending."""
    frames: np.ndarray
    """(n,): number of averaged frames."""

    def chosen(self, keep: np.ndarray) -> "Sites":
        """Return some of the sites."""
        return Sites(**{name: values[keep] for name, values in vars(self).items()})


@dataclass(frozen=True)
class Departure:
    """Departure of a set-up from the law of the other distances."""

    part: int
    """Number of its distance."""
    frames: int
    """Number of averaged frames."""
    sites: int
    """Number of damages."""
    hits: int
    """Number found."""
    expected: float
    """Number that the law expects to be found."""
    log_signal: float
    """Difference of ln(signal / threshold) from the law."""
    deviation: float
    """Its standard error by the set-up's own damages."""


def fitted(sites: Sites, ranges: Mapping[str, tuple[float, float]]) -> tuple[Law, list[Departure]]:
    """Return the law of sites, and how each set-up departs from the law of the other distances.
    ``ranges``: on the axes of a question."""
    every = {
        **ranges,
        "x": _ends(sites.x),
        "log_size_px": _ends(sites.log_size_px),
    }
    ends = every["log_size_px"]
    parts = np.unique(sites.part)
    departures = []
    for part in parts:
        is_left_out = sites.part == part
        values = _most_likely(sites.chosen(~is_left_out), ends) if len(parts) > 1 else None
        for frames in np.unique(sites.frames[is_left_out]):
            own = sites.chosen(is_left_out & (sites.frames == frames))
            if values is not None:
                departures.append(_departure(own, values, ends))
    # nothing is extrapolated: the first and the last distance do not tell how well the law holds
    between = [one for one in departures if parts[0] < one.part < parts[-1]]
    telling = [one for one in between if one.deviation <= TELLING]
    error = np.nan
    if len(telling) >= LEAST_TELLING:
        by_chance = np.array([one.deviation**2 for one in telling])
        excess = np.array([one.log_signal**2 for one in telling]) - by_chance
        # the mean of n squares of normal departures varies by sqrt(2 / n) of itself: less than
        # that is not seen
        least = np.sqrt(2 / len(telling)) * by_chance.mean()
        error = float(np.sqrt(max(excess.mean(), least)))
    values = _most_likely(sites, ends)
    law = Law(
        coefficients=values[:-1],
        covariance=_covariance(values, sites, ends)[:-1, :-1],
        scatter=float(np.exp(values[-1])),
        error=error,
        degrees=max(len(telling), 1),
        ranges=every,
    )
    return law, departures


def _ends(values: np.ndarray) -> tuple[float, float]:
    """Return the least and the largest value."""
    return float(values.min()), float(values.max())


def _design(sites: Sites, ends: tuple[float, float]) -> np.ndarray:
    """Return the terms of sites (n, t)."""
    others = (
        sites.x,
        sites.log_pixel_mm,
        sites.fixed_share,
        sites.log_albedo,
    )
    return terms_of(sites.log_size_px, others, ends)


def _most_likely(sites: Sites, ends: tuple[float, float]) -> np.ndarray:
    """Return the most likely coefficients and ln of the scatter (t + 1,)."""
    start = np.append(PRIOR_MEANS, np.log(SCATTER))
    found = optimize.minimize(
        _loss,
        start,
        args=(_design(sites, ends), sites),
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": 5000, "maxfun": 10000},
    )
    return np.asarray(found.x)


def _loss(values: np.ndarray, design: np.ndarray, sites: Sites) -> tuple[float, np.ndarray]:
    """Return the negative logarithm of the posterior density, and its gradient (t + 1,)."""
    log_density, slope, scatter_slope = _log_densities(
        design @ values[:-1], float(np.exp(values[-1])), sites
    )
    deviations = np.append(PRIOR_DEVIATIONS, 1.0)
    departures = (values - np.append(PRIOR_MEANS, np.log(SCATTER))) / deviations
    loss = 0.5 * float(departures @ departures) - float(log_density.sum())
    gradient = departures / deviations - np.append(design.T @ slope, scatter_slope.sum())
    return loss, gradient


def _log_densities(
    mean: np.ndarray, scatter: float, sites: Sites
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ln of the density of each signal (n,), and its derivatives by the mean and by ln of
    the scatter."""
    most = np.log(SATURATED)
    is_above = sites.log_signal >= sites.log_threshold
    is_known = sites.is_found & is_above & (sites.log_signal < most)
    is_saturated = sites.is_found & (sites.log_signal >= most)
    # of a signal that is known; else of the limit that it lies above or below
    limit = np.where(is_saturated, most, sites.log_threshold)
    z = (np.where(is_known, sites.log_signal, limit) - mean) / scatter
    side = np.where(sites.is_found, -1.0, 1.0)
    log_tail = special.log_ndtr(side * z)
    log_normal = -0.5 * z**2 - LN_ROOT_2PI
    ratio = side * np.exp(log_normal - log_tail)
    log_density = np.where(is_known, log_normal - np.log(scatter), log_tail)
    slope = np.where(is_known, z, -ratio) / scatter
    scatter_slope = np.where(is_known, z**2 - 1, -ratio * z)
    return log_density, slope, scatter_slope


def _covariance(values: np.ndarray, sites: Sites, ends: tuple[float, float]) -> np.ndarray:
    """Return the covariance of coefficients and ln of the scatter, from the loss's curvature."""
    design = _design(sites, ends)
    rows = []
    for step in STEP * np.eye(len(values)):
        above = _loss(values + step, design, sites)[1]
        below = _loss(values - step, design, sites)[1]
        rows.append((above - below) / (2 * STEP))
    curvature = np.array(rows)
    return np.asarray(np.linalg.inv(0.5 * (curvature + curvature.T)))


def _departure(own: Sites, values: np.ndarray, ends: tuple[float, float]) -> Departure:
    """Return how the sites of a set-up depart from a law that was fitted to others."""
    mean = _design(own, ends) @ values[:-1]
    scatter = float(np.exp(values[-1]))

    def loss(offset: float) -> float:
        log_density, _, _ = _log_densities(mean + offset, scatter, own)
        return 0.5 * (offset / OFFSET_DEVIATION) ** 2 - float(log_density.sum())

    most = 3 * OFFSET_DEVIATION
    offset = float(optimize.minimize_scalar(loss, bounds=(-most, most), method="bounded").x)
    step = scatter / 4
    curvature = (loss(offset + step) - 2 * loss(offset) + loss(offset - step)) / step**2
    return Departure(
        part=int(own.part[0]),
        frames=int(own.frames[0]),
        sites=len(own.part),
        hits=int(own.is_found.sum()),
        expected=float(special.ndtr(mean / scatter).sum()),
        log_signal=offset,
        deviation=float(1 / np.sqrt(max(curvature, OFFSET_DEVIATION**-2))),
    )
