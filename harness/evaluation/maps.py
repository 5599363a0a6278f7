"""Maps of several views: the set-ups that make them, and each map beside a single view on the same repeats.

The same frames feed both maps of a comparison, so that differences are paired. Intervals are over repeats, which vary
the noise and the error of the nominal poses. Thresholds were calibrated once for each set-up, and the draw of that
calibration is in no interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.intervals import UNKNOWN, Interval, bootstrap, mean_t
from harness.evaluation.set_ups import compare_set_ups, isotonic
from harness.evaluation.summary import HoleState, Measure, found_holes, with_columns
from harness.tables.trials import ResultTables
from harness.vocabulary.path_names import value_text

if TYPE_CHECKING:
    import pandas as pd

VIEWS, REGISTRATION, MERGE = "mapping.views", "mapping.registration.method", "mapping.merge.kind"
"""The axes that this room knows by name."""
MANY = 50
"""Frames a view that maps are compared with, where they have them."""
THESIS_REGISTRATION, THESIS_MERGE = "cpd", "grid"
LARGE_MM = 25.4 * 3 / 8
"""Diameter from which on two views are said to size better than one."""
FEWEST_BOTH = 2
"""Repeats in which a hole must be measured in both maps to be compared."""


# set-ups


@dataclass(frozen=True)
class MapSetUp:
    """One set-up or variation. ``views`` is 0 where the axis says "all" and no run was finished; ``registration`` and
    ``merge`` are empty where no axis tells; ``place``: the other axes' values as text; ``reference``: of a variation
    the set-up to compare it with, or empty."""

    variant: str
    views: int
    registration: str
    merge: str
    place: str
    is_variation: bool
    reference: str


def maps_of(tables: ResultTables) -> list[MapSetUp]:
    """List all set-ups and variations in the table's order. For "all views" the runs tell their number."""
    others = [str(path) for path in tables.axes["path"] if path not in (VIEWS, REGISTRATION, MERGE)]
    runs, seen = tables.runs, dict[str, int]()
    if not runs.empty and "views_used" in runs:
        there = (runs["views_used"] + runs["views_left_out"]).groupby(runs["variant"]).max().dropna()
        seen = {str(variant): int(count) for variant, count in there.items()}

    def views(value: Any, seen: int) -> int:
        try:
            return int(float(value))
        except (TypeError, ValueError, OverflowError):
            return seen

    def word(value: Any) -> str:
        return value if isinstance(value, str) and value != "null" else ""

    return [
        MapSetUp(
            variant=str(row["variant"]),
            views=views(row.get(VIEWS), seen.get(str(row["variant"]), 0)),
            registration=word(row.get(REGISTRATION)),
            merge=word(row.get(MERGE)),
            place=", ".join(value_text(path, row[path]) for path in others),
            is_variation=bool(row["is_variation"]),
            reference=str(row["reference"]),
        )
        for _, row in tables.variants.iterrows()
    ]


def compare_maps(tables: ResultTables, summary: pd.DataFrame) -> pd.DataFrame:
    """Rows of `compare_set_ups` for all set-ups and variations that have a map, with the fields of `MapSetUp`, and over
    the runs on the damaged board: ``views_left_out`` (mean of a run), ``seconds_map`` (median), ``surface_std_mm`` (of
    the surface noise over runs)."""
    import pandas as pd

    maps = pd.DataFrame([asdict(one) for one in maps_of(tables)])
    compared = compare_set_ups(tables, summary, [str(name) for name in maps["variant"]], half_sizes=False)
    if compared.empty:
        return compared
    runs = tables.runs[tables.runs["role"] == "damaged"].groupby(["variant", "frames"], as_index=False)
    means = runs.agg(
        views_left_out=("views_left_out", "mean"),
        seconds_map=("seconds_map", "median"),
        surface_std_mm=("surface_noise_mm", "std"),
    )
    return compared.merge(maps, "left", "variant").merge(means, "left", ["variant", "frames"])


def label_of(registration: str, merge: str, place: str = "") -> str:
    """Name a way to make a map: ``cpd, grid``."""
    return ", ".join(part for part in (registration, merge, place) if part) or "as declared"


# paired differences


@dataclass(frozen=True)
class Change:
    """A mean difference (second less first) with its interval over ``n`` repeats."""

    mean: float
    interval: Interval
    n: int

    @property
    def is_above(self) -> bool | None:
        """True where surely above zero, False where surely not, None where the interval has room for both."""
        return True if self.interval.above(0) else False if self.interval.high <= 0 else None

    @property
    def is_below(self) -> bool | None:
        """True where surely below zero, False where surely not, None where the interval has room for both."""
        return True if self.interval.below(0) else False if self.interval.low >= 0 else None


@dataclass(frozen=True)
class SizeErrors:
    """|measured - true diameter| in mm of holes measured in both of two maps, repeat by repeat.

    ``holes`` (h,) names and ``diameters_mm`` (h,), ascending; ``first_mm`` and ``second_mm`` (repeats, h), NaN where
    either map lacks the hole.
    """

    holes: tuple[str, ...]
    diameters_mm: np.ndarray
    first_mm: np.ndarray
    second_mm: np.ndarray

    @property
    def differences_mm(self) -> np.ndarray:
        """(repeats, h) second less first."""
        return np.asarray(self.second_mm - self.first_mm)

    def change(self, of: np.ndarray | None = None) -> Change:
        """Average over the holes ``of`` (h,) bool: the mean over repeats of each repeat's mean difference."""
        chosen = self.differences_mm[:, of] if of is not None else self.differences_mm
        there = np.isfinite(chosen)
        usable = there.any(axis=1)
        return change_of(np.where(there, chosen, 0.0).sum(axis=1)[usable] / there.sum(axis=1)[usable])

    def by_hole(self) -> list[Change]:
        """Average for each hole alone."""
        return [change_of(column[np.isfinite(column)]) for column in self.differences_mm.T]

    @property
    def crossing_mm(self) -> float:
        """The diameter above which the second map sizes better, see `crossing_of`."""
        return float(self._crossings(np.arange(len(self.first_mm))[None])[0])

    @property
    def crossing_interval(self) -> Interval:
        """Its 95 % interval by bootstrap over repeats; unknown where most draws have no crossing."""
        return bootstrap(self._crossings, len(self.first_mm))

    def _crossings(self, chosen: np.ndarray) -> np.ndarray:
        drawn = self.differences_mm[chosen]
        there = np.isfinite(drawn)
        with np.errstate(invalid="ignore"):  # a hole that a draw lacks leaves that draw without an answer
            means = np.where(there, drawn, 0.0).sum(axis=1) / there.sum(axis=1)
        return crossing_of(self.diameters_mm, means)


def change_of(differences: np.ndarray) -> Change:
    """Average one difference for each repeat, with Student's interval; unknown below two."""
    n = len(differences)
    if n < 2:
        return Change(np.nan, UNKNOWN, 0)
    mean, std = float(differences.mean()), float(differences.std(ddof=1))
    low, high = mean_t(mean, std, n)
    return Change(mean, Interval(float(low), float(high)), n)


def crossing_of(diameters_mm: np.ndarray, changes_mm: np.ndarray) -> np.ndarray:
    """Find (n,) where changes (n, h) of the error against ascending diameters (h,) turn from above zero to below.

    The changes are made falling by isotonic regression and interpolated linearly; NaN where they do not cross zero.
    """
    if changes_mm.shape[1] < 2:
        return np.full(len(changes_mm), np.nan)
    bad = ~np.isfinite(changes_mm).all(axis=1)
    falling = -isotonic(-np.where(bad[:, None], 0.0, changes_mm))
    after = np.argmax(falling < 0, axis=1)
    crosses = (falling[:, 0] > 0) & (falling[:, -1] < 0) & ~bad
    rows, before = np.arange(len(falling)), np.maximum(after - 1, 0)
    high, low = falling[rows, before], falling[rows, after]
    share = np.where(crosses, high / np.where(high > low, high - low, 1.0), 0.0)
    found = diameters_mm[before] + share * (diameters_mm[after] - diameters_mm[before])
    return np.where(crosses, found, np.nan)


def size_errors(first: pd.DataFrame, second: pd.DataFrame, measure: Measure = "extent") -> SizeErrors:
    """Pair the table of holes' rows of two maps, each of one set-up and one number of frames; holes that both measure
    in `FEWEST_BOTH` repeats at least."""
    tables = [
        rows.assign(error=(rows[f"{measure}_diameter_mm"] - rows["true_diameter_mm"]).abs()).pivot(
            index="repeat", columns="hole", values="error"
        )
        for rows in (first, second)
    ]
    diameters = first.groupby("hole")["true_diameter_mm"].first()
    holes = [hole for hole in tables[0].columns if hole in tables[1].columns]
    holes.sort(key=lambda hole: float(diameters[hole]))
    repeats = tables[0].index.intersection(tables[1].index)
    one, two = (table.loc[repeats, holes].to_numpy(float) for table in tables)
    both = np.isfinite(one) & np.isfinite(two)
    kept = both.sum(axis=0) >= FEWEST_BOTH
    names = [hole for hole, enough in zip(holes, kept, strict=True) if enough]
    sizes = np.array([float(diameters[hole]) for hole in names])
    one, two = (np.where(both, errors, np.nan)[:, kept] for errors in (one, two))
    return SizeErrors(tuple(str(name) for name in names), sizes, one, two)


def run_change(first: pd.DataFrame, second: pd.DataFrame, column: str) -> Change:
    """Paired change of a column of the table of runs on the damaged board; ``threshold_mm`` is k times the scale."""
    one, two = (_by_repeat(rows, column) for rows in (first, second))
    return change_of((two - one).dropna().to_numpy(float))


def run_ratio(first: pd.DataFrame, second: pd.DataFrame, column: str) -> Change:
    """Paired change of the natural logarithm of such a column: ``exp`` of it is a ratio."""
    one, two = (np.log(_by_repeat(rows, column)) for rows in (first, second))
    return change_of((two - one).dropna().to_numpy(float))


def _by_repeat(runs: pd.DataFrame, column: str) -> pd.Series:
    damaged = runs[runs["role"] == "damaged"]
    values = damaged["threshold"] * damaged["scale_mm"] if column == "threshold_mm" else damaged[column]
    return values.set_axis(damaged["repeat"])


# one view beside several


@dataclass(frozen=True)
class Map:
    """One map of the experiment: a set-up or variation with one number of frames a view."""

    variant: str
    frames: int
    views: int


@dataclass(frozen=True)
class MapCase:
    """The maps of one place: those of one value of every axis but views, registration and merging.

    ``summary``: of `harness.evaluation.summary.summarise_holes`.
    """

    tables: ResultTables
    summary: pd.DataFrame
    maps: Sequence[MapSetUp]
    place: str

    @property
    def set_ups(self) -> list[MapSetUp]:
        """Those of ``maps`` that are no variation."""
        return [one for one in self.maps if not one.is_variation]

    def variant(self, views: int, registration: str, merge: str) -> str | None:
        """Name the set-up. Of a single view every registration is the same, so that any will do."""
        alike = [one for one in self.set_ups if (one.views, one.merge) == (views, merge)]
        named = [one for one in alike if one.registration == registration]
        chosen = named or (alike if views == 1 else [])
        return chosen[0].variant if chosen else None

    def frames(self, variant: str) -> list[int]:
        """List the numbers of frames that this variant was finished with, ascending."""
        return sorted(int(n) for n in self.summary["frames"][self.summary["variant"] == variant].unique())

    def common_frames(self, *variants: str | None) -> int | None:
        """Choose `MANY` where all of them have it, else the most that all have; None where one is missing."""
        if any(variant is None for variant in variants):
            return None
        shared = set.intersection(*(set(self.frames(variant)) for variant in variants if variant is not None))
        return MANY if MANY in shared else max(shared, default=None)

    def named(self, views: int, registration: str, merge: str, frames: int | None = None) -> Map | None:
        """Find the map of that name with so many frames, by default as `common_frames` chooses."""
        variant = self.variant(views, registration, merge)
        chosen = self.common_frames(variant) if frames is None else frames
        if variant is None or chosen is None or chosen not in self.frames(variant):
            return None
        return Map(variant, chosen, views)

    def single(self, frames: int | None = None) -> Map | None:
        """Find one view alone, by the thesis' merging where that was tried, which leaves a single cloud nearly as it
        is."""
        merges = [THESIS_MERGE, *(one.merge for one in self.set_ups)]
        singles = (self.named(1, THESIS_REGISTRATION, merge, frames) for merge in dict.fromkeys(merges))
        return next((one for one in singles if one is not None), None)

    def holes(self, one: Map) -> pd.DataFrame:
        """Rows of the table of holes of one map."""
        return _rows(with_columns(self.tables.holes), one)

    def runs(self, one: Map) -> pd.DataFrame:
        """Rows of the table of runs of one map."""
        return _rows(self.tables.runs, one)

    def status(self, one: Map) -> dict[str, HoleState]:
        """State of each hole."""
        return found_holes(self.summary, one.variant, one.frames)

    def registrations(self, frames: int) -> pd.DataFrame:
        """Registrations of the set-ups with so many frames."""
        rows = self.tables.registrations
        return rows[(rows["frames"] == frames) & rows["variant"].isin([one.variant for one in self.set_ups])]


def _rows(table: pd.DataFrame, one: Map) -> pd.DataFrame:
    return table[(table["variant"] == one.variant) & (table["frames"] == one.frames)]


@dataclass(frozen=True)
class AgainstOne:
    """Several merged views against the first of them alone, merged in the same way, on the same repeats.

    ``large`` and ``small``: change of |size error| in mm over the holes from `LARGE_MM` on and below; ``threshold``: of
    the calibrated threshold in mm; ``noise``: of the logarithm of the noise of the fitted surface. ``lost`` and
    ``gained``: holes found by the one view alone, by the several views alone.
    """

    one: Map
    several: Map
    sizes: SizeErrors
    large: Change
    small: Change
    threshold: Change
    noise: Change
    lost: tuple[str, ...]
    gained: tuple[str, ...]


def against_one(
    case: MapCase, registration: str, merge: str, views: int = 2, measure: Measure = "extent", frames: int | None = None
) -> AgainstOne | None:
    """Compare with the most frames that both have (`MapCase.common_frames`), or with ``frames``; None where either map
    is missing."""
    variants = case.variant(1, registration, merge), case.variant(views, registration, merge)
    chosen = case.common_frames(*variants) if frames is None else frames
    if chosen is None:
        return None
    one, several = (case.named(n, registration, merge, chosen) for n in (1, views))
    if one is None or several is None:
        return None
    sizes = size_errors(case.holes(one), case.holes(several), measure)
    large = sizes.diameters_mm >= LARGE_MM - 1e-9
    states, runs = (case.status(one), case.status(several)), (case.runs(one), case.runs(several))
    lost, gained = (
        tuple(hole for hole, state in here.items() if state == "found" and there.get(hole) == "missed")
        for here, there in (states, states[::-1])
    )
    return AgainstOne(
        one,
        several,
        sizes,
        large=sizes.change(large),
        small=sizes.change(~large),
        threshold=run_change(*runs, "threshold_mm"),
        noise=run_ratio(*runs, "surface_noise_mm"),
        lost=lost,
        gained=gained,
    )


def map_cases(tables: ResultTables, summary: pd.DataFrame) -> list[MapCase]:
    """Make one case for each place, in the order of the set-ups."""
    maps = maps_of(tables)
    places = dict.fromkeys(one.place for one in maps if not one.is_variation)
    return [MapCase(tables, summary, [one for one in maps if one.place == place], place) for place in places]


# numbers as text


def frames_text(frames: int) -> str:
    """Write ``50 frames a view``."""
    return f"{frames} frame{'s' if frames > 1 else ''} a view"


def span(interval: Interval, digits: int = 2) -> str:
    """Write ``0.10 to 0.20``, or that it is unknown."""
    if not interval.known:
        return "interval unknown"
    low, high = (round(end, digits) + 0.0 for end in (interval.low, interval.high))  # + 0.0 turns -0.0 into 0.0
    return f"{low:.{digits}f} to {high:.{digits}f}"


def change_text(change: Change, unit: str = " mm") -> str:
    """Write ``+0.12 mm (0.05 to 0.19)``."""
    if not np.isfinite(change.mean):
        return "not compared"
    return f"{round(change.mean, 2) + 0.0:+.2f}{unit} ({span(change.interval)})"


def ratio_text(change: Change) -> str:
    """Write a change of a logarithm as a factor: ``× 0.61 (0.60 to 0.62)``."""
    if not np.isfinite(change.mean):
        return "not compared"
    return f"× {np.exp(change.mean):.2f} ({span(Interval(*np.exp([change.interval.low, change.interval.high])))})"
