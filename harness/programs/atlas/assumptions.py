"""Facts that limits assume and nobody has measured, and how far each moves a90, from the table
``unknowns.parquet`` of a study of unknowns (`experiments/detection_limit.yaml`)."""

from collections.abc import Collection

import pandas as pd

from harness.programs.atlas.limits import AXES, DAMAGE, damage_of
from harness.programs.atlas.tables import damage_words
from harness.vocabulary.path_names import names_of
from harness.vocabulary.text import many

STORED_UNKNOWNS = "unknowns.parquet"
"""The table that comes with tofpod, in baselines."""


def assumed(
    table: pd.DataFrame, kind: str, detector: str, frames: int, axes: Collection[str]
) -> list[str]:
    """Return sentences on the facts of a table of unknowns without those that are ``axes`` of the
    atlas, for a kind of damage: the stated values and, by the nearest set-up of the table, the
    factors of a90."""
    varied_keys = {AXES[axis] for axis in axes if axis in AXES}
    rows = table[~table["key"].isin(varied_keys)]
    names = names_of(sorted(set(rows["key"])))
    value_by_key = rows.drop_duplicates("key").set_index("key")["stated"].sort_index()
    stated = [f"{names[str(key)]} {value}" for key, value in value_by_key.items()]
    sentences = [f"Assumed, not measured: {', '.join(stated)}."]
    kinds = rows[DAMAGE].map(lambda damage: damage_of(damage)[0])
    comparable = rows[kinds == kind]
    if comparable.empty:
        return [*sentences, f"How far these move limits of {damage_words(kind)}s is not computed."]
    has_detector = comparable["detector"] == detector
    if has_detector.any():
        comparable = comparable[has_detector]
    distance = (comparable["frames"] - frames).abs()
    nearest = comparable[distance == distance.min()]
    effects = nearest.sort_values("rank").drop_duplicates("key")
    first = effects.iloc[0]
    set_up = f"{damage_words(kind)}s, {first['detector']}, {many(int(first['frames']), 'frame')}"
    return [*sentences, f"They move a90 ({set_up}): {_moved(effects, names)}."]


def _moved(effects: pd.DataFrame, names: dict[str, str]) -> str:
    """Return the factor of each unknown (k,) that moves a90 beyond chance, and the largest of the
    others."""
    is_certain = effects["beyond_chance"].astype(bool)
    parts = []
    for effect in effects[is_certain].itertuples():
        parts.append(f"{names[str(effect.key)]} × {effect.factor:.2f}")
    uncertain = effects[~is_certain]
    if not uncertain.empty:
        largest = uncertain.iloc[0]
        name = names[largest["key"]]
        lead = "no other" if parts else "none"
        parts.append(f"{lead} beyond chance (at most {name}, {largest['factor']:.2f})")
    return ", ".join(parts)
