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
LARGE_MM = (
    25.4 * 3 / 8
)  # diameter from which two views are claimed to measure sizes better than one view
FEWEST_BOTH = 2  # fewest repeats in which both maps must measure a hole to compare it


@dataclass(frozen=True)
class MapSetUp:
    """One set-up or variation. ``views``: 0 for "all" without a finished run. ``registration``,
    ``merge``: empty if no axis states them. ``conditions``: the other axes' values as text.
    ``reference``: the set-up of a variation, or ""."""

    variant: str
    views: int
    registration: str
    merge: str
    conditions: str
    is_variation: bool
    reference: str


def maps_of(tables: ResultTables) -> list[MapSetUp]:
    """Return all set-ups and variations in the table's order. For "all views", the runs give the
    number."""
    varied = [str(path) for path in tables.axes["path"] if path not in (VIEWS, REGISTRATION, MERGE)]
    runs = tables.runs
    seen = dict[Any, Any]()
    if not runs.empty and "views_used" in runs:
        seen = (
            (runs["views_used"] + runs["views_left_out"])
            .groupby(runs["variant"])
            .max()
            .dropna()
            .to_dict()
        )

    def views(row: pd.Series) -> int:
        try:
            return int(float(row.get(VIEWS)))  # type: ignore[arg-type]
        except (TypeError, ValueError, OverflowError):
            return int(seen.get(row["variant"], 0))

    found = []
    for _, row in tables.variants.iterrows():
        named = [row.get(axis) for axis in (REGISTRATION, MERGE)]
        ways = [name if isinstance(name, str) and name != "null" else "" for name in named]
        place = ", ".join(value_text(path, row[path]) for path in varied)
        facts = place, bool(row["is_variation"]), str(row["reference"])
        found.append(MapSetUp(str(row["variant"]), views(row), ways[0], ways[1], *facts))
    return found


def compare_maps(tables: ResultTables, summary: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of `compare_set_ups` for all set-ups with a map, and the fields of
    `MapSetUp`. Over runs on the damaged board: mean ``views_left_out``, median ``seconds_map``,
    and the noise's deviation ``surface_std_mm``."""
    maps = pd.DataFrame([asdict(each) for each in maps_of(tables)])
    compared = compare_set_ups(
        tables, summary, [str(name) for name in maps["variant"]], half_sizes=False
    )
    if compared.empty:
        return compared
    columns = {
        "views_left_out": ("views_left_out", "mean"),
        "seconds_map": ("seconds_map", "median"),
    }
    columns |= {"surface_std_mm": ("surface_noise_mm", "std")}
    means = (
        tables.runs[tables.runs["role"] == "damaged"]
        .groupby(["variant", "frames"], as_index=False)
        .agg(**columns)
    )
    return compared.merge(maps, "left", "variant").merge(means, "left", ["variant", "frames"])


@dataclass(frozen=True)
class Change:
    """A mean difference (second minus first), with its interval over ``n`` repeats."""

    mean: float
    interval: Interval
    n: int

    @property
    def is_below(self) -> bool | None:
        """True if certainly below zero, False if certainly not, None if the interval includes
        both."""
        return Interval(-self.interval.high, -self.interval.low).over(0)


def change_of(differences: np.ndarray) -> Change:
    """Return the mean difference over repeats, without NaN, and Student's interval, unknown below
    two repeats."""
    known = differences[np.isfinite(differences)]
    if len(known) < 2:
        return Change(np.nan, UNKNOWN, 0)
    mean = float(known.mean())
    std = float(known.std(ddof=1))
    return Change(mean, Interval(*map(float, mean_t(mean, std, len(known)))), len(known))


@dataclass(frozen=True)
class SizeErrors:
    """Change (second minus first) of |measured - true diameter|, mm, of holes that both maps
    measure. ``holes`` (h,): names. ``diameters_mm`` (h,): ascending. ``differences_mm`` (repeats,
    h): NaN where a map lacks the hole."""

    holes: tuple[str, ...]
    diameters_mm: np.ndarray
    differences_mm: np.ndarray

    def change(self, of: np.ndarray | None = None) -> Change:
        """Return the mean over repeats of the mean difference over the holes ``of`` (h,) bool."""
        chosen = self.differences_mm if of is None else self.differences_mm[:, of]
        valid = np.isfinite(chosen)
        with np.errstate(invalid="ignore"):
            return change_of(np.where(valid, chosen, 0.0).sum(axis=1) / valid.sum(axis=1))


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


def run_ratio(first: pd.DataFrame, second: pd.DataFrame, column: str) -> Change:
    """Return the paired change of a column's logarithm over runs on the damaged board; its ``exp``
    is a ratio."""
    return change_of(
        np.log((_by_repeat(second)[column] / _by_repeat(first)[column]).to_numpy(float))
    )


def _by_repeat(runs: pd.DataFrame) -> pd.DataFrame:
    return runs[runs["role"] == "damaged"].set_index("repeat")


@dataclass(frozen=True)
class Map:
    """One map of the experiment: a set-up or variation with one number of frames per view."""

    variant: str
    frames: int
    views: int


@dataclass(frozen=True)
class MapCase:
    """The maps of one place: one value of every axis except views, registration and merging.
    ``summary``: of `harness.evaluation.summary.summarise_holes`. ``without_unit``: the place
    without the camera's unit."""

    tables: ResultTables
    summary: pd.DataFrame
    maps: Sequence[MapSetUp]
    conditions: str
    without_unit: str = ""

    @property
    def set_ups(self) -> list[MapSetUp]:
        """Maps of set-ups, without variations."""
        return [each for each in self.maps if not each.is_variation]

    def variant(self, views: int, registration: str, merge: str) -> str | None:
        """Return the name of the set-up. All registrations of a single view are the same, so any
        of them will do."""
        alike = [each for each in self.set_ups if (each.views, each.merge) == (views, merge)]
        chosen = [each for each in alike if each.registration == registration] or (
            alike if views == 1 else []
        )
        return chosen[0].variant if chosen else None

    def frames(self, variant: str) -> list[int]:
        """Return the numbers of frames with which this variant was finished, ascending."""
        return sorted(
            int(n) for n in self.summary["frames"][self.summary["variant"] == variant].unique()
        )

    def common_frames(self, *variants: str | None) -> int | None:
        """Return `MANY` if all variants have it, else the most that all have; None if a variant is
        missing."""
        if any(variant is None for variant in variants):
            return None
        shared = set.intersection(
            *(set(self.frames(variant)) for variant in variants if variant is not None)
        )
        return MANY if MANY in shared else max(shared, default=None)

    def named(
        self, views: int, registration: str, merge: str, frames: int | None = None
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
        merges = [THESIS_MERGE, *(each.merge for each in self.set_ups)]
        singles = (
            self.named(1, THESIS_REGISTRATION, merge, frames) for merge in dict.fromkeys(merges)
        )
        return next((each for each in singles if each is not None), None)

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
        return rows[
            (rows["frames"] == frames)
            & rows["variant"].isin([each.variant for each in self.set_ups])
        ]


def _rows(table: pd.DataFrame, chosen: Map) -> pd.DataFrame:
    return table[(table["variant"] == chosen.variant) & (table["frames"] == chosen.frames)]


def map_cases(tables: ResultTables, summary: pd.DataFrame) -> list[MapCase]:
    """Make one case for each place, in the order of the set-ups."""
    maps = maps_of(tables)
    places = dict.fromkeys(each.conditions for each in maps if not each.is_variation)
    alike = (
        tables.variants.assign(**{CAMERA_UNIT: ""})
        if CAMERA_UNIT in tables.variants
        else tables.variants
    )
    without = {each.variant: each.conditions for each in maps_of(replace(tables, variants=alike))}
    groups = ((place, [each for each in maps if each.conditions == place]) for place in places)
    return [
        MapCase(tables, summary, group, place, without[group[0].variant]) for place, group in groups
    ]


@dataclass(frozen=True)
class AgainstOne:
    """Several merged views compared with the first view on the same repeats. ``large``, ``small``:
    change of |size error| in mm over the holes from `LARGE_MM` and below. ``threshold``: change of
    the calibrated threshold in mm. ``noise``: of the logarithm of the surface noise. ``lost``,
    ``gained``: holes found only by the single view, and only by the several views."""

    frames: int
    sizes: SizeErrors
    large: Change
    small: Change
    threshold: Change
    noise: Change
    lost: tuple[str, ...]
    gained: tuple[str, ...]


def against_one(case: MapCase, registration: str, merge: str) -> AgainstOne | None:
    """Compare two views with the most frames that both have (`MapCase.common_frames`); None if a
    map is missing."""
    frames = case.common_frames(*(case.variant(views, registration, merge) for views in (1, 2)))
    if frames is None:
        return None
    single = case.named(1, registration, merge, frames)
    several = case.named(2, registration, merge, frames)
    assert single is not None and several is not None
    sizes = size_errors(case.holes(single), case.holes(several))
    large = sizes.diameters_mm >= LARGE_MM - 1e-9
    states = (case.status(single), case.status(several))
    runs = (case.runs(single), case.runs(several))
    lost, gained = (
        tuple(
            hole
            for hole, state in before.items()
            if state == "found" and after.get(hole) == "missed"
        )
        for before, after in (states, states[::-1])
    )
    before_mm, now_mm = (rows["threshold"] * rows["scale_mm"] for rows in map(_by_repeat, runs))
    threshold = change_of((now_mm - before_mm).to_numpy(float))
    noise = run_ratio(*runs, "surface_noise_mm")
    return AgainstOne(
        frames, sizes, sizes.change(large), sizes.change(~large), threshold, noise, lost, gained
    )


def label_of(registration: str, merge: str, place: str = "") -> str:
    """Return the name of a way to make a map: ``cpd, grid``."""
    return ", ".join(part for part in (registration, merge, place) if part) or "as declared"


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
    known = np.isfinite(change.mean)
    return (
        f"{round(change.mean, 2) + 0.0:+.2f} mm ({span(change.interval)})"
        if known
        else "not compared"
    )


def ratio_text(change: Change) -> str:
    """Return a change of a logarithm as a factor: ``× 0.61 (0.60 to 0.62)``."""
    if not np.isfinite(change.mean):
        return "not compared"
    return f"× {np.exp(change.mean):.2f} ({span(Interval(*np.exp([change.interval.low, change.interval.high])))})"


PARTS = ("in_plane", "across")
UNIT = ["frames", "repeat", "role"]
"""The columns that identify one draw of noise and of nominal poses, which intervals resample."""
MOST_REASONS = 3


def of_map(registrations: pd.DataFrame, method: str, views: int) -> pd.DataFrame:
    """Return the registrations behind a map of this number of views: those of exactly ``views``,
    else of the nearest number, since a method that registers each view alone gives the same result
    for any number."""
    rows = registrations[(registrations["method"] == method) & (registrations["view"] < views)]
    if VIEWS not in rows:
        return rows
    # "all views" counts as more than any number
    apart = pd.to_numeric(rows[VIEWS], errors="coerce").fillna(np.inf).sub(views).abs()
    order = rows.assign(_apart=apart).sort_values("_apart", kind="stable")
    return order.drop_duplicates([*UNIT, "view"]).drop(columns="_apart").sort_index()


def summarise_registrations(registrations: pd.DataFrame) -> pd.DataFrame:
    """Return one row per method and number of frames: numbers, failures, and the errors of those
    that did not fail. For both `PARTS`: median, root mean square, the value that covariances
    predict, and the ``_ratio`` of actual to predicted (1: honest, above 1: too sure) with a
    bootstrap over repeats. ``guess_mm``: error of the initial guess."""
    groups = registrations.groupby(["method", "frames"], sort=False)
    return pd.DataFrame(
        [{"method": method, "frames": frames} | _summary(part) for (method, frames), part in groups]
    )


def by_views(registrations: pd.DataFrame, counts: Sequence[int]) -> pd.DataFrame:
    """Summarise registrations by method and frames for each number of views, given in the column
    ``views``."""
    parts = []
    for method in dict.fromkeys(registrations["method"]):
        for views in counts:
            rows = of_map(registrations, method, views)
            if len(rows):
                parts.append(summarise_registrations(rows).assign(views=views))
    return (
        pd.concat(parts, ignore_index=True)
        if parts
        else pd.DataFrame(columns=["method", "frames", "views"])
    )


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
    first: pd.DataFrame, second: pd.DataFrame, column: str
) -> tuple[float, float, float, int]:
    """Return the geometric mean of second / first over pairs of views, Student's interval, number;
    NaN below two."""
    both = (
        per_pair(first, column)
        .to_frame("first")
        .join(per_pair(second, column).rename("second"), how="inner")
    )
    both = both[(both > 0).all(axis=1)]
    if len(both) < 2:
        return np.nan, np.nan, np.nan, len(both)
    logs = np.log((both["second"] / both["first"]).to_numpy(float))
    low, high = mean_t(logs.mean(), logs.std(ddof=1), len(logs))
    return float(np.exp(logs.mean())), float(np.exp(low)), float(np.exp(high)), len(logs)


def _summary(part: pd.DataFrame) -> dict[str, Any]:
    good = trusted(part)
    failures = part.loc[part["failure"] != "", "failure"]
    order = sorted(
        failures.value_counts(sort=False).items(), key=lambda item: (-int(item[1]), str(item[0]))
    )
    row: dict[str, Any] = {
        **{"n": len(part), "failed": len(failures)},
        "reasons": [f"{reason} ({count})" for reason, count in order[:MOST_REASONS]],
        "guess_mm": float(part["guess_tre_mm"].median()),
        "seconds": float(part["seconds"].astype(float).median()),
    }
    for name in PARTS:
        errors = good[[f"tre_{name}_mm", f"predicted_{name}_mm"]].astype(float)
        errors = errors.where(np.isfinite(errors)).set_axis(["actual", "predicted"], axis="columns")
        actual = errors["actual"]
        known = errors.notna().all(axis=1)
        rms = np.sqrt((errors[known] ** 2).mean())
        # units resampled
        sums = np.asarray(
            (errors[known] ** 2).groupby([good.loc[known, key] for key in UNIT]).sum(), float
        )
        ratio = _ratio(sums, np.arange(len(sums))[None]).item() if rms["predicted"] > 0 else np.nan
        ends = bootstrap(partial(_ratio, sums), len(sums)) if rms["predicted"] > 0 else UNKNOWN
        row |= {
            f"{name}_median_mm": float(actual.median()),
            f"{name}_rms_mm": float(np.sqrt((actual**2).mean())),
            **{f"{name}_predicted_mm": float(rms["predicted"]), f"{name}_ratio": ratio},
            **{f"{name}_ratio_low": ends.low, f"{name}_ratio_high": ends.high},
        }
    return row


def _ratio(sums: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return the ratios (draws,) of actual to predicted root mean square. ``sums`` (n, 2): of
    squares by `UNIT`."""
    total = sums[chosen].sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(total[:, 0] / total[:, 1]))
