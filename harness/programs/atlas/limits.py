"""The atlas of limits: for each camera, kind of damage and detector, a90 of many set-ups as a
smooth surface over distance, frames, depth and albedo. It answers questions within the computed
range and refuses others.

The surface is a quadratic of ln a90 in the logarithms of the axes, by least squares weighted with
each limit's own interval. Its stated error is the root mean square error of ln a90 at each set-up
when the others predict it."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pandas as pd
from scipy import special

from harness.evaluation.intervals import UPPER
from harness.vocabulary.files import strict_json

CAMERA = "source.camera.name"
DETECTOR = "detector.name"
DAMAGE = "source.target.damage"
AXES = {
    "distance_m": "source.target.distance_m",
    "frames": "frames",
    "depth_mm": "depth_mm",
    "albedo": "source.target.material.albedo_850",
}
"""The axes of a surface, and the columns of the table of limits that hold their values."""
UNKNOWN_VARIANCE = 0.25
"""Variance of ln a90 if an interval has no positive lower end: a factor of 1.65 either way."""
LEAST_VARIANCE = 1e-4
"""Least variance of ln a90: 1 %. No limit is known better."""
LEAST_FREE = 0.05
"""Least share of a set-up's residual that the fit leaves, which divides it."""
TOLERANCE = 1e-9
DEEPEST_MM = 1e6
"""Largest depth of damage in a table that is read."""


class Outside(Exception):
    """A question that the atlas cannot answer; the text gives the reason and the range of possible
    questions."""


@dataclass(frozen=True)
class Answer:
    """a90 at a place; NaN if a set-up around it has no limit."""

    a90_mm: float
    """Size found 90 % of the time."""
    low_mm: float
    """Lower end of its interval at `CONFIDENCE`."""
    high_mm: float
    """Upper end of its interval."""
    largest_mm: float
    """Largest size inspected; without a limit NaN, unless all set-ups around it miss it too."""

    def verdict(self, size_mm: float) -> str:
        """Return whether damage of this size is found 9 times out of 10: yes, no or undecided."""
        is_missed = self.low_mm > size_mm
        if np.isnan(self.a90_mm):
            is_missed = size_mm <= self.largest_mm
        if self.high_mm <= size_mm:
            return "yes"
        return "no" if is_missed else "undecided"


@dataclass(frozen=True)
class Fit:
    """A quadratic of ln a90 over scaled places, by weighted least squares."""

    terms: tuple[tuple[int, ...], ...]
    """(t,): the axes whose product each term is."""
    coefficients: np.ndarray
    """(t,): the coefficient of each term."""
    covariance: np.ndarray
    """(t, t): of the coefficients."""
    degrees: int
    """Degrees of freedom."""
    error: float
    """Root mean square error of ln a90 at each set-up when the others predict it."""


@dataclass(frozen=True)
class LimitSurface:
    """Limits of one camera, kind of damage and detector at n set-ups over k axes."""

    camera: str
    """Name of the camera."""
    kind: str
    """Kind of damage."""
    detector: str
    """Name of the detector."""
    grid: Mapping[str, tuple[float, ...]]
    """The values that were computed on each axis."""
    nodes: np.ndarray
    """(n, k): the set-ups' places, axes in the order of ``grid``."""
    largest_mm: np.ndarray
    """(n,): largest size inspected."""
    has_limit: np.ndarray
    """(n,) bool: whether a limit was found within the sizes inspected."""
    is_beyond: np.ndarray
    """(n,) bool: whether the limit lies above all sizes."""
    damage: str
    """Declaration of the first set-up's damage, as JSON."""
    fit: Fit | None
    """The surface; None if too few set-ups have a limit."""

    @property
    def error(self) -> float:
        """Root mean square error of ln a90, leaving each set-up out; NaN without a surface."""
        return float("nan") if self.fit is None else self.fit.error

    def at(self, **position: float) -> Answer:
        """Return the limit at a place: a value for each axis of ``grid``. Raises Outside beyond
        the computed range."""
        self._check_inside(position)
        coordinates = np.array(
            [position.get(axis, values[0]) for axis, values in self.grid.items()]
        )
        is_around = np.all(
            [self._is_beside(axis, value) for axis, value in enumerate(coordinates)], axis=0
        )
        unknown = float("nan")
        if not is_around.any():
            return Answer(unknown, unknown, unknown, unknown)
        largest_mm = float(self.largest_mm[is_around].min())
        if self.fit is None or not self.has_limit[is_around].all():
            all_miss = self.is_beyond[is_around].all()
            return Answer(unknown, unknown, unknown, largest_mm if all_miss else unknown)
        scaled = _scaled(coordinates[None], list(self.grid.values()))
        row = _design(scaled, self.fit.terms)[0]
        middle = float(row @ self.fit.coefficients)
        std = np.hypot(np.sqrt(row @ self.fit.covariance @ row), self.fit.error)
        half = float(special.stdtrit(self.fit.degrees, UPPER) * std)
        return Answer(
            a90_mm=float(np.exp(middle)),
            low_mm=float(np.exp(middle - half)),
            high_mm=float(np.exp(middle + half)),
            largest_mm=largest_mm,
        )

    def _check_inside(self, position: Mapping[str, float]) -> None:
        for axis, values in self.grid.items():
            lowest = values[0]
            highest = values[-1]
            if axis not in position or lowest - TOLERANCE <= position[axis] <= highest + TOLERANCE:
                continue
            computed = f"{lowest:g} to {highest:g}" if len(values) > 1 else f"{lowest:g} only"
            name, _, unit = axis.partition("_")
            wanted = f"{name} {position[axis]:g} {unit}".rstrip()
            raise Outside(wanted + f": the atlas has {computed} {unit}".rstrip())

    def _is_beside(self, axis: int, value: float) -> np.ndarray:
        """Return whether each node (n,) stands at a neighbour of a value on an axis, or at the
        value itself."""
        values = np.array(list(self.grid.values())[axis])
        below = values[values <= value + TOLERANCE].max()
        above = values[values >= value - TOLERANCE].min()
        nodes = self.nodes[:, axis]
        return np.asarray(np.isclose(nodes, below) | np.isclose(nodes, above))


def surfaces_of(limits: pd.DataFrame) -> list[LimitSurface]:
    """Return the surfaces of a table of `LIMITS` by camera, kind and detector. Raises KeyError if
    it lacks an axis."""
    rows = limits.copy()
    damages = [damage_of(text) for text in rows[DAMAGE]]
    rows["kind"] = [kind for kind, _ in damages]
    rows["depth_mm"] = [depth_mm for _, depth_mm in damages]
    if DETECTOR not in rows:
        rows[DETECTOR] = rows["detector"]
    axes = [axis for axis, column in AXES.items() if column in rows]
    rows = rows.rename(columns={AXES[axis]: axis for axis in axes})
    groups = rows.groupby([CAMERA, "kind", DETECTOR], sort=False)
    return [_surface(group, axes) for _, group in groups]


def damage_of(text: str) -> tuple[str, float]:
    """Return the kind and the mean depth in mm, NaN without one, that a declaration of damage in
    JSON states. Raises ValueError if it states no kind, or a depth that is no possible number."""
    damage = strict_json(text, nan=True)
    if not isinstance(damage, dict) or not isinstance(damage.get("kind"), str):
        raise ValueError("it states no kind")
    depths_mm = damage.get("depth_mm") or [np.nan]
    if not isinstance(depths_mm, list):
        raise ValueError("its depth_mm is not a list")
    for depth_mm in depths_mm:
        is_number = isinstance(depth_mm, int | float) and not isinstance(depth_mm, bool)
        if not is_number or not (0 < depth_mm < DEEPEST_MM or depth_mm != depth_mm):
            raise ValueError(f"its depth_mm is no number between 0 and {DEEPEST_MM:g}")
    return damage["kind"], float(np.mean(depths_mm))


def _surface(rows: pd.DataFrame, axes: Sequence[str]) -> LimitSurface:
    """Return the surface through the rows of one camera, kind of damage and detector."""
    axes = [axis for axis in axes if rows[axis].notna().all()]
    grid = {axis: tuple(float(value) for value in np.unique(rows[axis])) for axis in axes}
    nodes = rows[axes].to_numpy(float)
    a90_mm = rows["a90_mm"].to_numpy(float)
    largest_mm = rows["largest_mm"].to_numpy(float)
    is_at_most = rows["is_at_most"].to_numpy(bool)
    has_limit = np.isfinite(a90_mm) & (a90_mm <= largest_mm) & ~is_at_most
    is_beyond = (a90_mm > largest_mm) | (rows["hits"].to_numpy() == 0)
    scaled = _scaled(nodes, list(grid.values()))
    terms = _terms([len(values) for values in grid.values()], int(has_limit.sum()))
    fit = None
    if terms:
        log_a90 = np.log(a90_mm[has_limit])
        fit = _fit(scaled[has_limit], log_a90, _variances(rows)[has_limit], terms)
    first = rows.iloc[0]
    return LimitSurface(
        camera=first[CAMERA],
        kind=first["kind"],
        detector=first[DETECTOR],
        grid=grid,
        nodes=nodes,
        largest_mm=largest_mm,
        has_limit=has_limit,
        is_beyond=is_beyond,
        damage=first[DAMAGE],
        fit=fit,
    )


def _variances(rows: pd.DataFrame) -> np.ndarray:
    """Return the variance of each ln a90 (n,), from its interval."""
    low_mm = rows["a90_low_mm"].to_numpy(float)
    high_mm = rows["a90_high_mm"].to_numpy(float)
    with np.errstate(all="ignore"):
        variance = (np.log(high_mm / low_mm) / (2 * special.ndtri(UPPER))) ** 2
    is_usable = np.isfinite(variance) & (low_mm > 0) & (variance < UNKNOWN_VARIANCE)
    return np.where(is_usable, np.maximum(variance, LEAST_VARIANCE), UNKNOWN_VARIANCE)


def _fit(
    scaled: np.ndarray,
    log_a90: np.ndarray,
    variances: np.ndarray,
    terms: tuple[tuple[int, ...], ...],
) -> Fit:
    """Fit ln a90 (n,) at scaled places (n, k) by least squares, weighted by 1 / variance. The
    residuals widen the covariance if they are larger than the variances say."""
    design = _design(scaled, terms)
    weights = 1.0 / variances
    inverse = np.linalg.pinv(design.T @ (weights[:, None] * design))
    coefficients = inverse @ (design.T @ (weights * log_a90))
    residuals = log_a90 - design @ coefficients
    degrees = len(residuals) - len(terms)
    leverage = np.einsum("ij,jk,ik->i", design, inverse, design) * weights
    left_out = residuals / np.maximum(1.0 - leverage, LEAST_FREE)
    scale = max(1.0, float((weights * residuals**2).sum()) / degrees)
    return Fit(
        terms=terms,
        coefficients=coefficients,
        covariance=inverse * scale,
        degrees=degrees,
        error=float(np.sqrt(np.mean(left_out**2))),
    )


def _scaled(places: np.ndarray, grid: Sequence[Sequence[float]]) -> np.ndarray:
    """Return places (n, k) as logarithms between -1 and 1 over the grid; 0 on an axis with a
    single value."""
    ends = np.log([[values[0], values[-1]] for values in grid])
    half = np.maximum(np.diff(ends, axis=1)[:, 0] / 2, TOLERANCE)
    return np.asarray((np.log(places) - ends.mean(axis=1)) / half)


def _terms(counts: Sequence[int], limits: int) -> tuple[tuple[int, ...], ...]:
    """Return products of axes: squares of axes with three values, then products of two axes, as
    many as the number of ``limits`` allows; too few limits get none."""
    varied = [axis for axis, count in enumerate(counts) if count > 1]
    plane: list[tuple[int, ...]] = [()]
    plane += [(axis,) for axis in varied]
    products: list[tuple[int, ...]] = [(axis, axis) for axis in varied if counts[axis] > 2]
    products += combinations(varied, 2)
    room = limits - 2 - len(plane)
    return tuple(plane + products[:room]) if room >= 0 else ()


def _design(scaled: np.ndarray, terms: Iterable[tuple[int, ...]]) -> np.ndarray:
    """Return the value of each term at each place (n, t)."""
    return np.stack([np.prod(scaled[:, list(term)], axis=1) for term in terms], axis=1)
