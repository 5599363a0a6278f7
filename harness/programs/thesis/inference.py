"""The likelihood and posterior probability of each set-up of an experiment, given the thesis'
result.

The result is a cloud of 1 frame in which holes 5 to 11 were found, and a cloud of 50 frames with
holes 4 to 11. A hole is found with probability (hits + 1/2) / (repeats + 1), so that few repeats
neither prove nor exclude anything. Holes are assumed independent given the set-up. All set-ups
have the same prior probability."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from harness.evaluation.maps import MANY
from harness.programs.thesis.claims import (
    CAMERA,
    FEW,
    FOUND_WITH_FEW,
    FOUND_WITH_MANY,
    THESIS_HOLES,
)
from harness.vocabulary.path_names import in_words, names_of, value_text

FEWEST_SET_UPS = 20  # fewest set-ups for which a posterior is computed
# a value is doubted if its posterior probability is less than this share of its prior probability
DOUBTED = 0.5
SET_UP = "set-up"
KIND = "source.target.hole_kind"
SPEAKS_OF = {
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
    rows = rows[rows.groupby("variant")["hole"].transform("size") == 2 * len(THESIS_HOLES)]
    if CAMERA in axes or rows["variant"].nunique() < FEWEST_SET_UPS:
        return None
    chance = (rows["detected"] + 0.5) / (rows["n"] + 1)
    expected = np.where(
        rows["frames"] == MANY,
        rows["hole"].isin(FOUND_WITH_MANY),
        rows["hole"].isin(FOUND_WITH_FEW),
    )
    logs = (
        pd.Series(np.log(np.where(expected, chance, 1 - chance)), rows.index)
        .groupby(rows["variant"])
        .sum()
    )
    share = np.exp(logs - logs.max())
    share, prior = share / share.sum(), 1 / len(share)
    found = [
        {
            "axis": SET_UP,
            "value": name,
            "prior_share": prior,
            "likelihood": np.exp(logs[name]),
            "posterior_share": post,
        }
        for name, post in share.sort_values(ascending=False, kind="stable").items()
    ]
    of_set_up = rows.drop_duplicates("variant").set_index("variant")
    for path, name in names_of(list(axes)).items():
        among = of_set_up
        kind = SPEAKS_OF.get(path)
        if kind and KIND in axes:
            among = of_set_up[of_set_up[KIND] == kind]
            name = f"{name} of {kind} holes"
        for value, group in among.groupby(path, dropna=False):
            own = {
                "axis": name,
                "value": value_text(path, value),
                "prior_share": len(group) / len(among),
            }
            mean = float(np.exp(logs[group.index]).mean())
            part = float(share[group.index].sum() / share[among.index].sum())
            found.append({**own, "likelihood": mean, "posterior_share": part})
    return pd.DataFrame(found)


def borne_out_if(posterior: pd.DataFrame) -> str:
    """Return a sentence on the facts that the thesis' result requires (the values of each axis
    that are not `DOUBTED`, without facts of a doubted kind of hole) and its probability in the
    likeliest set-up."""
    best = posterior.iloc[0]
    doubted = posterior["posterior_share"] < DOUBTED * posterior["prior_share"]
    required = []
    for name, rows in posterior[posterior["axis"] != SET_UP].groupby("axis", sort=False):
        kept = rows["value"][~doubted[rows.index]]
        without = any(
            str(name).endswith(f" of {kind} holes") for kind in posterior["value"][doubted]
        )
        required += (
            [f"{name} is {' or '.join(kept)}"] if len(kept) < len(rows) and not without else []
        )
    facts = (
        "; ".join(required)
        or "no particular fact holds (every value of every axis remains possible)"
    )
    return (
        f"The thesis' outcome is borne out if {facts} (of {int((posterior['axis'] == SET_UP).sum())} set-ups; values "
        f"that the outcome makes less than half as probable are left out). In the likeliest set-up, "
        f"{in_words(best['value'])}, the exact outcome has a probability of {best['likelihood']:.2g}."
    )
