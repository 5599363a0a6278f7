"""The table of the atlas: limits at any distance, albedo and number of frames, by the law that is
fitted between computed set-ups."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from harness.programs.atlas.limits import Answer, Conditions, LimitSurface, Outside
from harness.records.schema import Column, Estimate, Table

DAMAGE = {"through": "through-hole", "blind": "blind hole", "dent": "dent", "slot": "crack or slot"}
"""Names of kinds of damage in words."""
DEPTHS = 33
"""Number of depths at which damage that is deep enough is looked for."""
BEYOND = 1.001
"""Value of a limit that lies above all sizes inspected, over the largest."""
DISTANCES = 13
"""Number of distances on a curve; their logarithms are evenly spaced."""


@dataclass(frozen=True)
class Row:
    """The answer of a surface at conditions."""

    surface: LimitSurface
    """The surface."""
    conditions: Conditions
    """The question's set-up."""
    answer: Answer
    """The limit there."""
    size_mm: float = np.nan
    """The size in question, or NaN."""

    @property
    def damage(self) -> str:
        """The kind of damage with its depth, such as ``blind hole 6 mm deep``."""
        return damage_words(self.surface.kind, self.conditions.depth_mm)

    @property
    def verdict(self) -> str:
        """The verdict on damage of the size in question; empty without one."""
        return "" if np.isnan(self.size_mm) else self.answer.verdict(self.size_mm)


def damage_words(kind: str, depth_mm: float) -> str:
    """Return the name of a kind of damage, with its depth."""
    words = DAMAGE.get(kind, kind)
    return words if kind == "through" else f"{words} {depth_mm:g} mm deep"


def a90(row: Row) -> Estimate:
    """Return the limit with its interval, or the bound that is known instead."""
    answer = row.answer
    largest_mm = float(answer.sizes_mm[-1])
    if answer.rank_mm == 0:
        return Estimate(float(answer.sizes_mm[0]), at_most=True)
    return Estimate(
        min(answer.rank_mm, BEYOND * largest_mm), answer.low_mm, answer.high_mm, most=largest_mm
    )


def _error(row: Row) -> str:
    """Return the error of the law in percent of the limit, if the row has one."""
    error = row.answer.size_error
    return f"{100 * error:.0f} %" if np.isfinite(error) else ""


ATLAS = Table(
    "atlas",
    "one row per camera, damage, distance, albedo and number of frames: the limit that the atlas"
    " states",
    (
        Column("camera", "camera", "surface.title", "title of the camera"),
        Column("camera_name", "", "surface.camera", "name of the camera in experiments"),
        Column("damage", "damage", "damage", "kind of damage, with its depth"),
        Column("distance_m", "distance (m)", "conditions.distance_m", "distance of the target"),
        Column("frames", "frames", "conditions.frames", "number of averaged frames"),
        Column("albedo", "albedo", "conditions.albedo", "the target's albedo"),
        Column(
            "depth_mm",
            "",
            "conditions.depth_mm",
            "depth of the damage; of through-holes, distance of the surface behind the part",
        ),
        Column(
            "a90_mm",
            "a90 (mm)",
            a90,
            "size found 90 % of the time (of a slot its width), with its 95 % interval; above the"
            " largest size inspected if the limit is, and the smallest if all is found. An end of"
            " the interval is 0 below the sizes inspected, and infinite above",
            interval=True,
        ),
        Column(
            "law_error",
            "error",
            "answer.size_error",
            "deviation of ln a90 between the law and set-ups at distances that were left out",
            brief=False,
        ),
        Column("", "law error", _error, "", text=str),
        Column(
            "found",
            "found?",
            "verdict",
            "whether damage of the given size is found nine times out of ten: yes, no or undecided",
        ),
    ),
    title="the atlas: size found 90 % of the time",
    left=2,
)


def rows_at(
    surfaces: Iterable[LimitSurface], conditions: Conditions, size_mm: float = np.nan
) -> tuple[list[Row], list[tuple[str, str]]]:
    """Return the rows at conditions, smallest limit first, and (reason, camera title) for surfaces
    without an answer."""
    rows = []
    refused = []
    for surface in surfaces:
        try:
            rows.append(Row(surface, conditions, surface.at(conditions), size_mm))
        except Outside as reason:
            refused.append((str(reason), surface.title))
    return sorted(rows, key=order), refused


def order(row: Row) -> tuple[float, float, str]:
    """Return what sorts rows: by the limit, or the size that it is known to lie below, and by its
    lower end where it lies above the sizes inspected."""
    answer = row.answer
    return max(answer.rank_mm, float(answer.sizes_mm[0])), answer.low_mm, row.surface.title


def deep_enough_mm(row: Row) -> float:
    """Return the least depth of the atlas, from that of the question on, at which damage of some
    size is found nine times out of ten; infinite if there is none."""
    _, deepest_mm = row.surface.ranges["depth_mm"]
    for depth_mm in np.geomspace(row.conditions.depth_mm, deepest_mm, DEPTHS):
        deeper, _ = rows_at([row.surface], replace(row.conditions, depth_mm=float(depth_mm)))
        if deeper and deeper[0].answer.rank_mm < np.inf:
            return float(depth_mm)
    return np.inf


def curves(surfaces: Sequence[LimitSurface], asked: Sequence[Conditions]) -> list[Row]:
    """Return rows for every surface at `DISTANCES` distances and at those of the conditions, with
    the conditions' other values; none where the camera has no answer."""
    rows = []
    for surface in surfaces:
        nearest_m, farthest_m = surface.ranges["distance_m"]
        spread_m = set(np.round(np.geomspace(nearest_m, farthest_m, DISTANCES), 4))
        for conditions in dict.fromkeys(asked):
            for distance_m in sorted(spread_m | {conditions.distance_m}):
                beside = replace(conditions, distance_m=float(distance_m))
                found, _ = rows_at([surface], beside)
                rows += found
    return rows
