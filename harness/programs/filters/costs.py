"""Changes by a filter of the smallest damage that is found, of false calls and of sizes.

Set-ups of a study that differ in the filter alone inspect the same frames of the same boards, and
each has a threshold of its own for the same rate of false calls; so differences are paired, over
boards."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import ValidationError

from detectors.filters import filter_settings_type
from harness.evaluation.intervals import UNKNOWN, Interval, bootstrap, percentiles
from harness.evaluation.study.limit import SetUpLimit
from harness.vocabulary.errors import UserError
from harness.vocabulary.path_names import in_words, value_text

if TYPE_CHECKING:
    import pandas as pd

AXIS = "capture.filter"
NO_FILTER = "none"
KEYS = ["board", "repeat"]  # of an inspection of a board
MEASURES = ("diameter", "depth")


@dataclass(frozen=True)
class Bias:
    """Errors of a measured size of hits."""

    mean_mm: float = np.nan
    """Mean of measured less true size over the hits that a model measured; NaN without any."""
    interval_mm: Interval = UNKNOWN
    """Its 95 % interval over boards."""
    hits: int = 0
    """Number of these hits."""


@dataclass(frozen=True, eq=False)
class FilterCost:
    """One set-up of a study, and the one without a filter on the same frames."""

    limit: SetUpLimit
    """The detection limit."""
    without: SetUpLimit
    """The limit without a filter."""
    filter_name: str
    """The filter with its settings, in words; `NO_FILTER` for none."""
    place: str
    """Values of the other axes in words, with the frames."""
    change_mm: float
    """a90 less that without a filter; NaN if either is unknown, or for no filter."""
    change_interval_mm: Interval
    """95 % percentiles of the change over resampled boards, which both share."""
    lost: int
    """Inspections in which the damage is found without the filter only."""
    gained: int
    """Inspections in which the damage is found with the filter only."""
    calling: int
    """Hole-free boards with a false call by depth at the threshold of no filter."""
    calling_without: int
    """The same boards without the filter."""
    hole_free: int
    """Number of hole-free boards."""
    bias: Mapping[str, Bias]
    """Bias of the diameter and of the depth that the model measures, by `MEASURES`."""

    @property
    def is_filtered(self) -> bool:
        """Return whether the set-up has a filter."""
        return self.filter_name != NO_FILTER

    @property
    def most_mm(self) -> float:
        """The largest change that inspections support: up to the largest size inspected."""
        return self.limit.largest_mm - self.without.a90_mm


def costs_of(
    limits: Sequence[SetUpLimit], holes: pd.DataFrame, runs: pd.DataFrame
) -> list[FilterCost]:
    """Return the cost of each set-up, those of one place together, with no filter first.
    ``holes``, ``runs``: the study's tables of trials. Set-ups without a partner are left out."""
    without = {_place(limit): limit for limit in limits if limit.record.axes.get(AXIS) is None}
    costs = []
    for set_up, unfiltered in without.items():
        same_place = [limit for limit in limits if _place(limit) == set_up]
        same_place.sort(key=lambda limit: limit is not unfiltered)
        for limit in same_place:
            costs.append(_cost(limit, unfiltered, set_up, holes, runs))
    return costs


def _place(limit: SetUpLimit) -> str:
    """Return the values of a set-up's axes other than the filter, in words."""
    record = limit.record
    parts = []
    for path, value in record.axes.items():
        if path != AXIS:
            name = path.rpartition(".")[0].rpartition(".")[2] if path.endswith(".name") else path
            parts.append(in_words(f"{name}={value_text(path, value)}"))
    frames = "1 frame" if record.frames == 1 else f"{record.frames} frames"
    return ", ".join([*parts, frames])


def _cost(
    limit: SetUpLimit,
    unfiltered: SetUpLimit,
    place: str,
    holes: pd.DataFrame,
    runs: pd.DataFrame,
) -> FilterCost:
    """Return the cost of one set-up."""
    declared: Any = limit.record.axes.get(AXIS)
    change_mm = np.nan
    change_interval_mm = UNKNOWN
    if limit is not unfiltered:
        with np.errstate(invalid="ignore"):  # infinity minus infinity is NaN: no evidence
            change_mm = limit.a90_mm - unfiltered.a90_mm
            change_interval_mm = percentiles(limit.a90_draws_mm - unfiltered.a90_draws_mm)
    found_size = _found(limit)
    found_without = _found(unfiltered)
    threshold = unfiltered.record.threshold
    quiet = _of_set_up(runs, limit)
    quiet_without = _of_set_up(runs, unfiltered)
    return FilterCost(
        limit=limit,
        without=unfiltered,
        filter_name=NO_FILTER if declared is None else filter_text(declared),
        place=place,
        change_mm=change_mm,
        change_interval_mm=change_interval_mm,
        lost=len(found_without - found_size),
        gained=len(found_size - found_without),
        calling=_calling(quiet, threshold),
        calling_without=_calling(quiet_without, threshold),
        hole_free=int((quiet["role"] == "hole_free").sum()),
        bias={name: _bias(_of_set_up(holes, limit), name) for name in MEASURES},
    )


def filter_text(declared: Mapping[str, Any]) -> str:
    """Return a filter in words: its name, settings that differ from its defaults, and what it acts
    on if not frames."""
    defaults: Mapping[str, Any] = {}
    # a plug-in may be gone, or have settings without defaults
    with contextlib.suppress(UserError, ValidationError):
        defaults = filter_settings_type(declared["name"])().to_data()
    settings = declared.get("settings", {})
    chosen = {key: value for key, value in settings.items() if value != defaults.get(key)}
    shown = {"name": declared["name"], **chosen}
    if declared.get("acts_on", "frames") != "frames":
        shown["on"] = declared["acts_on"]
    return value_text(AXIS, shown).replace("_", " ")


def _found(limit: SetUpLimit) -> set[tuple[int, str, int]]:
    """Return the inspections that found their damage: board, damage, repeat."""
    table = limit.record.inspected
    hit = table.hit
    rows = zip(
        table.board[hit].tolist(), table.hole[hit].tolist(), table.repeat[hit].tolist(), strict=True
    )
    return set(rows)


def _of_set_up(table: pd.DataFrame, limit: SetUpLimit) -> pd.DataFrame:
    """Return the rows of a set-up."""
    is_variant = table["variant"] == limit.record.variant
    return table[is_variant & (table["frames"] == limit.record.frames)]


def _calling(runs: pd.DataFrame, threshold: float) -> int:
    """Return the number of hole-free boards with a finding at a threshold."""
    quiet = runs["quiet_threshold"][runs["role"] == "hole_free"]
    return int((quiet > threshold).sum())


def _bias(holes: pd.DataFrame, measure: str) -> Bias:
    """Return the bias of what the model measures, over boards."""
    hits = holes[holes["detected"].astype(bool)]
    true_mm = hits[f"true_{measure}_mm"]
    error_mm = (hits[f"model_{measure}_mm"] - true_mm).to_numpy(float)
    is_known = np.isfinite(error_mm)
    if not is_known.any():
        return Bias()
    error_mm = error_mm[is_known]
    _, board = np.unique(hits["board"].to_numpy()[is_known], return_inverse=True)
    sums = np.bincount(board, error_mm)
    counts = np.bincount(board)
    interval_mm = bootstrap(lambda drawn: sums[drawn].sum(1) / counts[drawn].sum(1), len(counts))
    return Bias(float(error_mm.mean()), interval_mm, len(error_mm))
