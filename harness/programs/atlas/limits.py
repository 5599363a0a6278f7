"""The atlas of limits: for each camera, kind of damage and detector, a90 of many set-ups as a
smooth surface over distance, frames, depth and albedo. It answers questions within the computed
range and refuses others.

The surface is a quadratic of ln a90 in the logarithms of the axes, by least squares weighted with
each limit's own interval. Its stated error is the root mean square error of ln a90 at each set-up
when the others predict it."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pandas as pd
from scipy import special

from harness.evaluation.intervals import UPPER

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
UNKNOWN_VARIANCE = (
    # variance of ln a90 if an interval has no positive lower end: a factor of 1.65 either way
    0.25
)
TOLERANCE = 1e-9


class Outside(Exception):
    """A question that the atlas cannot answer; the text gives the reason and the range of possible
    questions."""


@dataclass(frozen=True)
class Answer:
    """a90 in mm with the ends of its interval at `CONFIDENCE`; all NaN if a set-up around it has
    no limit. ``largest_mm``: the largest size inspected; without a limit NaN, unless all set-ups
    around it miss it too."""

    a90_mm: float
    low_mm: float
    high_mm: float
    largest_mm: float

    def verdict(self, size_mm: float) -> str:
        """Return whether damage of this size is found nine times out of ten: yes, no or undecided."""
        if np.isnan(self.a90_mm):
            return "no" if size_mm <= self.largest_mm else "undecided"
        return "yes" if self.high_mm <= size_mm else "no" if self.low_mm > size_mm else "undecided"


@dataclass(frozen=True)
class LimitSurface:
    """Limits of one camera, kind of damage and detector. ``grid``: the values that were computed
    on each axis. ``nodes`` (n, k): the set-ups' places, axes in the order of ``grid``.
    ``largest_mm`` (n,): the largest size inspected at each. ``known`` (n,): whether a limit was
    found. ``beyond`` (n,): whether it lies above all sizes. ``damage``: declaration of the first
    set-up's damage, as JSON. ``error``: of ln a90, leaving each set-up out."""

    camera: str
    kind: str
    detector: str
    grid: Mapping[str, tuple[float, ...]]
    nodes: np.ndarray
    largest_mm: np.ndarray
    known: np.ndarray
    beyond: np.ndarray
    damage: str
    coefficients: np.ndarray
    covariance: np.ndarray
    terms: tuple[tuple[int, ...], ...]
    degrees: int
    error: float

    def at(self, **place: float) -> Answer:
        """Return the limit at a place: a value for each axis of ``grid``. Raises Outside beyond
        the computed range."""
        ends = {axis: values for axis, values in self.grid.items() if axis in place}
        for axis, values in ends.items():
            if not values[0] - TOLERANCE <= place[axis] <= values[-1] + TOLERANCE:
                only = (
                    f"{values[0]:g} to {values[-1]:g}" if len(values) > 1 else f"{values[0]:g} only"
                )
                name, _, unit = axis.partition("_")
                raise Outside(
                    f"{name} {place[axis]:g} {unit}".rstrip()
                    + f": the atlas has {only} {unit}".rstrip()
                )
        wanted = np.array([place.get(axis, values[0]) for axis, values in self.grid.items()])
        around = np.all([self._near(k, value) for k, value in enumerate(wanted)], axis=0)
        largest_mm = float(self.largest_mm[around].min()) if around.any() else float("nan")
        if not around.any() or not self.known[around].all() or not len(self.coefficients):
            unknown = float("nan")
            return Answer(
                unknown, unknown, unknown, largest_mm if self.beyond[around].all() else unknown
            )
        row = _rows(_scaled(wanted[None], list(self.grid.values())), self.terms)[0]
        middle = float(row @ self.coefficients)
        spread = np.hypot(np.sqrt(row @ self.covariance @ row), self.error)
        half = float(special.stdtrit(self.degrees, UPPER) * spread)
        a90 = float(np.exp(middle + 0.0))
        low = float(np.exp(middle + -half))
        high = float(np.exp(middle + half))
        return Answer(a90, low, high, largest_mm)

    def _near(self, axis: int, value: float) -> np.ndarray:
        """Return the nodes of the cell that holds a value: at its neighbours on the axis, or at
        the value itself."""
        values = np.array(list(self.grid.values())[axis])
        low = values[values <= value + TOLERANCE].max()
        high = values[values >= value - TOLERANCE].min()
        return np.asarray(
            np.isclose(self.nodes[:, axis], low) | np.isclose(self.nodes[:, axis], high)
        )


def surfaces_of(limits: pd.DataFrame) -> list[LimitSurface]:
    """Return the surfaces of a table of `LIMITS` by camera, kind and detector. Raises KeyError if
    it lacks an axis."""
    rows = limits.copy()
    damages = [json.loads(text) for text in rows[DAMAGE]]
    rows["kind"] = [damage["kind"] for damage in damages]
    rows["depth_mm"] = [float(np.mean(damage.get("depth_mm") or [np.nan])) for damage in damages]
    if DETECTOR not in rows:
        rows[DETECTOR] = rows["detector"]
    held = {axis: column for axis, column in AXES.items() if column in rows}
    rows = rows.rename(columns={column: axis for axis, column in held.items()})
    groups = [
        (group, group.iloc[0]) for _, group in rows.groupby([CAMERA, "kind", DETECTOR], sort=False)
    ]
    return [
        _surface(key[CAMERA], key["kind"], key[DETECTOR], group, list(held))
        for group, key in groups
    ]


def _surface(
    camera: str, kind: str, detector: str, rows: pd.DataFrame, axes: Sequence[str]
) -> LimitSurface:
    axes = [axis for axis in axes if rows[axis].notna().all()]
    grid = {axis: tuple(float(value) for value in np.unique(rows[axis])) for axis in axes}
    nodes = rows[axes].to_numpy(float)
    columns = ("a90_mm", "a90_low_mm", "a90_high_mm", "largest_mm")
    a90, low, high, largest = (rows[name].to_numpy(float) for name in columns)
    known = np.isfinite(a90) & (a90 <= largest) & ~rows["is_at_most"].to_numpy(bool)
    beyond = (a90 > largest) | (rows["hits"].to_numpy() == 0)
    with np.errstate(all="ignore"):
        variance = (np.log(high / low) / (2 * special.ndtri(UPPER))) ** 2
    sure = np.isfinite(variance) & (low > 0) & (variance < UNKNOWN_VARIANCE)
    variance = np.where(sure, np.maximum(variance, 1e-4), UNKNOWN_VARIANCE)
    scaled = _scaled(nodes, list(grid.values()))
    terms = _terms([len(values) for values in grid.values()], int(known.sum()))
    fixed = (camera, kind, detector, grid, nodes, largest, known, beyond, rows.iloc[0][DAMAGE])
    if not terms:
        return LimitSurface(*fixed, np.zeros(0), np.zeros((0, 0)), (), 0, float("nan"))
    design = _rows(scaled[known], terms)
    weights = 1.0 / variance[known]
    inverse = np.linalg.pinv(design.T @ (weights[:, None] * design))
    coefficients = inverse @ (design.T @ (weights * np.log(a90[known])))
    residuals = np.log(a90[known]) - design @ coefficients
    degrees = len(residuals) - len(terms)
    leverage = np.einsum("ij,jk,ik->i", design, inverse, design) * weights
    left_out = residuals / np.maximum(1.0 - leverage, 0.05)
    scale = max(1.0, float((weights * residuals**2).sum()) / degrees)
    return LimitSurface(
        *fixed, coefficients, inverse * scale, terms, degrees, float(np.sqrt(np.mean(left_out**2)))
    )


def _scaled(places: np.ndarray, grid: Sequence[Sequence[float]]) -> np.ndarray:
    """Return places (n, k) as logarithms between -1 and 1 over the grid; 0 on an axis with a
    single value."""
    ends = np.log([[values[0], values[-1]] for values in grid])
    half = np.maximum(np.diff(ends, axis=1)[:, 0] / 2, TOLERANCE)
    return np.asarray((np.log(places) - ends.mean(axis=1)) / half)


def _terms(counts: Sequence[int], known: int) -> tuple[tuple[int, ...], ...]:
    """Return products of axes: squares of axes with three values, then products of two axes; few
    set-ups get none."""
    varied = [axis for axis, count in enumerate(counts) if count > 1]
    plane: list[tuple[int, ...]] = [(), *((axis,) for axis in varied)]
    further: list[tuple[int, ...]] = [(axis, axis) for axis in varied if counts[axis] > 2]
    further += combinations(varied, 2)
    room = known - 2 - len(plane)
    return tuple(plane + further[:room]) if room >= 0 else ()


def _rows(scaled: np.ndarray, terms: Iterable[tuple[int, ...]]) -> np.ndarray:
    return np.stack([np.prod(scaled[:, list(term)], axis=1) for term in terms], axis=1)
