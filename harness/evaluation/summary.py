"""Rates, means and intervals of rows per trial: the numbers of summary.csv, the report and the final table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal

from harness.evaluation import intervals
from harness.tables.trials import TRIALS, TRUTH

if TYPE_CHECKING:
    import pandas as pd

HoleState = Literal["found", "missed", "undecided"]
Measure = Literal["extent", "model"]

MAIN = "main"
"""The variant that the experiment declares; every other one changes a fact that the thesis leaves open."""
STATES = ("found", "wrong depth", "invalid", "invisible")
"""States of a hole by its pixels alone, whatever the detector says."""
FOUND_RULE = (
    "A hole counts as found when the 95 % Wilson interval of its detection rate over the repeats lies above 0.5, "
    "as missed when it lies below, else as undecided."
)
FEWEST_TRIALS = 4
"""4 of 4 have a Wilson interval from 0.51; with 3 nothing is certain."""
GROUP = ["variant", "frames", "hole"]
TRUTH_COLUMNS = [column.name for column in TRUTH]
FITTED = ["model_diameter_se_mm", "model_depth_mm", "model_depth_se_mm"]


def by_hole(names: pd.Series) -> pd.Series:
    """Sort key: holes by number where they have one ("2" before "11"), the others after them by name."""
    return names.map(lambda name: (0, int(name), "") if str(name).isdecimal() else (1, 0, str(name)))


def summarise_holes(holes: pd.DataFrame, axes: Sequence[str] = ()) -> pd.DataFrame:
    """One row per (variant, frames, hole): counts, rates, sizes and positions, each with its interval.

    ``axes``: columns that are the same for all rows of a variant, to be carried along.

    Columns beside the group and the truth: ``n`` trials, ``detected`` of them, ``rate`` with Wilson's interval
    ``rate_low``/``rate_high`` and ``status`` by `FOUND_RULE`; for the thesis' measure (``extent_``) and the model's
    (``model_``): ``measured`` trials with a finite diameter, ``diameter_mean_mm``, ``diameter_std_mm`` (n - 1),
    ``bias_mm`` with Student's interval, ``offset_mean_mm``, ``offset_std_mm``, ``offset_bias_mm``, ``error_mean_mm``;
    ``model_diameter_se_mean_mm`` and ``model_depth_*`` of the model fit: means, scatter, stated standard errors and the
    bias against ``seen_depth_mm`` (``true_depth_mm`` is the removed material; behind a through-hole one sees farther),
    and ``model_diameter_covered``, the share of fits whose diameter lies within 1.96 of its own standard errors of the
    truth; and ``share_*``, the share of trials in each of `STATES`. Means are over the detected trials only, so they
    are conditional on detection: a hole detected in few trials shows the sizes of its lucky trials.
    """
    import pandas as pd

    holes = with_columns(holes)
    groups = holes.groupby(GROUP, sort=False)
    out = groups[[*axes, *TRUTH_COLUMNS]].first()
    out["n"] = groups.size()
    out["detected"] = groups["detected"].sum().astype(int)
    out["rate"] = out["detected"] / out["n"]
    out["rate_low"], out["rate_high"] = intervals.wilson(out["detected"], out["n"])
    out["status"] = [status_of(low, high) for low, high in zip(out["rate_low"], out["rate_high"], strict=True)]
    for measure in ("extent", "model"):
        out = pd.concat([out, _measured(groups, out, measure)], axis=1)
    out = pd.concat([out, _fitted(holes, out)], axis=1)
    out["median_residual_mm"] = groups["median_residual_mm"].mean()
    out["invalid_fraction"] = groups["invalid_fraction"].mean()
    for state in STATES:
        out[f"share_{state.replace(' ', '_')}"] = (holes["state"] == state).groupby([holes[c] for c in GROUP]).mean()
    return out.reset_index().sort_values(GROUP, key=_order, kind="stable").reset_index(drop=True)


def with_columns(holes: pd.DataFrame) -> pd.DataFrame:
    """The table of holes, with its columns where it came without any because no trial on the damaged board ended."""
    return holes if "hole" in holes else holes.reindex(columns=[column.name for column in TRIALS.columns])


def status_of(rate_low: float, rate_high: float) -> HoleState:
    """`FOUND_RULE` for one interval of a detection rate."""
    if rate_low > 0.5:
        return "found"
    return "missed" if rate_high < 0.5 else "undecided"


def found_rule(trials: int) -> str:
    """`FOUND_RULE`, and that it can call no hole found where there are so few trials of each."""
    if trials >= FEWEST_TRIALS:
        return FOUND_RULE
    return f"{FOUND_RULE} With {trials} of them no hole can count as either: that takes {FEWEST_TRIALS} at least."


def found_holes(summary: pd.DataFrame, variant: str, frames: int) -> dict[str, HoleState]:
    """Each hole's status by `FOUND_RULE`, in the holes' order; empty where the variant lacks these frames."""
    rows = summary[(summary["variant"] == variant) & (summary["frames"] == frames)]
    return dict(zip(rows["hole"], rows["status"], strict=True))


def false_calls(runs: pd.DataFrame) -> pd.DataFrame:
    """One row per (variant, frames, role): runs, false calls, their rate per run with Garwood's Poisson interval.

    Counts only runs that were judged at a threshold: hole-free runs that set it (their threshold is NaN) are told by
    ``quiet_runs`` and ``quiet_highest``, the highest of their quiet thresholds, instead.
    """
    keys = ["variant", "frames"]
    judged = runs[runs["threshold"].notna()].assign(threshold_mm=lambda r: r["threshold"] * r["scale_mm"])
    out = judged.groupby([*keys, "role"], sort=False, as_index=False).agg(
        runs=("repeat", "size"),
        false_calls=("false_calls", "sum"),
        threshold=("threshold", "mean"),
        threshold_mm=("threshold_mm", "mean"),
        surface_noise_mm=("surface_noise_mm", "mean"),
    )
    quiet = runs[runs["role"] == "hole_free"].groupby(keys, as_index=False)
    out = out.merge(quiet.agg(quiet_runs=("repeat", "size"), quiet_highest=("quiet_threshold", "max")), "left", keys)
    out["false_calls"] = out["false_calls"].astype(int)
    out["per_run"] = out["false_calls"] / out["runs"]
    out["per_run_low"], out["per_run_high"] = intervals.poisson_rate(out["false_calls"], out["runs"])
    return out.sort_values([*keys, "role"], key=_order, kind="stable", ignore_index=True)


def _measured(groups: Any, truth: pd.DataFrame, measure: Measure) -> pd.DataFrame:
    """Means, standard deviations and biases of one measure's diameters and offsets."""
    import pandas as pd

    diameter, offset = groups[f"{measure}_diameter_mm"], groups[f"{measure}_offset_mm"]
    out = pd.DataFrame(index=truth.index)
    out["measured"] = diameter.count()
    out["diameter_mean_mm"], out["diameter_std_mm"] = diameter.mean(), diameter.std()
    out["bias_mm"] = out["diameter_mean_mm"] - truth["true_diameter_mm"]
    out["bias_low_mm"], out["bias_high_mm"] = intervals.mean_t(out["bias_mm"], out["diameter_std_mm"], out["measured"])
    out["offset_mean_mm"], out["offset_std_mm"] = offset.mean(), offset.std()
    out["offset_bias_mm"] = out["offset_mean_mm"] - truth["true_offset_mm"]
    out["offset_measured"] = offset.count()
    out["error_mean_mm"] = groups[f"{measure}_error_mm"].mean()
    return out.add_prefix(f"{measure}_")


def _fitted(holes: pd.DataFrame, truth: pd.DataFrame) -> pd.DataFrame:
    """Depth, which only the model gives, and the standard errors that each fit states, compared with the truth."""
    import pandas as pd

    fits = holes[[*GROUP, "true_diameter_mm", "model_diameter_mm", *FITTED]].copy()
    miss = (fits["model_diameter_mm"] - fits["true_diameter_mm"]).abs() / fits["model_diameter_se_mm"]
    fits["covered"] = (miss <= 1.96).astype(float).where(miss.notna())
    groups = fits.groupby(GROUP, sort=False)
    out = pd.DataFrame(index=truth.index)
    out["model_diameter_se_mean_mm"] = groups["model_diameter_se_mm"].mean()
    out["model_diameter_covered"] = groups["covered"].mean()
    out["model_depth_mean_mm"], out["model_depth_std_mm"] = (
        groups["model_depth_mm"].mean(),
        groups["model_depth_mm"].std(),
    )
    out["model_depth_se_mean_mm"] = groups["model_depth_se_mm"].mean()
    out["model_depth_bias_mm"] = out["model_depth_mean_mm"] - truth["seen_depth_mm"]
    return out


def _order(column: pd.Series) -> pd.Series:
    """Sort key of one group column: the main variant first, holes by number, frames as numbers."""
    if column.name == "hole":
        return by_hole(column)
    if column.name == "variant":
        first_seen = {name: place for place, name in enumerate(dict.fromkeys(column))}
        return column.map(lambda name: -1 if name == MAIN else first_seen[name])
    return column


def hole_list(names: Iterable[str]) -> str:
    """Hole names as text, runs of numbers joined: ``4–7, 9``; ``none``."""
    numbered = sorted(int(name) for name in names if str(name).isdecimal())
    others = [str(name) for name in names if not str(name).isdecimal()]
    runs: list[list[int]] = []
    for number in numbered:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    parts = [str(run[0]) if len(run) == 1 else f"{run[0]}–{run[-1]}" for run in runs]
    return ", ".join(parts + others) or "none"
