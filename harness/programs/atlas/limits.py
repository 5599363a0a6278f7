"""The atlas of limits: for each camera and kind of damage, a90 of some set-ups as a smooth law of
what the camera sees of the damage. It answers questions within the computed range and refuses
others.

What decides a limit is the noise of a pixel over the depth of the damage, and the width of a pixel
on the target, which grows with the distance d. So

    ln a90 = c0 + c1 x + c2 ln d + c3 x^2,    x = ln(noise(d, albedo, frames) / depth),

by least squares weighted with each limit's own interval. Frames, albedo and depth enter through x
alone: the noise comes from the sensor model before an even plane (`PlaneNoise`), its temporal part
over the root of the number of frames. The stated error is the root mean square error of ln a90 at
each set-up when the others predict it.

A limit is stated only between set-ups that have one: a set-up that is harder (not nearer, not less
noisy) and others that are not farther and not noisier. Where a harder set-up finds all damage, or
an easier one misses it, only that is said.

Not modelled: what depends on albedo or depth in another way than by noise, such as light that is
reflected within a deep hole; the error of the law shows it."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import special

UPPER = 0.975
"""Upper end of intervals at 95 %."""
UNKNOWN_VARIANCE = 0.25
"""Variance of ln a90 if an interval has no positive lower end: a factor of 1.65 either way."""
LEAST_VARIANCE = 1e-4
"""Least variance of ln a90: 1 %. No limit is known better."""
LEAST_FREE = 0.05
"""Least share of a set-up's residual that the fit leaves, which divides it."""
LEAST_FITTED = 6
"""Least number of limits of a law without its curvature; with it, `LEAST_CURVED`."""
LEAST_CURVED = 10
TOLERANCE = 1e-6
SAME_X = 0.05
"""Difference of x that counts as none: 5 % of the noise, which is known no better."""
AXES = {"distance_m": "m", "frames": "", "albedo": "", "depth_mm": "mm"}
"""The axes of a question, and their units."""


class Outside(Exception):
    """A question that the atlas cannot answer; the text gives the reason and the range of possible
    questions."""


@dataclass(frozen=True)
class Conditions:
    """A question's set-up, or a computed one's."""

    distance_m: float
    """Distance from the camera to the target."""
    albedo: float
    """Of the target, at the camera's wavelength."""
    frames: int
    """Number of averaged frames."""
    depth_mm: float | None = None
    """Depth of the damage; None of through-holes."""


@dataclass(frozen=True)
class SetUp:
    """A computed limit."""

    kind: str
    """Kind of damage."""
    conditions: Conditions
    """Where it was computed."""
    a90_mm: float
    """Size found 90 % of the time; NaN if none."""
    low_mm: float
    """Lower end of its 95 % interval; NaN if unknown."""
    high_mm: float
    """Upper end of its interval; NaN if unknown."""
    smallest_mm: float
    """Smallest size inspected."""
    largest_mm: float
    """Largest size inspected."""
    is_at_most: bool
    """Whether all damage was found, so that a90 is at most ``smallest_mm``."""
    hits: int
    """Number of damages found."""

    @property
    def has_limit(self) -> bool:
        """True if a limit was found within the sizes inspected."""
        return self.a90_mm <= self.largest_mm and not self.is_at_most

    @property
    def is_beyond(self) -> bool:
        """True if the limit lies above all sizes inspected."""
        return self.a90_mm > self.largest_mm or self.hits == 0

    @property
    def variance(self) -> float:
        """The variance of ln a90, from its interval."""
        if not (0 < self.low_mm < self.high_mm < np.inf):
            return UNKNOWN_VARIANCE
        deviation = np.log(self.high_mm / self.low_mm) / (2 * special.ndtri(UPPER))
        return float(np.clip(deviation**2, LEAST_VARIANCE, UNKNOWN_VARIANCE))


@dataclass(frozen=True)
class PlaneNoise:
    """Depth noise of a camera's pixels before an even plane, over distance and albedo."""

    distance_m: tuple[float, ...]
    """(d,): ascending distances."""
    albedo: tuple[float, ...]
    """(a,): ascending albedos."""
    frame_mm: np.ndarray
    """(d, a): temporal deviation of a frame; NaN where too few pixels have a depth."""
    fixed_mm: np.ndarray
    """(d, a): deviation of what no averaging removes; NaN likewise."""

    def at(self, conditions: Conditions) -> float:
        """Return the noise of an average, millimetres; logarithms of the variances are linear in
        those of distance and albedo. Raises Outside where the camera gives no depth."""
        frame = self._between(self.frame_mm**2, conditions)
        fixed = self._between(self.fixed_mm**2, conditions)
        noise_mm = float(np.sqrt(frame / conditions.frames + fixed))
        if not np.isfinite(noise_mm):
            raise Outside(
                f"distance {conditions.distance_m:g} m, albedo {conditions.albedo:g}: the camera"
                " gives no depth there or nearby (too much light, or too little)"
            )
        return noise_mm

    def _between(self, variances: np.ndarray, conditions: Conditions) -> float:
        """Interpolate variances (d, a) at conditions."""
        rows, row_shares = _neighbours(self.distance_m, conditions.distance_m)
        columns, column_shares = _neighbours(self.albedo, conditions.albedo)
        corners = np.log(np.maximum(variances[np.ix_(rows, columns)], TOLERANCE))
        return float(np.exp(row_shares @ corners @ column_shares))


def _neighbours(nodes: Sequence[float], value: float) -> tuple[list[int], np.ndarray]:
    """Return the nodes around a value and their shares, linear in the logarithm; a single one if
    it stands there."""
    above = int(np.searchsorted(nodes, value * (1 - TOLERANCE)))
    above = min(above, len(nodes) - 1)
    is_node = abs(nodes[above] / value - 1) < 10 * TOLERANCE
    if is_node or above == 0:
        return [above], np.ones(1)
    share = float(np.log(value / nodes[above - 1]) / np.log(nodes[above] / nodes[above - 1]))
    return [above - 1, above], np.array([1 - share, share])


@dataclass(frozen=True)
class Answer:
    """The limit at conditions, or the bounds that are known instead."""

    a90_mm: float = np.nan
    """Size found 90 % of the time; NaN if it is not known."""
    low_mm: float = np.nan
    """Lower end of its 95 % interval."""
    high_mm: float = np.nan
    """Upper end of its interval."""
    found_mm: float = np.nan
    """Size from which on all was found in a harder set-up; NaN without such."""
    missed_mm: float = np.nan
    """Size up to which damage was missed more than once in ten in an easier set-up; NaN without
    such."""

    def verdict(self, size_mm: float) -> str:
        """Return whether damage of this size is found 9 times out of 10: yes, no or undecided."""
        if self.high_mm <= size_mm or self.found_mm <= size_mm:
            return "yes"
        return "no" if self.low_mm > size_mm or self.missed_mm >= size_mm else "undecided"


@dataclass(frozen=True)
class Fit:
    """The law of a90, by weighted least squares."""

    coefficients: np.ndarray
    """(t,): of 1, x, ln d and, with enough limits, x^2."""
    covariance: np.ndarray
    """(t, t): of the coefficients."""
    degrees: int
    """Degrees of freedom."""
    error: float
    """Root mean square error of ln a90 at each set-up when the others predict it."""

    def log_a90(self, x: float, log_distance: float) -> tuple[float, float]:
        """Return ln a90 at conditions, and half the width of its 95 % interval."""
        terms = _terms(np.array([x]), np.array([log_distance]), len(self.coefficients))[0]
        middle = float(terms @ self.coefficients)
        deviation = np.hypot(np.sqrt(terms @ self.covariance @ terms), self.error)
        return middle, float(special.stdtrit(self.degrees, UPPER) * deviation)


@dataclass(frozen=True)
class LimitSurface:
    """Limits of one camera and one kind of damage."""

    camera: str
    """Name of the camera."""
    title: str
    """Its title."""
    kind: str
    """Kind of damage."""
    contrast_mm: float
    """Depth of through-holes: the distance of the surface behind the board."""
    focal_px: float
    """Focal length, which gives the width of a pixel on the target."""
    noise: PlaneNoise
    """The camera's noise."""
    set_ups: tuple[SetUp, ...]
    """The computed set-ups that the law is fitted to."""
    checks: tuple[SetUp, ...] = ()
    """Computed set-ups that were kept aside, between the others."""

    @cached_property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """The computed range on each axis that this kind of damage has."""
        ranges = {}
        for axis in AXES:
            values = [getattr(set_up.conditions, axis) for set_up in self.set_ups]
            if None not in values:
                ranges[axis] = (float(min(values)), float(max(values)))
        return ranges

    @cached_property
    def fit(self) -> Fit | None:
        """The law; None if too few set-ups have a limit."""
        limited = [set_up for set_up in self.set_ups if set_up.has_limit]
        if len(limited) < LEAST_FITTED:
            return None
        x = np.array([self.ratios[set_up] for set_up in limited])
        log_distance = np.log([set_up.conditions.distance_m for set_up in limited])
        log_a90 = np.log([set_up.a90_mm for set_up in limited])
        variances = np.array([set_up.variance for set_up in limited])
        return fitted(_terms(x, log_distance, _count(len(limited))), log_a90, variances)

    @property
    def error(self) -> float:
        """Root mean square error of ln a90, leaving each set-up out; NaN without a law."""
        return float("nan") if self.fit is None else self.fit.error

    @cached_property
    def ratios(self) -> dict[SetUp, float]:
        """x of each computed set-up."""
        return {set_up: self.ratio(set_up.conditions) for set_up in self.set_ups}

    def ratio(self, conditions: Conditions) -> float:
        """Return x: the logarithm of a pixel's noise over the damage's depth. Raises Outside."""
        depth_mm = self.contrast_mm if conditions.depth_mm is None else conditions.depth_mm
        return float(np.log(self.noise.at(conditions) / depth_mm))

    def at(self, conditions: Conditions) -> Answer:
        """Return the limit at conditions. Raises Outside beyond the computed range."""
        self._check_inside(conditions)
        x = self.ratio(conditions)
        harder = self._beside(lambda other: _is_harder(other, (x, conditions.distance_m)))
        easier = self._beside(lambda other: _is_harder((x, conditions.distance_m), other))
        found_mm = [set_up.smallest_mm for set_up in harder if set_up.is_at_most]
        missed_mm = [set_up.largest_mm for set_up in easier if set_up.is_beyond]
        known = Answer(
            found_mm=min(found_mm, default=np.nan), missed_mm=max(missed_mm, default=np.nan)
        )
        if known.found_mm <= known.missed_mm:
            return Answer()  # set-ups contradict one another
        if self.fit is None or missed_mm or not self._is_between(x, conditions, harder):
            return known
        middle, half = self.fit.log_a90(x, float(np.log(conditions.distance_m)))
        return Answer(
            a90_mm=float(np.exp(middle)),
            low_mm=float(np.exp(middle - half)),
            high_mm=float(np.exp(middle + half)),
            found_mm=known.found_mm,
        )

    def _is_between(self, x: float, conditions: Conditions, harder: Sequence[SetUp]) -> bool:
        """Return whether set-ups with limits stand on all sides of conditions."""
        limited = [set_up for set_up in self.set_ups if set_up.has_limit]
        nearest_m = min(set_up.conditions.distance_m for set_up in limited)
        least_x = min(self.ratios[set_up] for set_up in limited)
        is_reached = any(set_up.has_limit for set_up in harder)
        return (
            is_reached and nearest_m <= conditions.distance_m + TOLERANCE and least_x <= x + SAME_X
        )

    def _beside(self, is_beside: Callable[[tuple[float, float]], bool]) -> list[SetUp]:
        """Return the set-ups whose (x, distance) meets a condition."""
        chosen = []
        for set_up in self.set_ups:
            if is_beside((self.ratios[set_up], set_up.conditions.distance_m)):
                chosen.append(set_up)
        return chosen

    def _check_inside(self, conditions: Conditions) -> None:
        for axis, (lowest, highest) in self.ranges.items():
            value = getattr(conditions, axis)
            if lowest * (1 - TOLERANCE) <= value <= highest * (1 + TOLERANCE):
                continue
            unit = AXES[axis]
            wanted = f"{axis.partition('_')[0]} {value:g} {unit}".rstrip()
            raise Outside(f"{wanted}: the atlas has {lowest:g} to {highest:g} {unit}".rstrip())


def _is_harder(one: tuple[float, float], other: tuple[float, float]) -> bool:
    """Return whether the first of two (x, distance) is neither nearer nor less noisy."""
    return one[0] >= other[0] - SAME_X and one[1] >= other[1] - TOLERANCE


def _count(limits: int) -> int:
    """Return the number of terms that so many limits fix."""
    return 4 if limits >= LEAST_CURVED else 3


def _terms(x: np.ndarray, log_distance: np.ndarray, count: int) -> np.ndarray:
    """Return the value of each term of the law (n, count)."""
    columns = [np.ones_like(x), x, log_distance, x**2]
    return np.stack(columns[:count], axis=1)


def fitted(design: np.ndarray, log_a90: np.ndarray, variances: np.ndarray) -> Fit:
    """Fit ln a90 (n,) to terms (n, t) by least squares, weighted by 1 / variance. The residuals
    widen the covariance if they are larger than the variances say."""
    weights = 1.0 / variances
    inverse = np.linalg.pinv(design.T @ (weights[:, None] * design))
    coefficients = inverse @ (design.T @ (weights * log_a90))
    residuals = log_a90 - design @ coefficients
    degrees = len(residuals) - design.shape[1]
    leverage = np.einsum("ij,jk,ik->i", design, inverse, design) * weights
    left_out = residuals / np.maximum(1.0 - leverage, LEAST_FREE)
    scale = max(1.0, float((weights * residuals**2).sum()) / degrees)
    return Fit(
        coefficients=coefficients,
        covariance=inverse * scale,
        degrees=degrees,
        error=float(np.sqrt(np.mean(left_out**2))),
    )


def damage_of(text: str) -> tuple[str, float]:
    """Return the kind and the mean depth in mm, NaN without one, that a declaration of damage in
    JSON states."""
    damage = json.loads(text)
    return damage["kind"], float(np.mean(damage.get("depth_mm") or [np.nan]))
