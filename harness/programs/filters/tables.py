"""The table of filters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from harness.programs.filters.costs import FilterCost
from harness.records.schema import Column, Estimate, Table
from harness.tables.limits import CALLS, FOUND_90, a90_of
from harness.vocabulary import text

PAIRED = "95 % interval over boards, which both set-ups share"


def _change(cost: FilterCost) -> Estimate:
    """Return the change of a90, which is known up to the largest size inspected."""
    interval = cost.change_interval_mm
    return Estimate(cost.change_mm, interval.low, interval.high, cost.most_mm)


def _bias(cost: FilterCost, measure: str) -> Estimate:
    """Return the bias of a measured size."""
    bias = cost.bias[measure]
    return Estimate(bias.mean_mm, bias.interval_mm.low, bias.interval_mm.high)


def _signed(estimate: Estimate) -> str:
    """Return ``+0.31 (+0.10 to +0.60)``, ``> +5.00`` beyond what is known, or a dash."""
    if estimate.value > estimate.most:
        return f"> {estimate.most:+.2f}"
    if not np.isfinite(estimate.value):
        return text.UNKNOWN_TEXT
    signed = f"{estimate.value:+.2f}"
    if np.isfinite([estimate.low, estimate.high]).all():
        signed += f" ({estimate.low:+.2f} to {estimate.high:+.2f})"
    return signed.replace("-", "\N{MINUS SIGN}")


def _short(estimate: Estimate) -> str:
    """Return the number without its interval, for a terminal."""
    return _signed(estimate).partition(" ")[0]


def _tone(cost: FilterCost) -> text.Tone:
    """Return the colour of a change that is clearly a loss or a gain."""
    if cost.change_interval_mm.low > 0:
        return "bad"
    return "key" if cost.change_interval_mm.high < 0 else ""


FILTER_COSTS = Table(
    "filters",
    "one row per set-up and number of frames of a study with the axis `capture.filter`: its "
    "detection limit, and the difference from the set-up without a filter on the same frames",
    (
        Column(
            "place", "set-up", "place", "values of the other axes, and the frames", text.unbroken
        ),
        Column("filter", "filter", "filter_name", "the filter with its settings, or none"),
        Column("variant", "", "limit.record.variant", "name of the set-up"),
        Column("frames", "", "limit.record.frames", "number of averaged frames"),
        Column("a90_mm", "a90 (mm)", lambda row: a90_of(row.limit), FOUND_90, interval=True),
        Column(
            "change_mm",
            "change (mm)",
            _change,
            f"a90 less that without a filter, with its {PAIRED}",
            _signed,
            interval=True,
            tone=_tone,
        ),
        Column(
            "a90_stated",
            "",
            lambda row: a90_of(row.limit).text(),
            "a90 in words, bounded by the largest size inspected",
        ),
        Column("change_stated", "", lambda row: _signed(_change(row)), "the change, likewise"),
        Column("lost", "", "lost", "inspections in which damage is found without the filter only"),
        Column("gained", "", "gained", "inspections in which it is found with the filter only"),
        replace(
            CALLS[0], value=("limit.false_calls.rate_per_m2", "limit.false_calls.interval_per_m2")
        ),
        replace(CALLS[1], value="limit.false_calls.calls"),
        Column("threshold", "", "limit.record.threshold", "threshold learned on hole-free boards"),
        Column(
            "",
            "calls at old threshold",
            lambda row: f"{row.calling_without} → {row.calling} of {row.hole_free} boards",
        ),
        Column(
            "calling",
            "",
            "calling",
            "hole-free boards with a false call by depth at the threshold of no filter",
        ),
        Column("calling_without", "", "calling_without", "the same without the filter"),
        Column("hole_free", "", "hole_free", "number of hole-free boards"),
        Column(
            "diameter_bias_mm",
            "diameter bias (mm)",
            lambda row: _bias(row, "diameter"),
            "mean of measured less true diameter of the hits, with its 95 % interval over boards",
            _signed,
            interval=True,
            brief=_short,
        ),
        Column(
            "depth_bias_mm",
            "depth bias (mm)",
            lambda row: _bias(row, "depth"),
            "the same of the depth",
            _signed,
            interval=True,
            brief=_short,
        ),
        Column("sized", "", lambda row: row.bias["diameter"].hits, "hits that were measured"),
    ),
    title="filters: limits, and changes against no filter",
    left=2,
)
