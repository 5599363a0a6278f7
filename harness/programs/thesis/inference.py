"""The likelihood and posterior probability of each set-up of an experiment, given the thesis'
result.

The result is a cloud of 1 frame in which holes 5 to 11 were found, and a cloud of 50 frames with
holes 4 to 11. A hole is found with probability (hits + 1/2) / (repeats + 1), so that few repeats
neither prove nor exclude anything. Holes are assumed independent given the set-up. All set-ups
have the same prior probability. Intervals are percentiles over resampled set-ups: with few draws,
a single lucky pose can favour any value."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from harness.evaluation.intervals import CONFIDENCE, RESAMPLES, Interval, percentiles
from harness.evaluation.maps import MANY
from harness.programs.thesis.cameras import CAMERA
from harness.programs.thesis.claims import (
    FEW,
    FOUND_WITH_FEW,
    FOUND_WITH_MANY,
    THESIS_HOLES,
)
from harness.vocabulary.path_names import in_words, names_of, unit_of, value_text
from harness.vocabulary.seeds import random_stream

FEWEST_SET_UPS = 20
"""Fewest set-ups for which a posterior is computed."""
DOUBTED = 0.5
"""A value is doubted if its posterior probability is less than this share of its prior one, and if
an interval of the posterior at a confidence that allows for all values excludes the prior."""
MOST_VALUES = 10
"""An axis with more numbers is one of a range, of which `PARTS` equal parts are judged."""
PARTS = 3
NO_MARGIN = (
    "The threshold is the highest outlier of a simulated cloud, and on real walls the highest "
    "residual is 0.95 to 1.24 times that: a threshold 1.25 to 2 times as high would need another "
    "cause, such as a margin left by hand."
)
SET_UP = "set-up"
"""Value of the column ``axis`` in the rows of whole set-ups."""
KIND = "source.target.hole_kind"
KIND_WITH = {
    "source.target.blind_depth_mm": "blind",
    "source.target.backing_distance_mm": "through",
}
"""Facts that only one kind of hole has; if both kinds are tried, probabilities are those given
that kind."""


def posterior_of(summary: pd.DataFrame, axes: Sequence[str]) -> pd.DataFrame | None:
    """Return rows of `harness.records.trials.POSTERIOR`: every set-up, likeliest first, then every
    value of each axis. Return None for another target, too few set-ups, several cameras, or
    without both numbers of frames. The probability of a fact that only one kind of hole has is
    conditional on this kind."""
    rows = summary[summary["frames"].isin([FEW, MANY]) & summary["hole"].isin(THESIS_HOLES)]
    rows_of_set_up = rows.groupby("variant")["hole"].transform("size")
    rows = rows[rows_of_set_up == 2 * len(THESIS_HOLES)]
    if CAMERA in axes or rows["variant"].nunique() < FEWEST_SET_UPS:
        return None
    log_likelihood = _log_likelihood(rows)
    relative = np.exp(log_likelihood - log_likelihood.max())
    share = relative / relative.sum()
    set_ups = rows.drop_duplicates("variant").set_index("variant")
    value_count = sum(len(_values(path, set_ups[path])) for path in axes)
    posterior: list[dict[str, Any]] = [
        {
            "axis": SET_UP,
            "value": name,
            "prior_share": 1 / len(share),
            "likelihood": np.exp(log_likelihood[name]),
            "posterior_share": probability,
            "posterior_low": np.nan,
            "posterior_high": np.nan,
        }
        for name, probability in share.sort_values(ascending=False, kind="stable").items()
    ]
    for path, name in names_of(list(axes)).items():
        possible = set_ups
        kind = KIND_WITH.get(path)
        if kind and KIND in axes:
            possible = set_ups[set_ups[KIND] == kind]
            name = f"{name} of {kind} holes"
        for value, has_value in _values(path, possible[path]).items():
            group = possible.index[has_value]
            relative_of_possible = relative[possible.index].to_numpy()
            interval = _interval(relative_of_possible, has_value, value_count)
            posterior_share = share[group].sum() / share[possible.index].sum()
            posterior.append(
                {
                    "axis": name,
                    "value": value,
                    "prior_share": len(group) / len(possible),
                    "likelihood": float(np.exp(log_likelihood[group]).mean()),
                    "posterior_share": float(posterior_share),
                    "posterior_low": interval.low,
                    "posterior_high": interval.high,
                }
            )
    return pd.DataFrame(posterior)


def _values(path: str, column: pd.Series) -> dict[str, np.ndarray]:
    """Return the values of an axis in words, in ascending order, each with which set-ups (n,) have
    it; of a range, its parts."""
    values = column.drop_duplicates().sort_values()
    has_value: dict[str, np.ndarray] = {}
    if len(values) <= MOST_VALUES:
        for value in values:
            if pd.isna(value):
                has_value["none"] = np.asarray(column.isna())
            else:
                has_value[value_text(path, value)] = np.asarray(column == value)
        return has_value
    edges = np.linspace(values.min(), values.max(), PARTS + 1)
    part = np.minimum(np.digitize(column, edges), PARTS) - 1
    for number in range(PARTS):
        ends = f"{edges[number]:.2g} to {edges[number + 1]:.2g} {unit_of(path)}"
        has_value[ends.rstrip()] = part == number
    return has_value


def _interval(relative: np.ndarray, has_value: np.ndarray, value_count: int) -> Interval:
    """Return the interval of a value's posterior share over resampled set-ups, from their relative
    likelihoods (n,) and which of them (n,) have the value. All ``value_count`` intervals hold at
    once with a confidence of 95 %."""
    count = len(relative)
    stream = random_stream(0, "set-ups drawn again", count)
    equal = np.full(count, 1 / count)
    times_drawn = stream.multinomial(count, equal, RESAMPLES)
    sums_with_value = times_drawn @ (relative * has_value)
    sums = times_drawn @ relative
    confidence = 1 - (1 - CONFIDENCE) / value_count
    return percentiles(sums_with_value / sums, confidence)


def _log_likelihood(rows: pd.DataFrame) -> pd.Series:
    """Return the logarithm of the probability of the thesis' exact result by set-up, from rows of
    both numbers of frames and all holes."""
    chance = (rows["detected"] + 0.5) / (rows["n"] + 1)
    thesis_found = np.where(
        rows["frames"] == MANY,
        rows["hole"].isin(FOUND_WITH_MANY),
        rows["hole"].isin(FOUND_WITH_FEW),
    )
    agrees = pd.Series(np.log(np.where(thesis_found, chance, 1 - chance)), rows.index)
    return agrees.groupby(rows["variant"]).sum()


def borne_out_if(posterior: pd.DataFrame) -> str:
    """Return what the thesis' result decides and what it does not: the values of each axis that it
    makes doubtful (without facts of a doubtful kind of hole), and the axes that have none."""
    is_set_up = posterior["axis"] == SET_UP
    prior = posterior["prior_share"]
    is_doubted = posterior["posterior_share"] < DOUBTED * prior
    is_doubted &= posterior["posterior_high"] < prior
    doubted_values = posterior["value"][is_doubted & ~is_set_up]
    doubtful = []
    undecided = []
    for name, rows in posterior[~is_set_up].groupby("axis", sort=False):
        if any(str(name).endswith(f" of {value} holes") for value in doubted_values):
            continue
        doubted = rows[is_doubted[rows.index]]
        if doubted.empty:
            undecided.append(str(name))
        else:
            doubtful.append(f"{name} of {' or '.join(doubted['value'])}")
    decides = f"speaks against {'; '.join(doubtful) or 'nothing'}"
    leaves = "leaves nothing open"
    if undecided:
        leaves = f"does not decide {', '.join(undecided)}"
    likeliest = posterior.iloc[0]
    return (
        f"Of what the thesis leaves open, its outcome {decides}, and {leaves} (a value is doubtful "
        "if the outcome makes it less than half as probable, with an interval over "
        f"{int(is_set_up.sum())} set-ups that excludes no change). {NO_MARGIN} In the likeliest "
        f"set-up, {in_words(likeliest['value'])}, the exact outcome has a probability of "
        f"{likeliest['likelihood']:.2g}."
    )
