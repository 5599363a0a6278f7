"""Facts that limits assume and nobody has measured, and how far each moves a90, from the table
``unknowns.parquet`` of a study of unknowns (`experiments/detection_limit.yaml`)."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from harness.programs.atlas.tables import DAMAGE
from harness.vocabulary.path_names import names_of
from harness.vocabulary.text import many

STORED_UNKNOWNS = "unknowns.parquet"
"""The table that comes with tofpod, in baselines."""
ALBEDO = "source.target.material.albedo_850"
"""An unknown of that study, and an axis of the atlas."""
DAMAGE_COLUMN = "source.target.damage"
Effect = Mapping[str, Any]


def assumed(table: Sequence[Effect], kind: str, detector: str, frames: int) -> list[str]:
    """Return sentences on the facts of a table of unknowns (its rows), for a kind of damage: the
    stated values and, by the nearest set-up of the table, the factors of a90. Albedo is an axis of
    the atlas and is left out."""
    rows = [row for row in table if row["key"] != ALBEDO]
    value_by_key = {row["key"]: row["stated"] for row in reversed(rows)}
    names = names_of(sorted(value_by_key))
    stated = [f"{names[key]} {value_by_key[key]}" for key in sorted(value_by_key)]
    sentences = [f"Assumed, not measured: {', '.join(stated)}."]
    comparable = [row for row in rows if json.loads(row[DAMAGE_COLUMN])["kind"] == kind]
    if not comparable:
        return [*sentences, f"How far these move limits of {DAMAGE[kind]}s is not computed."]
    of_detector = [row for row in comparable if row["detector"] == detector]
    comparable = of_detector or comparable
    fewest = min(abs(row["frames"] - frames) for row in comparable)
    nearest = [row for row in comparable if abs(row["frames"] - frames) == fewest]
    effects: dict[str, Effect] = {}
    for row in sorted(nearest, key=lambda row: row["rank"]):
        effects.setdefault(row["key"], row)
    first = next(iter(effects.values()))
    set_up = f"{DAMAGE[kind]}s, {first['detector']}, {many(int(first['frames']), 'frame')}"
    return [*sentences, f"They move a90 ({set_up}): {_moved(list(effects.values()), names)}."]


def _moved(effects: Sequence[Effect], names: dict[str, str]) -> str:
    """Return the factor of each unknown that moves a90 beyond chance, and the largest of the
    others."""
    parts = []
    for effect in effects:
        if effect["beyond_chance"]:
            parts.append(f"{names[effect['key']]} × {effect['factor']:.2f}")
    uncertain = [effect for effect in effects if not effect["beyond_chance"]]
    if uncertain:
        name = names[uncertain[0]["key"]]
        lead = "no other" if parts else "none"
        parts.append(f"{lead} beyond chance (at most {name}, {uncertain[0]['factor']:.2f})")
    return ", ".join(parts)
