"""The likelihood and posterior probability of each set-up of an experiment, given the thesis'
result.

The result is a cloud of 1 frame in which holes 5 to 11 were found, and a cloud of 50 frames with
holes 4 to 11. A hole is found with probability (hits + 1/2) / (repeats + 1), so that few repeats
neither prove nor exclude anything. Holes are assumed independent given the set-up. All set-ups
have the same prior probability."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from harness.evaluation.maps import MANY
from harness.programs.thesis.cameras import CAMERA
from harness.programs.thesis.claims import (
    FEW,
    FOUND_WITH_FEW,
    FOUND_WITH_MANY,
    THESIS_HOLES,
)
from harness.vocabulary.path_names import in_words, names_of, value_text

FEWEST_SET_UPS = 20
"""Fewest set-ups for which a posterior is computed."""
DOUBTED = 0.5
"""A value is doubted if its posterior probability is less than this share of its prior one."""
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
    share = np.exp(log_likelihood - log_likelihood.max())
    share = share / share.sum()
    posterior: list[dict[str, Any]] = [
        {
            "axis": SET_UP,
            "value": name,
            "prior_share": 1 / len(share),
            "likelihood": np.exp(log_likelihood[name]),
            "posterior_share": probability,
        }
        for name, probability in share.sort_values(ascending=False, kind="stable").items()
    ]
    set_ups = rows.drop_duplicates("variant").set_index("variant")
    for path, name in names_of(list(axes)).items():
        possible = set_ups
        kind = KIND_WITH.get(path)
        if kind and KIND in axes:
            possible = set_ups[set_ups[KIND] == kind]
            name = f"{name} of {kind} holes"
        for value, group in possible.groupby(path, dropna=False):
            posterior.append(
                {
                    "axis": name,
                    "value": value_text(path, value),
                    "prior_share": len(group) / len(possible),
                    "likelihood": float(np.exp(log_likelihood[group.index]).mean()),
                    "posterior_share": float(
                        share[group.index].sum() / share[possible.index].sum()
                    ),
                }
            )
    return pd.DataFrame(posterior)


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
    """Return a sentence on the facts that the thesis' result requires (the values of each axis
    that are not `DOUBTED`, without facts of a doubted kind of hole) and its probability in the
    likeliest set-up."""
    likeliest = posterior.iloc[0]
    is_set_up = posterior["axis"] == SET_UP
    is_doubted = posterior["posterior_share"] < DOUBTED * posterior["prior_share"]
    doubted_values = posterior["value"][is_doubted]
    required = []
    for name, rows in posterior[~is_set_up].groupby("axis", sort=False):
        possible = rows["value"][~is_doubted[rows.index]]
        of_doubted_kind = any(str(name).endswith(f" of {value} holes") for value in doubted_values)
        if len(possible) < len(rows) and not of_doubted_kind:
            required.append(f"{name} is {' or '.join(possible)}")
    if not required:
        required.append("no particular fact holds (every value of every axis remains possible)")
    return (
        f"The thesis' outcome is borne out if {'; '.join(required)} (of {int(is_set_up.sum())}"
        " set-ups; values that the outcome makes less than half as probable are left out). In the"
        f" likeliest set-up, {in_words(likeliest['value'])}, the exact outcome has a "
        "probability of"
        f" {likeliest['likelihood']:.2g}."
    )
