"""Sizes, depths and false calls of a finished study of simulated boards, against the truth."""

from pathlib import Path

import numpy as np
import pandas as pd

from harness import api
from harness.evaluation.intervals import poisson_rate
from harness.evaluation.study.limit import SetUpLimit
from harness.programs.audit.rows import Audited, audited
from harness.vocabulary.path_names import in_words
from harness.vocabulary.text import many

WITHIN = 2.0  # standard errors
NOMINAL = 0.954  # share of normal errors within two standard errors


def rows_of_study(folder: Path) -> list[Audited]:
    """Return the coverage of stated diameters, depths and rates, for each set-up."""
    holes = api.table(folder, "trials")
    rows: list[Audited] = []
    for _, of_set_up in holes.groupby(["variant", "frames"], sort=True):
        first = of_set_up.iloc[0]
        frames = many(int(first["frames"]), "frame")
        case = f"{in_words(str(first['variant']))}, {frames}"
        rows += _sizes(of_set_up, case)
    rows += _rates(api.limits(folder))
    return rows


def _sizes(holes: pd.DataFrame, case: str) -> list[Audited]:
    """Return the coverage of diameters and depths of the holes that were found and measured."""
    rows = []
    truths = {"diameter": "true_diameter_mm", "depth": "seen_depth_mm"}
    for name, truth in truths.items():
        stated = holes[f"model_{name}_mm"].to_numpy(float)
        error = holes[f"model_{name}_se_mm"].to_numpy(float)
        true = holes[truth].to_numpy(float)
        is_finite = np.isfinite(stated) & np.isfinite(error) & np.isfinite(true)
        if not is_finite.any():
            continue
        within = np.abs(stated - true)[is_finite] <= WITHIN * error[is_finite]
        row = audited(
            f"{name}, two standard errors",
            case,
            nominal=NOMINAL,
            holds=within,
            ratio=stated[is_finite] / true[is_finite],
        )
        rows.append(row)
    return rows


def _rates(limits: tuple[SetUpLimit, ...]) -> list[Audited]:
    """Return whether the false calls counted on other boards agree with the threshold's interval:
    whether the intervals of both overlap, one row for all set-ups."""
    agree = []
    ratios = []
    for limit in limits:
        stated = limit.record.threshold_error
        if stated is None or limit.false_calls is None:
            continue
        low, high = poisson_rate(limit.false_calls.calls, limit.false_calls.area_m2)
        agree.append(bool(low <= stated.high_per_m2 and stated.low_per_m2 <= high))
        ratios.append(limit.false_calls.rate_per_m2)
    if not agree:
        return []
    row = audited(
        "false calls agree with the threshold's rate",
        "all set-ups",
        nominal=0.95,
        holds=np.array(agree),
        ratio=np.array(ratios),
    )
    return [row]
