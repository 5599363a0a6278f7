"""What one experiment with maps offers to the rules about them: its maps by name, and one view beside several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from harness.evaluation.maps import MapSetUp, maps_of
from harness.evaluation.paired import Change, SizeErrors, run_change, run_ratio, size_errors
from harness.evaluation.summary import HoleState, Measure, found_holes, with_columns
from harness.tables.trials import ResultTables

if TYPE_CHECKING:
    import pandas as pd

MANY = 50
"""Frames a view that maps are compared with, where they have them."""
THESIS_REGISTRATION, THESIS_MERGE = "cpd", "grid"
LARGE_MM = 25.4 * 3 / 8
"""From here on two views are said to size better than one."""


@dataclass(frozen=True)
class Map:
    """One map of the experiment: a set-up or variation with one number of frames a view."""

    variant: str
    frames: int
    views: int


@dataclass(frozen=True)
class MapCase:
    """The maps of one place: those of one value of every axis but views, registration and merging.

    ``summary``: of `harness.evaluation.summary.summarise_holes`.
    """

    tables: ResultTables
    summary: pd.DataFrame
    maps: Sequence[MapSetUp]
    place: str

    @property
    def set_ups(self) -> list[MapSetUp]:
        """Those of ``maps`` that are no variation."""
        return [one for one in self.maps if not one.is_variation]

    def variant(self, views: int, registration: str, merge: str) -> str | None:
        """The set-up of that name. Of a single view every registration is the same, so that any will do."""
        alike = [one for one in self.set_ups if (one.views, one.merge) == (views, merge)]
        named = [one for one in alike if one.registration == registration]
        chosen = named or (alike if views == 1 else [])
        return chosen[0].variant if chosen else None

    def frames(self, variant: str) -> list[int]:
        """Numbers of frames that this variant was finished with, ascending."""
        return sorted(int(n) for n in self.summary["frames"][self.summary["variant"] == variant].unique())

    def common_frames(self, *variants: str | None) -> int | None:
        """`MANY` where all of them have it, else the most that all have; None where one is missing."""
        if any(variant is None for variant in variants):
            return None
        shared = set.intersection(*(set(self.frames(variant)) for variant in variants if variant is not None))
        return MANY if MANY in shared else max(shared, default=None)

    def named(self, views: int, registration: str, merge: str, frames: int | None = None) -> Map | None:
        """The map of that name with so many frames, by default as `common_frames` chooses."""
        variant = self.variant(views, registration, merge)
        chosen = self.common_frames(variant) if frames is None else frames
        if variant is None or chosen is None or chosen not in self.frames(variant):
            return None
        return Map(variant, chosen, views)

    def single(self, frames: int | None = None) -> Map | None:
        """One view alone, by the thesis' merging where that was tried, which leaves a single cloud nearly as it is."""
        merges = [THESIS_MERGE, *(one.merge for one in self.set_ups)]
        singles = (self.named(1, THESIS_REGISTRATION, merge, frames) for merge in dict.fromkeys(merges))
        return next((one for one in singles if one is not None), None)

    def holes(self, one: Map) -> pd.DataFrame:
        """Rows of the table of holes of one map."""
        return _rows(with_columns(self.tables.holes), one)

    def runs(self, one: Map) -> pd.DataFrame:
        """Rows of the table of runs of one map."""
        return _rows(self.tables.runs, one)

    def status(self, one: Map) -> dict[str, HoleState]:
        """Each hole's state."""
        return found_holes(self.summary, one.variant, one.frames)

    def registrations(self, frames: int) -> pd.DataFrame:
        """Registrations of the set-ups with so many frames."""
        rows = self.tables.registrations
        return rows[(rows["frames"] == frames) & rows["variant"].isin([one.variant for one in self.set_ups])]


@dataclass(frozen=True)
class AgainstOne:
    """Several merged views against the first of them alone, merged in the same way, on the same repeats.

    ``large`` and ``small``: change of |size error| in mm over the holes from `LARGE_MM` on and below; ``threshold``: of
    the calibrated threshold in mm; ``noise``: of the logarithm of the noise of the fitted surface. ``lost`` and
    ``gained``: holes found by the one view alone, by the several views alone.
    """

    one: Map
    several: Map
    sizes: SizeErrors
    large: Change
    small: Change
    threshold: Change
    noise: Change
    lost: tuple[str, ...]
    gained: tuple[str, ...]


def against_one(
    case: MapCase, registration: str, merge: str, views: int = 2, measure: Measure = "extent", frames: int | None = None
) -> AgainstOne | None:
    """The comparison with the most frames that both have (`MapCase.common_frames`), or with ``frames``; None where
    either map is missing."""
    variants = case.variant(1, registration, merge), case.variant(views, registration, merge)
    chosen = case.common_frames(*variants) if frames is None else frames
    if chosen is None:
        return None
    one, several = (case.named(n, registration, merge, chosen) for n in (1, views))
    if one is None or several is None:
        return None
    sizes = size_errors(case.holes(one), case.holes(several), measure)
    large = sizes.diameters_mm >= LARGE_MM - 1e-9
    alone, together = case.status(one), case.status(several)
    runs = case.runs(one), case.runs(several)
    return AgainstOne(
        one,
        several,
        sizes,
        sizes.change(large),
        sizes.change(~large),
        run_change(*runs, "threshold_mm"),
        run_ratio(*runs, "surface_noise_mm"),
        _only_in(alone, together),
        _only_in(together, alone),
    )


def map_cases(tables: ResultTables, summary: pd.DataFrame) -> list[MapCase]:
    """One case for each place, in the order of the set-ups."""
    maps = maps_of(tables)
    places = dict.fromkeys(one.place for one in maps if not one.is_variation)
    return [MapCase(tables, summary, [one for one in maps if one.place == place], place) for place in places]


def _rows(table: pd.DataFrame, one: Map) -> pd.DataFrame:
    return table[(table["variant"] == one.variant) & (table["frames"] == one.frames)]


def _only_in(first: dict[str, HoleState], second: dict[str, HoleState]) -> tuple[str, ...]:
    return tuple(hole for hole, state in first.items() if state == "found" and second.get(hole) == "missed")
