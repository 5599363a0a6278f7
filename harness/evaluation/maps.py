"""Maps of several views compared with a single view on the same repeats, and the errors of
registrations.

Both maps of a comparison use the same frames, so differences are paired; intervals are over
repeats, which vary noise and pose. Errors of registrations are target registration errors
(Fitzpatrick, West and Maurer 1998) of places on the board: the true error, and the one that the
method predicts."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from harness.evaluation.intervals import UNKNOWN, Interval, bootstrap, mean_t
from harness.evaluation.set_ups import compare_set_ups
from harness.evaluation.summary import HoleState, found_holes, with_columns
from harness.records.trials import ResultTables
from harness.vocabulary.path_names import value_text

VIEWS = "mapping.views"
REGISTRATION = "mapping.registration.method"
MERGE = "mapping.merge.kind"
"""Axes with a special meaning in studies of maps."""
CAMERA_UNIT = "source.camera.unit_seed"
MANY = 50  # number of frames per view at which maps are compared, if they have as many
THESIS_REGISTRATION = "cpd"
THESIS_MERGE = "grid"
# diameter from which two views are claimed to measure sizes better than one view
LARGE_MM = 25.4 * 3 / 8
FEWEST_BOTH = 2  # fewest repeats in which both maps must measure a hole to compare it


@dataclass(frozen=True)
class MapSetUp:
    """One set-up or variation."""

    variant: str
    """Name in the tables."""
    views: int
    """Number of views; 0 for "all" without a finished run."""
    registration: str
    """Method of registration; empty if no axis states it."""
    merge: str
    """Kind of merging; empty if no axis states it."""
    conditions: str
    """The other axes' values as text."""
    is_variation: bool
    """True if it varies a fact of another set-up."""
    reference: str
    """Name of that set-up, or "" for a set-up."""


def maps_of(tables: ResultTables) -> list[MapSetUp]:
    """Return all set-ups and variations in the table's order. For "all views", the runs give the
    number."""
    special = (VIEWS, REGISTRATION, MERGE)
    varied = [str(path) for path in tables.axes["path"] if path not in special]
    most_views = _most_views(tables.runs)
    set_ups = []
    for _, row in tables.variants.iterrows():
        variant = str(row["variant"])
        views = _whole(row.get(VIEWS))
        set_up = MapSetUp(
            variant=variant,
            views=most_views.get(variant, 0) if views is None else views,
            registration=_axis_name(row.get(REGISTRATION)),
            merge=_axis_name(row.get(MERGE)),
            conditions=", ".join(value_text(path, row[path]) for path in varied),
            is_variation=bool(row["is_variation"]),
            reference=str(row["reference"]),
        )
        set_ups.append(set_up)
    return set_ups


def _most_views(runs: pd.DataFrame) -> dict[str, int]:
    """Return by variant the largest number of views of a run, with those that were left out."""
    if runs.empty or "views_used" not in runs:
        return {}
    views = runs["views_used"] + runs["views_left_out"]
    largest = views.groupby(runs["variant"]).max().dropna()
    return {str(variant): int(number) for variant, number in largest.items()}


def _whole(value: Any) -> int | None:
    """Return an axis' value as a number; None for another value, such as "all"."""
    try:
        return int(float(value))
    except (TypeError, ValueError, OverflowError):
        return None


def _axis_name(value: Any) -> str:
    return value if isinstance(value, str) and value != "null" else ""


def compare_maps(tables: ResultTables, summary: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of `compare_set_ups` for all set-ups with a map, and the fields of
    `MapSetUp`. Over runs on the damaged board: mean ``views_left_out``, median ``seconds_map``,
    and the noise's deviation ``surface_std_mm``."""
    maps = pd.DataFrame([asdict(set_up) for set_up in maps_of(tables)])
    variants = [str(name) for name in maps["variant"]]
    compared = compare_set_ups(tables, summary, variants, half_sizes=False)
    if compared.empty:
        return compared
    damaged = tables.runs[tables.runs["role"] == "damaged"]
    means = damaged.groupby(["variant", "frames"], as_index=False).agg(
        views_left_out=("views_left_out", "mean"),
        seconds_map=("seconds_map", "median"),
        surface_std_mm=("surface_noise_mm", "std"),
    )
    return compared.merge(maps, "left", "variant").merge(means, "left", ["variant", "frames"])


@dataclass(frozen=True)
class Change:
    """A mean difference, second minus first."""

    mean: float
    """The mean; NaN below two repeats."""
    interval: Interval
    """Student's interval over repeats."""
    n: int
    """Number of repeats."""

    @property
    def is_below(self) -> bool | None:
        """True if certainly below zero, False if certainly not, None if the interval includes
        both."""
        return Interval(-self.interval.high, -self.interval.low).over(0)


def change_of(differences: np.ndarray) -> Change:
    """Return the mean difference over repeats, without NaN, and Student's interval, unknown below
    two repeats."""
    finite = differences[np.isfinite(differences)]
    if len(finite) < 2:
        return Change(np.nan, UNKNOWN, 0)
    mean = float(finite.mean())
    low, high = mean_t(mean, float(finite.std(ddof=1)), len(finite))
    return Change(mean, Interval(float(low), float(high)), len(finite))


@dataclass(frozen=True)
class SizeErrors:
    """Change (second minus first) of |measured - true diameter| of holes that both maps measure."""

    holes: tuple[str, ...]
    """Names of the holes."""
    diameters_mm: np.ndarray
    """True diameters (h,), ascending."""
    differences_mm: np.ndarray
    """Change (repeats, h); NaN where a map lacks the hole."""

    def change(self, holes: np.ndarray | None = None) -> Change:
        """Return the mean over repeats of the mean difference over ``holes`` (h,) bool."""
        chosen = self.differences_mm if holes is None else self.differences_mm[:, holes]
        valid = np.isfinite(chosen)
        total = np.where(valid, chosen, 0.0).sum(axis=1)
        with np.errstate(invalid="ignore"):
            return change_of(total / valid.sum(axis=1))


def size_errors(first: pd.DataFrame, second: pd.DataFrame) -> SizeErrors:
    """Pair the rows of two maps in the table of holes, each of one set-up and number of frames;
    see `FEWEST_BOTH`."""

    def errors(rows: pd.DataFrame) -> pd.DataFrame:
        error = (rows["extent_diameter_mm"] - rows["true_diameter_mm"]).abs()
        return rows.assign(error=error).pivot(index="repeat", columns="hole", values="error")

    change = (errors(second) - errors(first)).dropna(axis="columns", thresh=FEWEST_BOTH)
    diameters = first.groupby("hole")["true_diameter_mm"].first().astype(float)
    holes = sorted(change.columns, key=lambda hole: diameters[hole])
    sizes = np.array([diameters[hole] for hole in holes])
    differences = np.asarray(change[holes], float)
    return SizeErrors(tuple(map(str, holes)), sizes, differences)


def run_ratio(
    first: pd.DataFrame,
    second: pd.DataFrame,
    column: str,
) -> Change:
    """Return the paired change of a column's logarithm over runs on the damaged board; its ``exp``
    is a ratio."""
    ratio = _by_repeat(second)[column] / _by_repeat(first)[column]
    return change_of(np.log(ratio.to_numpy(float)))


def _by_repeat(runs: pd.DataFrame) -> pd.DataFrame:
    return runs[runs["role"] == "damaged"].set_index("repeat")


@dataclass(frozen=True)
class Map:
    """One map of the experiment."""

    variant: str
    """Name of its set-up or variation."""
    frames: int
    """Number of frames per view."""
    views: int
    """Number of views."""


@dataclass(frozen=True)
class MapCase:
    """The maps under the same conditions: one value of every axis except views, registration and
    merging."""

    tables: ResultTables
    """Tables of the whole experiment."""
    summary: pd.DataFrame
    """Rows of `harness.evaluation.summary.summarise_holes`."""
    maps: Sequence[MapSetUp]
    """The set-ups and variations of the case."""
    conditions: str
    """The other axes' values as text."""
    without_unit: str = ""
    """These without the camera's unit."""

    @property
    def set_ups(self) -> list[MapSetUp]:
        """Maps of set-ups, without variations."""
        return [set_up for set_up in self.maps if not set_up.is_variation]

    def variant(
        self,
        views: int,
        registration: str,
        merge: str,
    ) -> str | None:
        """Return the name of the set-up. All registrations of a single view are the same, so any
        of them will do."""
        merged = [
            set_up for set_up in self.set_ups if set_up.views == views and set_up.merge == merge
        ]
        for set_up in merged:
            if set_up.registration == registration:
                return set_up.variant
        return merged[0].variant if merged and views == 1 else None

    def frames(self, variant: str) -> list[int]:
        """Return the numbers of frames with which this variant was finished, ascending."""
        finished = self.summary["frames"][self.summary["variant"] == variant]
        return sorted(int(frames) for frames in finished.unique())

    def common_frames(self, *variants: str | None) -> int | None:
        """Return `MANY` if all variants have it, else the most that all have; None if a variant is
        missing."""
        finished = []
        for variant in variants:
            if variant is None:
                return None
            finished.append(set(self.frames(variant)))
        shared = set.intersection(*finished)
        return MANY if MANY in shared else max(shared, default=None)

    def named(
        self,
        views: int,
        registration: str,
        merge: str,
        frames: int | None = None,
    ) -> Map | None:
        """Return the map of that name with this number of frames (default: that of
        `common_frames`), if any."""
        variant = self.variant(views, registration, merge)
        chosen = self.common_frames(variant) if frames is None else frames
        if variant is None or chosen is None or chosen not in self.frames(variant):
            return None
        return Map(variant, chosen, views)

    def single(self, frames: int | None = None) -> Map | None:
        """Return the map of a single view, by the thesis' merging if that was tried."""
        merges = [THESIS_MERGE, *(set_up.merge for set_up in self.set_ups)]
        for merge in dict.fromkeys(merges):
            single = self.named(1, THESIS_REGISTRATION, merge, frames)
            if single is not None:
                return single
        return None

    def holes(self, chosen: Map) -> pd.DataFrame:
        """Return the rows of one map in the table of holes."""
        return _rows(with_columns(self.tables.holes), chosen)

    def runs(self, chosen: Map) -> pd.DataFrame:
        """Return the rows of one map in the table of runs."""
        return _rows(self.tables.runs, chosen)

    def status(self, chosen: Map) -> dict[str, HoleState]:
        """Return the state of each hole."""
        return found_holes(self.summary, chosen.variant, chosen.frames)

    def registrations(self, frames: int) -> pd.DataFrame:
        """Return the registrations of the set-ups with this number of frames."""
        rows = self.tables.registrations
        variants = [set_up.variant for set_up in self.set_ups]
        return rows[(rows["frames"] == frames) & rows["variant"].isin(variants)]


def _rows(table: pd.DataFrame, chosen: Map) -> pd.DataFrame:
    of_variant = table["variant"] == chosen.variant
    of_frames = table["frames"] == chosen.frames
    return table[of_variant & of_frames]


def map_cases(tables: ResultTables, summary: pd.DataFrame) -> list[MapCase]:
    """Make one case for each set of conditions, in the order of the set-ups."""
    maps = maps_of(tables)
    variants = tables.variants
    if CAMERA_UNIT in variants:
        variants = variants.assign(**{CAMERA_UNIT: ""})
    maps_without_unit = maps_of(replace(tables, variants=variants))
    without_unit = {set_up.variant: set_up.conditions for set_up in maps_without_unit}
    cases = []
    for conditions in dict.fromkeys(
        set_up.conditions for set_up in maps if not set_up.is_variation
    ):
        group = [set_up for set_up in maps if set_up.conditions == conditions]
        first = group[0].variant
        cases.append(MapCase(tables, summary, group, conditions, without_unit[first]))
    return cases


@dataclass(frozen=True)
class AgainstOne:
    """Several merged views compared with the first view on the same repeats."""

    frames: int
    """Number of frames per view of both maps."""
    sizes: SizeErrors
    """Change of |size error| by hole."""
    large: Change
    """Change of |size error| in mm over the holes from `LARGE_MM`."""
    small: Change
    """The same over the holes below."""
    threshold: Change
    """Change of the calibrated threshold in mm."""
    noise: Change
    """Change of the logarithm of the surface noise."""
    lost: tuple[str, ...]
    """Holes found only by the single view."""
    gained: tuple[str, ...]
    """Holes found only by the several views."""


def against_one(
    case: MapCase,
    registration: str,
    merge: str,
) -> AgainstOne | None:
    """Compare two views with the most frames that both have (`MapCase.common_frames`); None if a
    map is missing."""
    of_one = case.variant(1, registration, merge)
    of_two = case.variant(2, registration, merge)
    frames = case.common_frames(of_one, of_two)
    if frames is None:
        return None
    single = case.named(1, registration, merge, frames)
    several = case.named(2, registration, merge, frames)
    assert single is not None and several is not None
    sizes = size_errors(case.holes(single), case.holes(several))
    large = sizes.diameters_mm >= LARGE_MM - 1e-9
    before = case.runs(single)
    after = case.runs(several)
    threshold_mm = _threshold_mm(after) - _threshold_mm(before)
    return AgainstOne(
        frames=frames,
        sizes=sizes,
        large=sizes.change(large),
        small=sizes.change(~large),
        threshold=change_of(threshold_mm.to_numpy(float)),
        noise=run_ratio(before, after, "surface_noise_mm"),
        lost=_found_only(case.status(single), case.status(several)),
        gained=_found_only(case.status(several), case.status(single)),
    )


def _threshold_mm(runs: pd.DataFrame) -> pd.Series:
    rows = _by_repeat(runs)
    return rows["threshold"] * rows["scale_mm"]


def _found_only(first: dict[str, HoleState], second: dict[str, HoleState]) -> tuple[str, ...]:
    """Return the holes that the first map finds and the second misses."""
    return tuple(
        hole for hole, state in first.items() if state == "found" and second.get(hole) == "missed"
    )


def label_of(
    registration: str,
    merge: str,
    conditions: str = "",
) -> str:
    """Return the name of a way to make a map: ``cpd, grid``."""
    stated = [part for part in (registration, merge, conditions) if part]
    return ", ".join(stated) or "as declared"


def frames_text(frames: int) -> str:
    """Return ``50 frames a view``."""
    return f"{frames} frame{'s' if frames > 1 else ''} a view"


def span(interval: Interval, digits: int = 2) -> str:
    """Return ``0.10 to 0.20``, or that the interval is unknown."""
    if not interval.known:
        return "interval unknown"
    # + 0.0 turns -0.0 into 0.0
    low = round(interval.low, digits) + 0.0
    high = round(interval.high, digits) + 0.0
    return f"{low:.{digits}f} to {high:.{digits}f}"


def change_text(change: Change) -> str:
    """Return ``+0.12 mm (0.05 to 0.19)``."""
    if not np.isfinite(change.mean):
        return "not compared"
    return f"{round(change.mean, 2) + 0.0:+.2f} mm ({span(change.interval)})"


def ratio_text(change: Change) -> str:
    """Return a change of a logarithm as a factor: ``× 0.61 (0.60 to 0.62)``."""
    if not np.isfinite(change.mean):
        return "not compared"
    low, high = np.exp([change.interval.low, change.interval.high])
    return f"× {np.exp(change.mean):.2f} ({span(Interval(low, high))})"


PARTS = ("in_plane", "across")
UNIT = ["frames", "repeat", "role"]
"""The columns that identify one draw of noise and of nominal poses, which intervals resample."""
MOST_REASONS = 3


def of_map(
    registrations: pd.DataFrame,
    method: str,
    views: int,
) -> pd.DataFrame:
    """Return the registrations behind a map of this number of views: those of exactly ``views``,
    else of the nearest number, since a method that registers each view alone gives the same result
    for any number."""
    rows = registrations[(registrations["method"] == method) & (registrations["view"] < views)]
    if VIEWS not in rows:
        return rows
    # "all views" counts as more than any number
    numbers = pd.to_numeric(rows[VIEWS], errors="coerce").fillna(np.inf)
    order = rows.assign(_distance=numbers.sub(views).abs()).sort_values("_distance", kind="stable")
    return order.drop_duplicates([*UNIT, "view"]).drop(columns="_distance").sort_index()


def summarise_registrations(registrations: pd.DataFrame) -> pd.DataFrame:
    """Return one row per method and number of frames: numbers, failures, and the errors of those
    that did not fail. For both `PARTS`: median, root mean square, the value that covariances
    predict, and the ``_ratio`` of actual to predicted (1: honest, above 1: too sure) with a
    bootstrap over repeats. ``guess_mm``: error of the initial guess."""
    groups = registrations.groupby(["method", "frames"], sort=False)
    rows = []
    for (method, frames), part in groups:
        rows.append({"method": method, "frames": frames, **_summary(part)})
    return pd.DataFrame(rows)


def by_views(registrations: pd.DataFrame, counts: Sequence[int]) -> pd.DataFrame:
    """Summarise registrations by method and frames for each number of views, given in the column
    ``views``."""
    parts = []
    for method in dict.fromkeys(registrations["method"]):
        for views in counts:
            rows = of_map(registrations, method, views)
            if len(rows):
                parts.append(summarise_registrations(rows).assign(views=views))
    if not parts:
        return pd.DataFrame(columns=["method", "frames", "views"])
    return pd.concat(parts, ignore_index=True)


def trusted(registrations: pd.DataFrame) -> pd.DataFrame:
    """Return the registrations that did not fail."""
    return registrations[registrations["failure"] == ""]


def per_pair(registrations: pd.DataFrame, column: str) -> pd.Series:
    """Return the root mean square over the repeats of each pair of a view and the first view, for
    registrations that did not fail. Repeats of a pair share its geometry and the fixed pattern, so
    they are not further pairs."""
    rows = trusted(registrations)
    return (rows[column] ** 2).groupby(rows["view"]).mean().pow(0.5)


def paired_ratio(
    first: pd.DataFrame,
    second: pd.DataFrame,
    column: str,
) -> tuple[float, float, float, int]:
    """Return the geometric mean of second / first over pairs of views, Student's interval, number;
    NaN below two."""
    pairs = pd.concat(
        [per_pair(first, column).rename("first"), per_pair(second, column).rename("second")],
        axis=1,
        join="inner",
    )
    pairs = pairs[(pairs > 0).all(axis=1)]
    if len(pairs) < 2:
        return np.nan, np.nan, np.nan, len(pairs)
    logs = np.log((pairs["second"] / pairs["first"]).to_numpy(float))
    low, high = mean_t(logs.mean(), logs.std(ddof=1), len(logs))
    return float(np.exp(logs.mean())), float(np.exp(low)), float(np.exp(high)), len(logs)


def _summary(part: pd.DataFrame) -> dict[str, Any]:
    """Return the columns of `summarise_registrations` of one group."""
    good = trusted(part)
    failures = part.loc[part["failure"] != "", "failure"]
    counts = [(str(reason), int(n)) for reason, n in failures.value_counts(sort=False).items()]
    counts.sort(key=lambda reason_and_count: (-reason_and_count[1], reason_and_count[0]))
    row: dict[str, Any] = {
        "n": len(part),
        "failed": len(failures),
        "reasons": [f"{reason} ({count})" for reason, count in counts[:MOST_REASONS]],
        "guess_mm": float(part["guess_tre_mm"].median()),
        "seconds": float(part["seconds"].astype(float).median()),
    }
    for name in PARTS:
        row.update(_error_summary(good, name))
    return row


def _error_summary(good: pd.DataFrame, name: str) -> dict[str, float]:
    """Return the columns on errors in one of `PARTS`, of registrations that did not fail."""
    errors = good[[f"tre_{name}_mm", f"predicted_{name}_mm"]].astype(float)
    errors = errors.where(np.isfinite(errors)).set_axis(["actual", "predicted"], axis="columns")
    actual = errors["actual"]
    complete = errors.notna().all(axis=1)
    squares = errors[complete] ** 2
    predicted = float(np.sqrt(squares["predicted"].mean()))
    ratio = np.nan
    interval = UNKNOWN
    if predicted > 0:
        # units resampled
        units = [good.loc[complete, key] for key in UNIT]
        sums = np.asarray(squares.groupby(units).sum(), float)
        ratio = _ratio(sums, np.arange(len(sums))[None]).item()
        interval = bootstrap(partial(_ratio, sums), len(sums))
    return {
        f"{name}_median_mm": float(actual.median()),
        f"{name}_rms_mm": float(np.sqrt((actual**2).mean())),
        f"{name}_predicted_mm": predicted,
        f"{name}_ratio": ratio,
        f"{name}_ratio_low": interval.low,
        f"{name}_ratio_high": interval.high,
    }


def _ratio(sums: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return the ratios (draws,) of actual to predicted root mean square. ``sums`` (n, 2): of
    squares by `UNIT`."""
    total = sums[chosen].sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(total[:, 0] / total[:, 1]))
