"""The table of the atlas: limits at any distance and number of frames, interpolated between
computed set-ups."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from harness.programs.atlas.limits import Answer, LimitSurface, Outside
from harness.records.schema import Column, Estimate, Table

DAMAGE = {"through": "through-hole", "blind": "blind hole", "dent": "dent"}
"""Names of kinds of damage in words; other kinds keep their name."""
DISTANCES = 25
"""Number of distances on a curve; their logarithms are evenly spaced."""


@dataclass(frozen=True)
class Row:
    """The answer of a surface at a place."""

    surface: LimitSurface
    """The surface."""
    title: str
    """Title of its camera."""
    position: Mapping[str, float]
    """A value for each axis of the surface."""
    answer: Answer
    """The limit there."""
    size_mm: float = np.nan
    """The size in question, or NaN."""

    @property
    def damage(self) -> str:
        """The kind of damage with its depth, such as ``blind hole 6 mm deep``."""
        words = damage_words(self.surface.kind)
        depth_mm = self.position.get("depth_mm")
        return words if depth_mm is None else f"{words} {depth_mm:g} mm deep"

    @property
    def verdict(self) -> str:
        """The verdict on damage of the size in question; empty without one."""
        return "" if np.isnan(self.size_mm) else self.answer.verdict(self.size_mm)


def damage_words(kind: str) -> str:
    """Return the name of a kind of damage."""
    return DAMAGE.get(kind, kind.replace("_", " "))


def _a90(row: Row) -> Estimate:
    """Return the limit with its interval; a little above the largest size if it lies beyond."""
    answer = row.answer
    a90_mm = answer.a90_mm
    if np.isnan(a90_mm):
        a90_mm = answer.largest_mm * 1.001
    most_mm = np.nan_to_num(answer.largest_mm, nan=np.inf)
    return Estimate(a90_mm, answer.low_mm, answer.high_mm, most_mm)


ATLAS = Table(
    "atlas",
    "one row per camera, damage, detector, distance and number of frames: the limit that the atlas"
    " states",
    (
        Column("camera", "camera", "title", "title of the camera"),
        Column("camera_name", "", "surface.camera", "name of the camera in experiments"),
        Column("damage", "damage", "damage", "kind of damage, with its depth"),
        Column("detector", "detector", "surface.detector", "name of the detector"),
        Column(
            "distance_m",
            "distance (m)",
            lambda row: row.position["distance_m"],
            "distance of the target",
        ),
        Column(
            "frames",
            "frames",
            lambda row: int(row.position["frames"]),
            "number of averaged frames",
        ),
        Column(
            "albedo",
            "albedo",
            lambda row: row.position.get("albedo"),
            "the target's albedo, if it varies",
        ),
        Column(
            "depth_mm",
            "",
            lambda row: row.position.get("depth_mm"),
            "depth of the damage, if it has one",
        ),
        Column(
            "a90_mm",
            "a90 (mm)",
            _a90,
            "size found 90 % of the time, with the 95 % interval of the surface; beyond the "
            "largest"
            " inspected size if all neighbouring set-ups miss such damage; empty if one of "
            "them has"
            " no limit",
            interval=True,
        ),
        Column(
            "largest_mm",
            "",
            "answer.largest_mm",
            "largest inspected size; empty if a90 is unknown",
        ),
        Column(
            "surface_error",
            "",
            "surface.error",
            "rms error of ln a90 when each set-up is left out in turn",
        ),
        Column(
            "found",
            "found?",
            "verdict",
            (
                "whether damage of the given size is found nine times out of ten: yes, no or "
                "undecided"
            ),
        ),
    ),
    title="the atlas: size found 90 % of the time",
    left=3,
)


def rows_at(
    surfaces: Iterable[LimitSurface],
    titles: Mapping[str, str],
    position: Mapping[str, float],
    size_mm: float = np.nan,
) -> tuple[list[Row], list[tuple[str, str]]]:
    """Return the rows at a position, smallest limit first, and (reason, camera title) for surfaces
    without an answer."""
    rows = []
    refused = []
    for surface in surfaces:
        title = titles[surface.camera]
        on_axes = {axis: position[axis] for axis in surface.grid if axis in position}
        try:
            rows.append(Row(surface, title, on_axes, surface.at(**on_axes), size_mm))
        except Outside as reason:
            refused.append((str(reason), title))
    rows.sort(key=lambda row: (np.isnan(row.answer.a90_mm), row.answer.a90_mm, row.title))
    return rows, refused


def curves(surfaces: Sequence[LimitSurface], titles: Mapping[str, str]) -> list[Row]:
    """Return rows for every surface at `DISTANCES` distances and each computed number of frames,
    depth and albedo."""
    rows = []
    for surface in surfaces:
        title = titles[surface.camera]
        distances_m = surface.grid["distance_m"]
        nearest_m = distances_m[0]
        farthest_m = distances_m[-1]
        # rounding must not lead out of the computed range
        spread_m = np.round(np.geomspace(nearest_m, farthest_m, DISTANCES), 4)
        spread_m = np.clip(spread_m, nearest_m, farthest_m)
        axes = [axis for axis in surface.grid if axis != "distance_m"]
        for values in product(*(surface.grid[axis] for axis in axes)):
            for distance_m in spread_m:
                position = dict(zip(axes, values, strict=True))
                position["distance_m"] = float(distance_m)
                rows.append(Row(surface, title, position, surface.at(**position)))
    return rows
