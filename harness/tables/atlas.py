"""The table of the atlas: limits at any distance and number of frames, read off the surfaces of set-ups computed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from harness.evaluation.atlas import Answer, LimitSurface, Outside
from harness.tables.schema import Column, Estimate, Table

DAMAGE = {"through": "through-hole", "blind": "blind hole", "dent": "dent"}
"""Words for kinds of damage; others are called by their own name."""
DISTANCES = 25
"""Distances on a curve, evenly spaced in their logarithm."""


@dataclass(frozen=True)
class Row:
    """A surface read at a place, with the answer there. ``title``: the camera's; ``size_mm``: asked for, or NaN."""

    surface: LimitSurface
    title: str
    place: Mapping[str, float]
    answer: Answer
    size_mm: float = np.nan

    @property
    def damage(self) -> str:
        """The kind of damage with its depth, as ``blind hole 6 mm deep``."""
        depth = self.place.get("depth_mm")
        return damage_words(self.surface.kind) + ("" if depth is None else f" {depth:g} mm deep")


def damage_words(kind: str) -> str:
    """Return the name of a kind of damage."""
    return DAMAGE.get(kind, kind.replace("_", " "))


def _a90(row: Row) -> Estimate:
    one = row.answer
    a90_mm = one.largest_mm * 1.001 if np.isnan(one.a90_mm) else one.a90_mm
    return Estimate(a90_mm, one.low_mm, one.high_mm, np.nan_to_num(one.largest_mm, nan=np.inf))


ATLAS = Table(
    "atlas",
    "one row per camera, damage, detector, distance and number of frames: the limit that the atlas states there",
    (
        Column("camera", "camera", "title", "the camera's title"),
        Column("camera_name", "", "surface.camera", "its name in experiments"),
        Column("damage", "damage", "damage", "kind of damage, with its depth"),
        Column("detector", "detector", "surface.detector", "name of the detector"),
        Column("distance_m", "distance (m)", lambda row: row.place["distance_m"], "distance of the target"),
        Column("frames", "frames", lambda row: int(row.place["frames"]), "frames averaged"),
        Column("albedo", "albedo", lambda row: row.place.get("albedo"), "the target's, where the atlas has several"),
        Column("depth_mm", "", lambda row: row.place.get("depth_mm"), "depth of the damage, where it has one"),
        Column(
            "a90_mm",
            "a90 (mm)",
            _a90,
            "size found 90 % of the time, with the 95 % interval of the surface; beyond the largest inspected where "
            "all set-ups around miss such damage; none where one of them has no limit",
            interval=True,
        ),
        Column("largest_mm", "", "answer.largest_mm", "largest size inspected there; none where a90 is unknown"),
        Column("surface_error", "", "surface.error", "of the surface: rms of ln a90, each set-up left out in turn"),
        Column(
            "found",
            "found?",
            lambda row: "" if np.isnan(row.size_mm) else row.answer.verdict(row.size_mm),
            "whether damage of the size asked for is found nine times out of ten: yes, no, undecided",
        ),
    ),
    title="the atlas: size found 90 % of the time",
    left=3,
)  # fmt: skip


def rows_at(
    surfaces: Iterable[LimitSurface], titles: Mapping[str, str], place: Mapping[str, float], size_mm: float = np.nan
) -> tuple[list[Row], list[tuple[str, str]]]:
    """Return the rows at a place, best first, and why surfaces give no answer there, each with its camera's title."""
    rows, refused = [], []
    for surface in surfaces:
        own = {axis: place[axis] for axis in surface.grid if axis in place}
        try:
            rows.append(Row(surface, titles[surface.camera], own, surface.at(**own), size_mm))
        except Outside as reason:
            refused.append((str(reason), titles[surface.camera]))
    rows.sort(key=lambda row: (np.isnan(row.answer.a90_mm), row.answer.a90_mm, row.title))
    return rows, refused


def curves(surfaces: Sequence[LimitSurface], titles: Mapping[str, str]) -> list[Row]:
    """Return every surface at `DISTANCES` distances, at each number of frames, depth and albedo that was computed."""
    rows = []
    for surface in surfaces:
        ends = surface.grid["distance_m"]
        others = [axis for axis in surface.grid if axis != "distance_m"]
        for values in product(*(surface.grid[axis] for axis in others)):
            for distance_m in np.round(np.geomspace(ends[0], ends[-1], DISTANCES), 4):
                place = dict(zip(others, values, strict=True))
                place["distance_m"] = float(np.clip(distance_m, ends[0], ends[-1]))
                rows.append(Row(surface, titles[surface.camera], place, surface.at(**place)))
    return rows
